//! Collects scripted demonstrations: the work of `lads-collect`.
//!
//! The result depends on the settings alone, not on the number of threads: every attempt has its own random streams, seeded by (seed,
//! instruction, attempt), and the first successful attempts of each instruction are kept. An attempt fails when a commanded sub-task is not
//! completed within the time limit, or when one is completed that was not commanded. The only other failure is an instruction that the
//! experts cannot perform.

use std::collections::HashMap;
use std::num::NonZeroUsize;
use std::sync::mpsc;

use serde_json::json;
use thiserror::Error;

use crate::dataset::{Dataset, Demonstration, SUB_TASKS_PER_INSTRUCTION};
use crate::environment::{Environment, EpisodeSeed};
use crate::expert::Performer;
use crate::instructions::Instruction;
use crate::kitchen::spec::{ACTION_NAMES, CONTROL_PERIOD_S, OBSERVATION_NAMES, SUB_TASK_NAMES};
use crate::kitchen::{self, Kitchen, Noise, Scene};
use crate::queue::Queue;

/// Longest demonstration in control steps: shorter than an episode of 280 steps, so that a policy that is a little slower still finishes.
pub const MAX_STEPS: usize = 270;
/// Episode number of the first demonstration. Evaluations count from 0, so that they never repeat a demonstration's noise.
pub const FIRST_EPISODE: u64 = 1 << 32;

/// Settings of a collection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Successful demonstrations of each instruction.
    pub episodes_per_instruction: usize,
    /// Seed of everything random.
    pub seed: u64,
    /// Noise of the observations.
    pub noise: Noise,
    /// Largest standard deviation of the recovery noise; each episode draws its own between 0 and this.
    pub recovery_noise: f64,
    /// Worker threads.
    pub threads: NonZeroUsize,
}

/// Counts of one instruction's attempts.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Tally {
    /// Number of episodes that were run.
    pub attempts: usize,
    /// Number of failed attempts, which are discarded.
    pub discarded: usize,
    /// Control steps of the successful attempts.
    pub steps: usize,
}

/// Why a collection cannot go on.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum CollectError {
    /// No episodes were asked for.
    #[error("zero episodes per instruction: ask for at least 1 with --episodes-per-instruction")]
    NoEpisodes,
    /// The noise is negative or not finite.
    #[error("the recovery noise must be a number between 0 and 1")]
    BadNoise,
    /// Too many attempts of one instruction failed.
    #[error(
        "\"{id}\": only {successes} of {attempts} attempts succeeded; use less --recovery-noise"
    )]
    GaveUp {
        /// The instruction.
        id: String,
        /// Successful attempts.
        successes: usize,
        /// Number of all attempts.
        attempts: usize,
    },
}

/// Demonstrates every instruction. `progress` is called on this thread after every attempt, with whether it succeeded.
pub fn collect(
    scene: &Scene,
    instructions: &[Instruction],
    settings: &Settings,
    mut progress: impl FnMut(bool),
) -> Result<(Dataset, Vec<Tally>), CollectError> {
    if settings.episodes_per_instruction == 0 {
        return Err(CollectError::NoEpisodes);
    }
    if !(0.0..=1.0).contains(&settings.recovery_noise) {
        return Err(CollectError::BadNoise);
    }
    let queue = Queue::new(0..instructions.len());
    let mut results: Vec<Option<(Vec<Demonstration>, Tally)>> = vec![None; instructions.len()];
    std::thread::scope(|scope| -> Result<(), CollectError> {
        let (sender, receiver) = mpsc::channel();
        for _ in 0..settings.threads.get().min(instructions.len()) {
            let (sender, queue) = (sender.clone(), &queue);
            scope.spawn(move || {
                let _halts = queue.halts_on_panic();
                let mut kitchen = Kitchen::new(scene, settings.noise);
                while let Some(index) = queue.take(1).map(|taken| taken.start) {
                    let Some(instruction) = instructions.get(index) else {
                        return;
                    };
                    let report = |success| sender.send(Message::Attempt(success)).is_ok();
                    let result = demonstrate(&mut kitchen, index, instruction, settings, report);
                    // The receiver is gone after a failure elsewhere: no reason to go on.
                    if sender.send(Message::Instruction(index, result)).is_err() {
                        return;
                    }
                }
            });
        }
        drop(sender);
        for message in receiver {
            match message {
                Message::Attempt(success) => progress(success),
                Message::Instruction(index, result) => results[index] = result?,
            }
        }
        Ok(())
    })?;
    let (demonstrations, tallies): (Vec<_>, Vec<_>) = results.into_iter().flatten().unzip();
    let metadata = metadata(settings, instructions, &tallies);
    let dataset = Dataset {
        metadata,
        instructions: instructions.to_vec(),
        demonstrations: demonstrations.into_iter().flatten().collect(),
    };
    Ok((dataset, tallies))
}

type Demonstrated = Option<(Vec<Demonstration>, Tally)>;

enum Message {
    /// An attempt ended; true if it succeeded.
    Attempt(bool),
    /// All demonstrations of an instruction are complete.
    Instruction(usize, Result<Demonstrated, CollectError>),
}

/// Demonstrates one instruction until enough attempts succeeded; `None` when `report` says that the receiver has gone.
fn demonstrate(
    kitchen: &mut Kitchen,
    index: usize,
    instruction: &Instruction,
    settings: &Settings,
    report: impl Fn(bool) -> bool,
) -> Result<Demonstrated, CollectError> {
    let wanted = settings.episodes_per_instruction;
    let mut demonstrations = Vec::with_capacity(wanted);
    let mut tally = Tally::default();
    while demonstrations.len() < wanted {
        if tally.attempts >= 10 * wanted + 20 {
            let (successes, attempts) = (demonstrations.len(), tally.attempts);
            return Err(CollectError::GaveUp {
                id: instruction.id.clone(),
                successes,
                attempts,
            });
        }
        let episode = FIRST_EPISODE + tally.attempts as u64;
        let demonstration = attempt(kitchen, index, instruction, episode, settings);
        tally.attempts += 1;
        if !report(demonstration.is_some()) {
            return Ok(None);
        }
        match demonstration {
            Some(demonstration) => {
                tally.steps += demonstration.transitions.len();
                demonstrations.push(demonstration);
            }
            None => tally.discarded += 1,
        }
    }
    Ok(Some((demonstrations, tally)))
}

/// Runs one attempt; `None` if it failed.
fn attempt(
    kitchen: &mut Kitchen,
    index: usize,
    instruction: &Instruction,
    episode: u64,
    settings: &Settings,
) -> Option<Demonstration> {
    let seed = EpisodeSeed {
        seed: settings.seed,
        instruction: index as u64,
        episode,
    };
    let mut performer = Performer::new(kitchen, seed, settings.recovery_noise, MAX_STEPS);
    let mut sub_task_ends = [0; SUB_TASKS_PER_INSTRUCTION];
    for (name, end) in instruction.sub_tasks.iter().zip(&mut sub_task_ends) {
        let sub_task = SUB_TASK_NAMES.iter().position(|known| known == name)?;
        if !performer.perform(sub_task).ok()? {
            return None;
        }
        *end = performer.transitions().len();
    }
    if performer.environment().completions().len() != instruction.sub_tasks.len() {
        return None;
    }
    let style = performer.style();
    Some(Demonstration {
        instruction: index,
        episode,
        transitions: performer.into_transitions(),
        sub_task_ends,
        recovery_noise: style.recovery_noise,
        speed: style.speed,
    })
}

fn metadata(
    settings: &Settings,
    instructions: &[Instruction],
    tallies: &[Tally],
) -> HashMap<String, String> {
    let per_instruction = |value: fn(&Tally) -> usize| -> String {
        let counts = instructions
            .iter()
            .zip(tallies)
            .map(|(instruction, tally)| (instruction.id.clone(), json!(value(tally))));
        serde_json::Value::Object(counts.collect()).to_string()
    };
    let versions =
        json!({ "lads-sim": env!("CARGO_PKG_VERSION"), "mujoco": mujoco_rs::mujoco_version() });
    [
        ("environment", kitchen::ID.to_owned()),
        ("environment_version", kitchen::VERSION.to_owned()),
        ("noise", settings.noise.name().to_owned()),
        ("seed", settings.seed.to_string()),
        ("recovery_noise", settings.recovery_noise.to_string()),
        ("control_period_s", CONTROL_PERIOD_S.to_string()),
        ("observation_names", json!(OBSERVATION_NAMES).to_string()),
        ("action_names", json!(ACTION_NAMES).to_string()),
        ("attempts", per_instruction(|tally| tally.attempts)),
        ("discarded", per_instruction(|tally| tally.discarded)),
        ("versions", versions.to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into_iter()
    .collect()
}
