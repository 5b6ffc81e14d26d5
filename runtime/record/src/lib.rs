//! The flight recorder: episodes as an MCAP file, for Foxglove and whatever else reads MCAP. `lads-run replay` computes a log of
//! `lads-run --log` again.
//!
//! One channel per kind of message, JSON with a JSON schema each:
//!
//! | topic | when | what |
//! |---|---|---|
//! | `/episode` | at the start of each | instruction, number, decision rule, outcome |
//! | `/observation` | every control step | what the policy saw, in the contract's units |
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
//! What can fail: the disk; and reading a file that is cut off, damaged or something else.
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod read;
mod schema;
#[cfg(test)]
mod tests;
pub mod trace;
mod write;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::trace::Trace;

pub use read::read;
pub use write::write;

/// Version of the messages; changes when one changes its meaning or goes.
///
/// Version 1, which is read too, has names of elements with spaces between them; version 2 has them as a JSON array.
pub const FORMAT_VERSION: u32 = 2;

/// Name of the metadata record.
const METADATA: &str = "lads";

/// Its key for [`Origin::period`].
const PERIOD: &str = "horizon";

/// What the episodes of a log depend on besides themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct Origin {
    /// sha256 of the bundle's contract and weights, as the contract has it.
    pub bundle_sha256: String,
    /// The environment's id.
    pub environment: String,
    /// Version of its behaviour.
    pub environment_version: String,
    /// Seed of the run.
    pub seed: u64,
    /// Observation noise, in the environment's words.
    pub noise: String,
    /// Time between two control steps, in seconds.
    pub control_period_s: f64,
    /// Control steps per plan; `None` of a policy that selects none.
    pub period: Option<usize>,
    /// Names of the elements of an observation.
    pub observation_names: Vec<String>,
    /// Names of the elements of an action.
    pub action_names: Vec<String>,
    /// Everything else that is worth knowing: faults, versions.
    pub notes: BTreeMap<String, String>,
}

/// A recorded episode with the instruction's words, which outlive its index.
#[derive(Debug, Clone, PartialEq)]
pub struct Flight {
    /// The instruction's id in the contract.
    pub instruction_id: String,
    /// Its text.
    pub instruction_text: String,
    /// Word embeddings `[n, E]` that were heard; `None` where they were the bundle's own.
    pub words: Option<Vec<f32>>,
    /// Names of the completed sub-tasks, in the order of `trace.outcome.completions`.
    pub completed: Vec<String>,
    /// The control steps and what they came to. Read from a log, a completion's sub-task is its place in `completed`.
    pub trace: Trace,
}

/// A log.
#[derive(Debug, Clone, PartialEq)]
pub struct Log {
    /// Where it comes from.
    pub origin: Origin,
    /// Its episodes.
    pub flights: Vec<Flight>,
}

/// Why a log could not be read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LogError {
    /// The file cannot be read.
    #[error("it cannot be read ({0})")]
    Io(#[from] std::io::Error),
    /// It is no MCAP file, or cut off, or damaged.
    #[error("it is no whole MCAP file ({0}); record it again")]
    Mcap(#[from] mcap::McapError),
    /// It is MCAP, but not what [`write()`] makes.
    #[error("it is no log of lads ({0}); record one with lads-run --log")]
    Foreign(String),
}

/// `/episode`.
#[derive(Debug, Serialize, Deserialize)]
struct EpisodeMessage {
    instruction: u32,
    instruction_id: String,
    instruction_text: String,
    /// Of an instruction that the language encoder heard.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    words: Option<Vec<f32>>,
    episode: u32,
    /// In decimal digits: a JSON number would lose bits in JavaScript.
    sampling_seed: Option<String>,
    /// The same, of what else the policy draws at random; left out where it draws nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    noise_seed: Option<String>,
    commanded: bool,
    steps: usize,
    success: bool,
}

/// `/observation` and `/logits`.
#[derive(Debug, Serialize, Deserialize)]
struct Values {
    values: Vec<f32>,
}

/// `/action`.
#[derive(Debug, Serialize, Deserialize)]
struct ActionMessage {
    policy: Vec<f32>,
    executed: Vec<f32>,
}

/// `/plan`.
#[derive(Debug, Serialize, Deserialize)]
struct PlanMessage {
    index: Option<u32>,
    decided: bool,
    margin: Option<f32>,
}

/// `/timing`.
#[derive(Debug, Serialize, Deserialize)]
struct TimingMessage {
    controller_ns: u64,
}

/// `/gripper`, in metres.
#[derive(Debug, Serialize, Deserialize)]
struct GripperMessage {
    x: f64,
    y: f64,
    z: f64,
}

/// `/completion`.
#[derive(Debug, Serialize, Deserialize)]
struct CompletionMessage {
    sub_task: String,
    step: usize,
}
