//! Collects random trajectories with post-hoc labels, for `lads-collect --env lorel`.
//!
//! Every trajectory has random streams of its own, seeded by (seed, episode), so the file does not depend on the number of threads.
//! Trajectories that moved nothing are left out and counted. Actions are uniform in their limits and recorded as they were drawn, the
//! element without effect too; what was executed has a zero there. The only failure is an order for nothing.

use std::collections::HashMap;
use std::num::NonZeroUsize;
use std::path::Path;
use std::sync::mpsc;

use safetensors::Dtype;
use serde_json::json;
use thiserror::Error;

use super::label::{Label, label};
use super::spec::{
    ACTION_LEN, ACTION_LIMITS, ACTION_NAMES, CONTROL_PERIOD_S, MAX_STEPS, OBSERVATION_LEN,
    OBSERVATION_NAMES, UNUSED_ACTION,
};
use super::{ID, Lorel, Scene, VERSION};
use crate::collect::FIRST_EPISODE;
use crate::dataset::{self, DatasetError, Tensor, f32_bytes, i64_bytes};
use crate::environment::{Environment, EpisodeSeed};
use crate::instructions::Instruction;
use crate::queue::Queue;
use crate::random::Stream;

/// Fourth number of the entropy of the stream that actions and the order of clauses are drawn from.
const ACTION_STREAM: u64 = 2;
/// Number of trajectories that a thread takes at a time.
const CHUNK: usize = 100;

/// Settings of a collection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Trajectories to run, those that move nothing included.
    pub episodes: usize,
    /// Seed of everything random.
    pub seed: u64,
    /// Worker threads.
    pub threads: NonZeroUsize,
}

/// No episodes were asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error("zero episodes: ask for at least 1 with --episodes")]
pub struct NoEpisodes;

/// A labelled random trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// Number of the trajectory's random streams.
    pub episode: u64,
    /// Label: what the trajectory did, in words.
    pub label: Label,
    /// Observation before each step.
    pub observations: [[f32; OBSERVATION_LEN]; MAX_STEPS],
    /// Action of each step, as drawn.
    pub actions: [[f32; ACTION_LEN]; MAX_STEPS],
}

/// Collected trajectories and their counts.
#[derive(Clone, Debug, PartialEq)]
pub struct Collected {
    /// Trajectories that moved something, in the order of their numbers.
    pub trajectories: Vec<Trajectory>,
    /// Number of trajectories that were run.
    pub episodes: usize,
    /// Seed of everything random.
    pub seed: u64,
}

/// Runs the trajectories. `progress` is called on this thread with the number that was finished.
pub fn collect(
    scene: &Scene,
    settings: &Settings,
    mut progress: impl FnMut(usize),
) -> Result<Collected, NoEpisodes> {
    if settings.episodes == 0 {
        return Err(NoEpisodes);
    }
    let queue = Queue::new(0..settings.episodes);
    let chunks = settings.episodes.div_ceil(CHUNK);
    let mut parts: Vec<Vec<Trajectory>> = vec![Vec::new(); chunks];
    std::thread::scope(|scope| {
        let (sender, receiver) = mpsc::channel();
        for _ in 0..settings.threads.get().min(chunks) {
            let (sender, queue) = (sender.clone(), &queue);
            scope.spawn(move || {
                let _halts = queue.halts_on_panic();
                let mut lorel = Lorel::new(scene);
                while let Some(episodes) = queue.take(CHUNK) {
                    let (chunk, finished) = (episodes.start / CHUNK, episodes.len());
                    let run = |episode| trajectory(&mut lorel, settings.seed, episode as u64);
                    let done: Vec<_> = episodes.filter_map(run).collect();
                    if sender.send((chunk, finished, done)).is_err() {
                        return;
                    }
                }
            });
        }
        drop(sender);
        for (chunk, finished, done) in receiver {
            parts[chunk] = done;
            progress(finished);
        }
    });
    Ok(Collected {
        trajectories: parts.into_iter().flatten().collect(),
        episodes: settings.episodes,
        seed: settings.seed,
    })
}

/// Runs one trajectory; `None` if it moved nothing between its first and its last observation.
fn trajectory(lorel: &mut Lorel, seed: u64, number: u64) -> Option<Trajectory> {
    let episode = FIRST_EPISODE + number;
    let start = EpisodeSeed {
        seed,
        instruction: 0,
        episode,
    };
    let mut stream = Stream::new(&[seed, 0, episode, ACTION_STREAM]);
    lorel.reset(start, &[]);
    let mut observations = [[0.0; OBSERVATION_LEN]; MAX_STEPS];
    let mut actions = [[0.0; ACTION_LEN]; MAX_STEPS];
    let mut ends = [[0.0; OBSERVATION_LEN]; 2];
    for (step, (observation, recorded)) in observations.iter_mut().zip(&mut actions).enumerate() {
        ends[usize::from(step > 0)].copy_from_slice(lorel.observation());
        for (to, &from) in observation.iter_mut().zip(lorel.observation()) {
            *to = from as f32;
        }
        let action = ACTION_LIMITS.map(|limit| stream.uniform(-limit, limit));
        *recorded = action.map(|value| value as f32);
        // What is executed is what is recorded; it is finite and of the right length.
        let _ = lorel.step(&recorded.map(f64::from));
    }
    let label = label(&ends[0], &ends[1], &mut stream)?;
    Some(Trajectory {
        episode,
        label,
        observations,
        actions,
    })
}

impl Collected {
    /// Number of trajectories that moved nothing.
    pub fn nothing(&self) -> usize {
        self.episodes - self.trajectories.len()
    }

    /// Writes the dataset in the form of [`crate::dataset`].
    pub fn write(&self, path: &Path) -> Result<(), DatasetError> {
        let mut instructions: Vec<Instruction> = Vec::new();
        let mut numbers: HashMap<&str, usize> = HashMap::new();
        let mut labels = Vec::with_capacity(self.trajectories.len());
        for Trajectory { label, .. } in &self.trajectories {
            let number = *numbers.entry(&label.text).or_insert(instructions.len());
            if number == instructions.len() {
                instructions.push(Instruction {
                    id: format!("label{number}"),
                    sub_tasks: label.sub_tasks.iter().map(|&name| name.into()).collect(),
                    text: label.text.clone(),
                });
            }
            labels.push(number as i64);
        }
        let (all, episodes) = (&self.trajectories, self.trajectories.len());
        let steps = episodes * MAX_STEPS;
        let actions = || all.iter().flat_map(|one| one.actions);
        let executed = actions().map(|mut action| {
            action[UNUSED_ACTION] = 0.0;
            action
        });
        let observations = all.iter().flat_map(|one| one.observations);
        let offsets = (0..=episodes).map(|episode| (episode * MAX_STEPS) as i64);
        let floats = |name, width, values| Tensor::new(name, Dtype::F32, &[steps, width], values);
        let integers = |name, len, values| Tensor::new(name, Dtype::I64, &[len], values);
        let tensors = [
            floats(
                "observations",
                OBSERVATION_LEN,
                f32_bytes(observations.flatten()),
            ),
            floats("actions", ACTION_LEN, f32_bytes(actions().flatten())),
            floats("executed", ACTION_LEN, f32_bytes(executed.flatten())),
            integers("episode_offsets", episodes + 1, i64_bytes(offsets)),
            integers("instruction", episodes, i64_bytes(labels.into_iter())),
            integers(
                "seeds",
                episodes,
                i64_bytes(all.iter().map(|one| one.episode as i64)),
            ),
        ];
        dataset::write(path, &self.metadata(), &instructions, &tensors)
    }

    fn metadata(&self) -> HashMap<String, String> {
        let versions =
            json!({ "lads-sim": env!("CARGO_PKG_VERSION"), "mujoco": mujoco_rs::mujoco_version() });
        [
            ("environment", ID.to_owned()),
            ("environment_version", VERSION.to_owned()),
            ("noise", "none".to_owned()),
            ("seed", self.seed.to_string()),
            ("control_period_s", CONTROL_PERIOD_S.to_string()),
            ("observation_names", json!(OBSERVATION_NAMES).to_string()),
            ("action_names", json!(ACTION_NAMES).to_string()),
            ("attempts", self.episodes.to_string()),
            ("discarded", self.nothing().to_string()),
            ("versions", versions.to_string()),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into_iter()
        .collect()
    }
}
