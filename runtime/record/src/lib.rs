//! Flight recorder: episodes as an MCAP file, for Foxglove and other programs that read MCAP. [`write`](write()) writes episodes that are
//! over, a [`Recorder`] those that run.
//!
//! One channel per kind of message, JSON with a JSON schema each:
//!
//! | topic | when | what |
//! |---|---|---|
//! | `/episode` | at the start of each | instruction, number, decision rule; outcome, where it is over |
//! | `/observation` | every control step | what the policy saw, in the contract's units |
//! | `/images/NAME` | every control step, for each camera | its frame, as Foxglove's `CompressedImage` in PNG |
//! | `/action` | every control step | what it answered, and what was executed |
//! | `/plan` | every control step | plan in force, null of a policy that selects none; whether decided now, margin |
//! | `/logits` | every decision | the scores, one per plan |
//! | `/timing` | every control step | time inside the controller |
//! | `/gripper` | every control step, where the environment has one | position |
//! | `/completion` | when it happens | sub-task |
//!
//! Log time is simulated time; episodes follow each other with a second between them. Metadata `lads` names bundle, environment, seed, noise,
//! faults and versions. Numbers are written so that they read back bit for bit. Chunks carry checksums and are not compressed, which keeps
//! C libraries out of the build.
//!
//! What can fail: the disk; and reading a file that is truncated, damaged or not a log.
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

pub mod png;
mod read;
mod schema;
#[cfg(test)]
mod tests;
pub mod trace;
mod write;

use std::collections::BTreeMap;

use lads_core::{Channel, DType, Policy};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::trace::Trace;

pub use read::read;
pub use write::{Recorder, write};

/// Version of the messages; it changes when a message changes its meaning or is removed.
///
/// Versions 1 and 2 are read too. Version 1 has names of elements with spaces between them, later ones have them as a JSON array; of both,
/// an episode's message always has its steps and success.
pub const FORMAT_VERSION: u32 = 3;

/// Name of the metadata record.
const METADATA: &str = "lads";

/// Metadata key of [`Origin::period`].
const PERIOD: &str = "horizon";

/// Origin of a log: everything that its episodes depend on besides themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct Origin {
    /// SHA-256 of the bundle's contract and weights, as the contract states it.
    pub bundle_sha256: String,
    /// Id of the environment.
    pub environment: String,
    /// Version of the environment's behaviour.
    pub environment_version: String,
    /// Seed of the run.
    pub seed: u64,
    /// Observation noise, in the environment's words.
    pub noise: String,
    /// Time between two control steps, in seconds.
    pub control_period_s: f64,
    /// Number of control steps per plan; `None` for a policy that selects none.
    pub period: Option<usize>,
    /// Names of the elements of an observation.
    pub observation_names: Vec<String>,
    /// Names of the elements of an action.
    pub action_names: Vec<String>,
    /// Further facts: faults, versions.
    pub notes: BTreeMap<String, String>,
}

impl Origin {
    /// Makes the origin of a log of a policy, under no noise: names of several channels' elements begin with their channel's.
    pub fn of(policy: &Policy<'_>) -> Self {
        let contract = policy.contract();
        let vectors: Vec<_> = contract
            .observations()
            .filter(|channel| channel.dtype() != DType::U8)
            .collect();
        let observation_names = match &vectors[..] {
            [only] => names(only),
            several => {
                let named = several.iter().flat_map(|channel| {
                    let of = channel.name();
                    names(channel)
                        .into_iter()
                        .map(move |name| format!("{of}.{name}"))
                });
                named.collect()
            }
        };
        Self {
            bundle_sha256: contract.bundle_sha256().to_owned(),
            environment: contract.environment_id().to_owned(),
            environment_version: contract.environment_version().to_owned(),
            seed: 0,
            noise: "none".to_owned(),
            control_period_s: f64::from(contract.control_period_s()),
            period: lads_host::schedule::plan_period(policy),
            observation_names,
            action_names: names(&contract.action()),
            notes: BTreeMap::new(),
        }
    }
}

/// Returns the names of a channel's elements, made of its own where they have none.
fn names(channel: &Channel<'_>) -> Vec<String> {
    let named = channel.elements().map(|element| element.name.to_owned());
    let named: Vec<_> = named.collect();
    if named.is_empty() {
        let name = channel.name();
        return (0..channel.len()).map(|i| format!("{name}{i}")).collect();
    }
    named
}

/// A recorded episode with the instruction's words, which outlive its index.
#[derive(Debug, Clone, PartialEq)]
pub struct Flight {
    /// Id of the instruction in the contract.
    pub instruction_id: String,
    /// Text of the instruction.
    pub instruction_text: String,
    /// Word embeddings `[n, E]` that the policy was given; `None` if they were the bundle's own.
    pub words: Option<Vec<f32>>,
    /// Names of the completed sub-tasks, in the order of `trace.outcome.completions`.
    pub completed: Vec<String>,
    /// Control steps and outcome of the episode. In a trace read from a log, a completion's
    /// sub-task is its index in `completed`.
    pub trace: Trace,
}

/// Content of a log.
#[derive(Debug, Clone, PartialEq)]
pub struct Log {
    /// Origin of the episodes.
    pub origin: Origin,
    /// Episodes of the log.
    pub flights: Vec<Flight>,
}

/// Reason why a log could not be read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LogError {
    /// The file cannot be read.
    #[error("it cannot be read ({0})")]
    Io(#[from] std::io::Error),
    /// The file is not an MCAP file, or truncated, or damaged.
    #[error("it is not a complete MCAP file ({0}); record it again")]
    Mcap(#[from] mcap::McapError),
    /// The file is MCAP, but not a log that [`write()`] makes.
    #[error("it is not a log of lads ({0}); record one")]
    Foreign(String),
}

/// Beginning of the topics of cameras, before the channel's name.
const IMAGES: &str = "/images/";

/// Message of a camera's topic, in the form that Foxglove shows: its schema `foxglove.CompressedImage`.
#[derive(Debug, Serialize, Deserialize)]
struct ImageMessage {
    timestamp: Time,
    frame_id: String,
    /// The file in base64.
    data: String,
    format: String,
}

/// Time of a message of Foxglove.
#[derive(Debug, Serialize, Deserialize)]
struct Time {
    sec: u32,
    nsec: u32,
}

/// Message of the topic `/episode`.
#[derive(Debug, Serialize, Deserialize)]
struct EpisodeMessage {
    instruction: u32,
    instruction_id: String,
    instruction_text: String,
    /// Words of an instruction that the language encoder encoded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    words: Option<Vec<f32>>,
    episode: u32,
    /// Seed of the sampling in decimal digits: a JSON number would lose bits in JavaScript.
    sampling_seed: Option<String>,
    /// Seed of the policy's other random draws, in decimal digits; left out if there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    noise_seed: Option<String>,
    commanded: bool,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    continued: bool,
    /// Left out, like `success`, where the episode was recorded while it ran.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    steps: Option<usize>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    success: Option<bool>,
}

/// Message of the topics `/observation` and `/logits`.
#[derive(Debug, Serialize, Deserialize)]
struct Values {
    values: Vec<f32>,
}

/// Message of the topic `/action`.
#[derive(Debug, Serialize, Deserialize)]
struct ActionMessage {
    policy: Vec<f32>,
    executed: Vec<f32>,
}

/// Message of the topic `/plan`.
#[derive(Debug, Serialize, Deserialize)]
struct PlanMessage {
    index: Option<u32>,
    decided: bool,
    margin: Option<f32>,
}

/// Message of the topic `/timing`.
#[derive(Debug, Serialize, Deserialize)]
struct TimingMessage {
    controller_ns: u64,
}

/// Message of the topic `/gripper`, in metres.
#[derive(Debug, Serialize, Deserialize)]
struct GripperMessage {
    x: f64,
    y: f64,
    z: f64,
}

/// Message of the topic `/completion`.
#[derive(Debug, Serialize, Deserialize)]
struct CompletionMessage {
    sub_task: String,
    step: usize,
}
