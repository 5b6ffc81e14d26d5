//! Replays recorded episodes: the same observations through a policy, and its actions and plans compared with the recorded ones.
//!
//! Equal means bit for bit: the runtime promises the same bits on every target, so any difference is another policy, another runtime or a
//! damaged log. What can fail: a log of a policy with other sizes, an instruction that this policy does not know, an observation that it
//! refuses.

use lads_core::{
    Channel, Contract, DType, Data, Decision, FollowError, Instruction, InstructionError, Isa,
    Noise, Policy, StepError,
};
use lads_host::{Memory, MemoryError};
use thiserror::Error;

use crate::recorder::{Flight, Log};
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
    /// A log has no frames.
    #[error("the policy sees images, which a log does not hold")]
    Images,
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

/// Replays all episodes of a log on the instruction set `isa`, by a policy that selects every `period` control steps; `finished` is called
/// after each.
pub fn replay(
    policy: &Policy<'_>,
    period: Option<usize>,
    isa: Isa,
    log: &Log,
    finished: &dyn Fn(),
) -> Result<Replayed, ReplayError> {
    let contract = policy.contract();
    fits(contract, period, log)?;
    let mut memory = Memory::of(policy).map_err(ReplayError::Memory)?;
    let mut controller = memory
        .controller_with(policy, isa)
        .map_err(ReplayError::Memory)?;
    let channel = contract.observation().id();
    let mut replayed = Replayed::default();
    let mut action = vec![0.0; contract.action_len()];
    for flight in &log.flights {
        let instruction = match &flight.words {
            Some(words) => Instruction::Words(words),
            None => Instruction::Id(find(contract, flight)?),
        };
        controller.set_decision(match flight.trace.sampling_seed {
            None => Decision::Argmax,
            Some(seed) => contract.sampling(seed),
        });
        let noise = flight.trace.noise_seed;
        controller.set_noise(noise.map_or(Noise::Zero, |seed| Noise::Seeded { seed }));
        controller
            .set_instruction(instruction)
            .map_err(ReplayError::Instruct)?;
        let episode = || format!("{} episode {}", flight.instruction_id, flight.trace.episode);
        let mut first = None;
        for (number, step) in flight.trace.steps.iter().enumerate() {
            let plan = if let Some(plan) = step.plan.filter(|_| flight.trace.commanded) {
                let seen = [(channel, Data::F32(&step.observation))];
                let acted = controller.follow(&seen, plan, &mut action);
                acted.map_err(|error| ReplayError::Follow {
                    episode: episode(),
                    step: number,
                    error,
                })?;
                Some(plan)
            } else {
                let stepped = controller.step(&step.observation, &mut action);
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

fn fits(contract: &Contract<'_>, period: Option<usize>, log: &Log) -> Result<(), ReplayError> {
    let origin = &log.origin;
    let sizes = |what, log: String, policy: String| {
        if log == policy {
            return Ok(());
        }
        Err(ReplayError::Sizes { what, log, policy })
    };
    if contract.observations().any(|it| it.dtype() != DType::F32) {
        return Err(ReplayError::Images);
    }
    elements(
        "observation",
        &origin.observation_names,
        &contract.observation(),
    )?;
    elements("action", &origin.action_names, &contract.action())?;
    let said = |period: Option<usize>| period.map_or("none".to_owned(), |steps| steps.to_string());
    sizes("control steps per plan", said(origin.period), said(period))
}

/// Compares number and names of the elements; describes the first difference.
fn elements(what: &'static str, log: &[String], channel: &Channel<'_>) -> Result<(), ReplayError> {
    let policy: Vec<&str> = channel.elements().map(|element| element.name).collect();
    let sizes = |log: String, policy: String| Err(ReplayError::Sizes { what, log, policy });
    if log.len() != policy.len() {
        let counted = |count| format!("{count} elements");
        return sizes(counted(log.len()), counted(policy.len()));
    }
    match log.iter().zip(policy).find(|(was, is)| was != is) {
        Some((was, is)) => sizes(was.clone(), is.to_owned()),
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
