//! A fixed-rate control loop in Rust: everything that allocates or can be refused happens before the loop, the loop itself only
//! steps a [`GuardedController`].
//!
//! `cargo run --release -p lads-ffi --example controller -- models/kitchen.onnx kbls 100`
//!
//! The hardware is simulated: joints follow their velocity commands exactly.

use std::error::Error;
use std::process::ExitCode;
use std::thread;
use std::time::{Duration, Instant};

use lads_compiler::{Bundle, compile};
use lads_core::{
    Controller, Fallback, GuardConfig, GuardedController, Instruction, Policy, Tick, Workspace,
};

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
    let mut arguments = std::env::args().skip(1);
    let (Some(bundle), Some(instruction)) = (arguments.next(), arguments.next()) else {
        return Err("usage: controller BUNDLE INSTRUCTION [CYCLES]".into());
    };
    let cycles: u32 = arguments.next().map_or(Ok(100), |cycles| cycles.parse())?;

    // A target without std has the image in flash instead: `lads compile --emit-rust`.
    let image = compile(&Bundle::open(bundle.as_ref())?)?;
    let policy = Policy::new_checked(image.as_bytes())?;
    let contract = policy.contract();
    let number = contract
        .instructions()
        .position(|known| known.id == instruction || known.text == instruction)
        .ok_or(
            "the policy does not know this instruction; lads inspect lists those that it knows",
        )?;

    let (mut arena, mut state) = (vec![0.0; policy.arena_len()], vec![0.0; policy.state_len()]);
    let mut guard = vec![0.0; GuardedController::memory_len(&policy)];
    let controller = Controller::new(policy, Workspace::new(&policy, &mut arena, &mut state)?);
    let config = GuardConfig {
        fallback: Fallback::Decay {
            time_constant_s: 2.0 * contract.control_period_s(),
        },
        late_after: 2,
        // Ten periods, in nanoseconds: further ahead, and a timestamp is damaged.
        max_jump: (1e10 * contract.control_period_s()) as u64,
        ..GuardConfig::default()
    };
    let mut controller = GuardedController::new(controller, &config, &mut guard)?;
    controller.self_test()?;
    controller.set_instruction(Instruction::Id(number as u32))?;

    // The hardware: every action element moves the first observed element of its joint.
    let limits: Vec<_> = contract.observation().elements().collect();
    let moved: Vec<_> = contract
        .action()
        .elements()
        .map(|action| limits.iter().position(|state| state.joint == action.joint))
        .collect();
    let mut observation: Vec<f32> = limits.iter().map(|limit| limit.limits.clamp(0.0)).collect();
    let mut action = vec![0.0; contract.action_len()];

    let period = Duration::from_secs_f32(contract.control_period_s());
    let start = Instant::now();
    let mut last = 0;
    for cycle in 1..=cycles {
        thread::sleep((period * cycle).saturating_sub(start.elapsed()));
        let now = start.elapsed();
        let periods = (now.as_nanos() / period.as_nanos()) as u32;
        let tick = Tick {
            timestamp: now.as_nanos() as u64,
            missed: periods.saturating_sub(last + 1),
        };
        last = periods;
        let report = controller.step(&observation, Some(tick), &mut action)?;
        if let Some(intervention) = report.intervention {
            eprintln!("cycle {cycle}: {intervention:?}");
        }
        for (&velocity, index) in action.iter().zip(&moved) {
            let joint =
                index.and_then(|index| Some((observation.get_mut(index)?, limits.get(index)?)));
            if let Some((position, limit)) = joint {
                *position = limit
                    .limits
                    .clamp(*position + velocity * contract.control_period_s());
            }
        }
    }
    println!("{cycles} cycles: {:?}", controller.counters());
    Ok(())
}
