//! A legged robot at 50 Hz: two imported policies, one for standing and one for walking, with lost sensor reads and a swap on the way.
//!
//! ```sh
//! lads import stand.onnx --contract robot.toml -o stand.lads.onnx        # in runtime/host/examples/biped; walk.onnx alike
//! cargo run --release -p lads-host --example biped -- stand.lads.onnx walk.lads.onnx 150
//! ```
//!
//! The caller gives raw sensor values and gets joint targets; the image handles order, scales, the
//! default posture and the last action. The hardware is simulated: joints follow their targets
//! slowly, and every 40th read of the sensors is lost. The program prints the guard's counters and
//! a digest of all actions. `--fast` skips the waiting.

use std::error::Error;
use std::process::ExitCode;
use std::thread;
use std::time::{Duration, Instant};

use lads_core::{
    ChannelId, Contract, Data, Fallback, GuardConfig, GuardedController, Limits, Tick,
};
use lads_host::Loaded;

/// Number of periods after which a read is lost.
const LOST: u32 = 40;

/// Largest rate of a joint target, in radians per second.
const MAX_RATE: f32 = 8.0;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<(), Box<dyn Error>> {
    let (flags, named): (Vec<_>, Vec<_>) = std::env::args()
        .skip(1)
        .partition(|argument| argument == "--fast");
    let [stand, walk, more @ ..] = &named[..] else {
        return Err("usage: biped STAND WALK [PERIODS] [--fast]".into());
    };
    let periods: u32 = more.first().map_or(Ok(150), |periods| periods.parse())?;
    let mut stand = lads_host::open(stand.as_ref())?.load()?;
    let mut walk = lads_host::open(walk.as_ref())?.load()?;

    // Memory of the guards; from the first step on nothing allocates.
    let mut memory = [vec![], vec![]];
    let joints = stand.opened().policy().contract().action_len();
    let rates = vec![MAX_RATE; joints];
    let config = GuardConfig {
        fallback: Fallback::Decay {
            time_constant_s: 0.2,
        },
        coast: 2,
        // Periods: further ahead, and a timestamp is damaged.
        max_jump: 10,
        limits: Limits {
            max_rate: Some(&rates),
            ..Limits::default()
        },
        ..GuardConfig::default()
    };
    let [first, second] = &mut memory;
    let mut running = guarded(&mut stand, &config, first)?;
    let mut next = guarded(&mut walk, &config, second)?;

    let contract = running.controller().policy().contract();
    let mut robot = Robot::new(contract);
    let mut action = vec![0.0; joints];
    let mut digest = Digest::default();
    let period = Duration::from_secs_f32(contract.control_period_s());
    let start = Instant::now();
    for number in 0..periods {
        if flags.is_empty() {
            thread::sleep((period * number).saturating_sub(start.elapsed()));
        }
        if number == periods / 2 {
            // The last executed action, limits, rates and counters go over.
            next.take_over(&running)?;
            std::mem::swap(&mut running, &mut next);
        }
        let tick = Tick {
            timestamp: u64::from(number) + 1,
            missed: 0,
        };
        let report = if number % LOST == LOST - 1 {
            running.step_blind(&mut action)?
        } else {
            let command = [0.4, 0.0, 0.1];
            let inputs = [
                (robot.observation, Data::F32(&robot.sensors)),
                (robot.command, Data::F32(&command)),
            ];
            running.step_with(&inputs, Some(tick), &mut action)?
        };
        if let Some(intervention) = report.intervention {
            println!("period {number}: {intervention:?}");
        }
        robot.follow(&action);
        digest.add(&action);
    }
    println!("{:?}", running.counters());
    println!("digest {:08x}", digest.0);
    Ok(())
}

fn guarded<'a, 'm>(
    loaded: &'a mut Loaded,
    config: &GuardConfig,
    memory: &'m mut Vec<f32>,
) -> Result<GuardedController<'a, 'm>, Box<dyn Error>>
where
    'a: 'm,
{
    memory.resize(
        GuardedController::memory_len(&loaded.opened().policy()),
        0.0,
    );
    let mut guarded = GuardedController::new(loaded.controller(), config, memory)?;
    guarded.self_test()?;
    Ok(guarded)
}

/// Simulated robot whose joints move part of the way to their targets in every period.
struct Robot {
    observation: ChannelId,
    command: ChannelId,
    sensors: Vec<f32>,
    /// Positions of each joint's position and velocity among the sensors.
    places: Vec<(usize, usize)>,
    period_s: f32,
}

impl Robot {
    fn new(contract: &Contract) -> Self {
        let channel = contract.observation();
        let place = |joint: &str, interface: &str| {
            let mut elements = channel.elements();
            elements.position(|element| element.joint == joint && element.interface == interface)
        };
        let places: Vec<(usize, usize)> = contract
            .action()
            .elements()
            .filter_map(|target| {
                Some((
                    place(target.joint, "position")?,
                    place(target.joint, "velocity")?,
                ))
            })
            .collect();
        let mut sensors: Vec<f32> = channel
            .elements()
            .map(|element| element.limits.clamp(0.0))
            .collect();
        // Upright.
        let upright = channel
            .elements()
            .position(|element| element.name.ends_with("gravity.w"));
        if let Some(w) = upright {
            sensors[w] = 1.0;
        }
        let command = contract.find("command").unwrap_or(channel).id();
        Self {
            observation: channel.id(),
            command,
            sensors,
            places,
            period_s: contract.control_period_s(),
        }
    }

    fn follow(&mut self, targets: &[f32]) {
        for (&(position, velocity), &target) in self.places.iter().zip(targets) {
            let step = 0.25 * (target - self.sensors[position]);
            self.sensors[position] += step;
            self.sensors[velocity] = step / self.period_s;
        }
    }
}

/// FNV-1a hash over the bits of all actions.
struct Digest(u32);

impl Default for Digest {
    fn default() -> Self {
        Self(0x811c_9dc5)
    }
}

impl Digest {
    fn add(&mut self, action: &[f32]) {
        for byte in action.iter().flat_map(|value| value.to_le_bytes()) {
            self.0 = (self.0 ^ u32::from(byte)).wrapping_mul(0x0100_0193);
        }
    }
}
