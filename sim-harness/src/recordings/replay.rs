//! Replays recorded episodes: the same observations through a policy, and its actions and plans compared with the recorded ones.
//!
//! Equal means bit for bit: the runtime promises the same bits on every target, so any difference is another policy, another runtime or a
//! damaged log. What can fail: a log of a policy with other sizes or without its frames, an instruction that this policy does not know, an
//! observation that it refuses.

use lads_core::{
    Channel, ChannelId, Contract, Controller, DType, Data, Decision, FollowError, Instruction,
    InstructionError, Isa, Noise, Policy, StepError,
};
use lads_host::{Memory, MemoryError};
use thiserror::Error;

use crate::recorder::{Flight, Log, Origin, png};
use crate::trace::Step;

/// Why a log cannot be replayed.
#[derive(Debug, Error)]
pub enum ReplayError {
    /// The log is from a policy with other sizes or names.
    #[error("the log's {what} is not the policy's: {log} against {policy}")]
    Sizes {
        /// Name of what differs.
        what: &'static str,
        /// The value in the log.
        log: String,
        /// The value in the policy.
        policy: String,
    },
    /// A log holds no frame of a camera.
    #[error(
        "{episode}: control step {step} has no frame of camera {camera}; record it again with --log"
    )]
    NoFrame {
        /// Name of the episode.
        episode: String,
        /// Control step, from 0.
        step: usize,
        /// Name of the channel.
        camera: String,
    },
    /// A log's frame cannot be read.
    #[error(
        "{episode}: the frame of camera {camera} at control step {step} cannot be read: {wrong}"
    )]
    Frame {
        /// Name of the episode.
        episode: String,
        /// Control step, from 0.
        step: usize,
        /// Name of the channel.
        camera: String,
        /// What is wrong.
        wrong: String,
    },
    /// The policy does not know a recorded instruction.
    #[error("the policy does not know the recorded instruction '{0}'")]
    Instruction(String),
    /// The policy refused the instruction.
    #[error("the policy refuses the instruction: {0}")]
    Instruct(InstructionError),
    /// There is no memory for the policy's controller.
    #[error(transparent)]
    Memory(MemoryError),
    /// The controller refused an observation.
    #[error("{episode}: the controller refuses the observation of control step {step}: {error}")]
    Step {
        /// Name of the episode.
        episode: String,
        /// Control step, from 0.
        step: usize,
        /// The controller's reason.
        error: StepError,
    },
    /// The policy refused a commanded plan.
    #[error("{episode}: the policy gives no action for the plan of control step {step}: {error}")]
    Follow {
        /// Name of the episode.
        episode: String,
        /// Control step, from 0.
        step: usize,
        /// The controller's reason.
        error: FollowError,
    },
}

/// First control step of an episode whose replay differs from the log.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    /// Id of the episode's instruction.
    pub instruction: String,
    /// Number of the episode.
    pub episode: u32,
    /// Control step, from 0.
    pub step: usize,
    /// Plan in the log and now, where they differ.
    pub plans: Option<[Option<u32>; 2]>,
    /// The element with the largest difference, its name, and its value in the log and now; `None` where all have the same bits.
    pub action: Option<(String, f32, f32)>,
}

/// Result of replaying a log.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Replayed {
    /// Number of episodes replayed.
    pub episodes: usize,
    /// Number of control steps replayed.
    pub steps: usize,
    /// First difference of each episode that has one.
    pub differences: Vec<Difference>,
}

/// Replays all episodes of a log on the instruction set `isa`, `finished` is called
/// after each.
pub fn replay(
    policy: &Policy<'_>,
    isa: Isa,
    log: &Log,
    finished: &dyn Fn(),
) -> Result<Replayed, ReplayError> {
    let contract = policy.contract();
    fits(policy, log)?;
    let mut memory = Memory::of(policy).map_err(ReplayError::Memory)?;
    let mut controller = memory
        .controller_with(policy, isa)
        .map_err(ReplayError::Memory)?;
    let mut replayed = Replayed::default();
    let mut action = vec![0.0; contract.action_len()];
    for flight in &log.flights {
        begin(&mut controller, contract, flight)?;
        let episode = || format!("{} episode {}", flight.instruction_id, flight.trace.episode);
        let mut first = None;
        for (number, step) in flight.trace.steps.iter().enumerate() {
            let given = Given::at(contract, step).map_err(|wrong| wrong.at(episode(), number))?;
            let seen = given.data();
            let plan = if let Some(plan) = step.plan.filter(|_| flight.trace.commanded) {
                let acted = controller.follow(&seen, plan, &mut action);
                acted.map_err(|error| ReplayError::Follow {
                    episode: episode(),
                    step: number,
                    error,
                })?;
                Some(plan)
            } else {
                let stepped = controller.step_with(&seen, &mut action);
                let report = stepped.map_err(|error| ReplayError::Step {
                    episode: episode(),
                    step: number,
                    error,
                })?;
                report.selected.map(|selected| selected.index)
            };
            if first.is_none() {
                first = compare(log, flight, number, step, plan, &action);
            }
        }
        replayed.episodes += 1;
        replayed.steps += flight.trace.steps.len();
        replayed.differences.extend(first);
        finished();
    }
    Ok(replayed)
}

/// Brings a controller to the beginning of an episode.
fn begin(
    controller: &mut Controller<'_, '_>,
    contract: &Contract<'_>,
    flight: &Flight,
) -> Result<(), ReplayError> {
    if flight.trace.continued {
        controller.reset();
        return Ok(());
    }
    controller.set_decision(match flight.trace.sampling_seed {
        None => Decision::Argmax,
        Some(seed) => contract.sampling(seed),
    });
    let noise = flight.trace.noise_seed;
    controller.set_noise(noise.map_or(Noise::Zero, |seed| Noise::Seeded { seed }));
    let instruction = match &flight.words {
        Some(words) => Instruction::Words(words),
        None if contract.instruction_channel().is_none() => {
            controller.reset();
            return Ok(());
        }
        None => Instruction::Id(find(contract, flight)?),
    };
    controller
        .set_instruction(instruction)
        .map_err(ReplayError::Instruct)
}

/// What is wrong with a step's frames.
pub(super) struct BadFrame {
    camera: String,
    /// `None` where there is no frame.
    wrong: Option<String>,
}

impl BadFrame {
    pub(super) fn at(self, episode: String, step: usize) -> ReplayError {
        let camera = self.camera;
        match self.wrong {
            None => ReplayError::NoFrame {
                episode,
                step,
                camera,
            },
            Some(wrong) => ReplayError::Frame {
                episode,
                step,
                camera,
                wrong,
            },
        }
    }
}

/// What the controller was given at a control step, channel by channel.
pub(super) struct Given(Vec<(ChannelId, Held)>);

enum Held {
    F32(Vec<f32>),
    I32(Vec<i32>),
    U8(Vec<u8>),
}

impl Given {
    /// Reads it from a step of a log: frames from its pictures, all else from its numbers.
    pub(super) fn at(contract: &Contract<'_>, step: &Step) -> Result<Self, BadFrame> {
        let mut rest = &step.observation[..];
        let mut numbers = |channel: &Channel<'_>| {
            let (own, behind) = rest.split_at(channel.len().min(rest.len()));
            rest = behind;
            own
        };
        let channels = contract.observations().map(|channel| {
            let held = match channel.dtype() {
                DType::F32 => Held::F32(numbers(&channel).to_vec()),
                DType::I32 => Held::I32(numbers(&channel).iter().map(|&n| n as i32).collect()),
                DType::U8 => Held::U8(frame(&channel, step)?),
            };
            Ok((channel.id(), held))
        });
        channels.collect::<Result<_, _>>().map(Self)
    }

    pub(super) fn data(&self) -> Vec<(ChannelId, Data<'_>)> {
        let all = self.0.iter().map(|(id, held)| {
            let data = match held {
                Held::F32(values) => Data::F32(values),
                Held::I32(values) => Data::I32(values),
                Held::U8(bytes) => Data::U8(bytes),
            };
            (*id, data)
        });
        all.collect()
    }
}

/// Reads a camera's frame at a control step.
fn frame(camera: &Channel<'_>, step: &Step) -> Result<Vec<u8>, BadFrame> {
    let bad = |wrong| BadFrame {
        camera: camera.name().to_owned(),
        wrong,
    };
    let mut pictures = step.pictures.iter();
    let picture = pictures.find(|picture| picture.channel == camera.name());
    let picture = picture.ok_or_else(|| bad(None))?;
    let (frame, _) = png::decode(&picture.png).map_err(|wrong| bad(Some(wrong)))?;
    if frame.len() != camera.len() {
        let (got, wanted) = (frame.len(), camera.len());
        return Err(bad(Some(format!("{got} bytes instead of {wanted}"))));
    }
    Ok(frame)
}

fn fits(policy: &Policy<'_>, log: &Log) -> Result<(), ReplayError> {
    let origin = &log.origin;
    let sizes = |what, log: String, policy: String| {
        if log == policy {
            return Ok(());
        }
        Err(ReplayError::Sizes { what, log, policy })
    };
    let ours = Origin::of(policy);
    elements(
        "observation",
        &origin.observation_names,
        &ours.observation_names,
    )?;
    elements("action", &origin.action_names, &ours.action_names)?;
    let said = |period: Option<usize>| period.map_or("none".to_owned(), |steps| steps.to_string());
    sizes(
        "control steps per plan",
        said(origin.period),
        said(ours.period),
    )
}

/// Compares number and names of the elements; describes the first difference.
fn elements(what: &'static str, log: &[String], policy: &[String]) -> Result<(), ReplayError> {
    let sizes = |log: String, policy: String| Err(ReplayError::Sizes { what, log, policy });
    if log.len() != policy.len() {
        let counted = |count| format!("{count} elements");
        return sizes(counted(log.len()), counted(policy.len()));
    }
    match log.iter().zip(policy).find(|(was, is)| was != is) {
        Some((was, is)) => sizes(was.clone(), is.clone()),
        None => Ok(()),
    }
}

/// Finds the policy's index of the recorded instruction by its text: another bundle may number them otherwise.
fn find(contract: &Contract<'_>, flight: &Flight) -> Result<u32, ReplayError> {
    let place = contract
        .instructions()
        .position(|known| known.text == flight.instruction_text);
    place
        .map(|place| place as u32)
        .ok_or_else(|| ReplayError::Instruction(flight.instruction_text.clone()))
}

fn compare(
    log: &Log,
    flight: &Flight,
    number: usize,
    step: &Step,
    plan: Option<u32>,
    action: &[f32],
) -> Option<Difference> {
    let distance = |&(_, was, is): &(usize, f32, f32)| (was - is).abs();
    let worst = step
        .action
        .iter()
        .zip(action)
        .enumerate()
        .filter(|(_, (was, is))| was.to_bits() != is.to_bits())
        .map(|(element, (&was, &is))| (element, was, is))
        .max_by(|a, b| distance(a).total_cmp(&distance(b)));
    if worst.is_none() && step.plan == plan {
        return None;
    }
    let names = &log.origin.action_names;
    Some(Difference {
        instruction: flight.instruction_id.clone(),
        episode: flight.trace.episode,
        step: number,
        plans: (step.plan != plan).then_some([step.plan, plan]),
        action: worst.map(|(element, was, is)| {
            let name = names.get(element).cloned().unwrap_or_default();
            (name, was, is)
        }),
    })
}
