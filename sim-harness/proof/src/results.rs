//! Results of a run of episodes, and their JSON form (documented in results.schema.json).
//!
//! Invariants: everything but `latency_us` and `time` depends only on bundle, seed, noise, decision and versions, whatever the number of threads.
//! Nothing here can fail.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::faults::Faults;
use crate::metrics::Interval;
use crate::scores::{InstructionResult, Splits};
use crate::timing::{LatencyByKind, TimeUse};

/// Value of the JSON's `format`.
pub const FORMAT: &str = "lads-results";

/// Version of the JSON form; changes when a field changes its meaning or goes.
pub const FORMAT_VERSION: u32 = 1;

/// Rule by which plans were chosen.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DecisionUsed {
    /// Name of the rule: `argmax` or `sample`; `uniform` where actions were drawn at random and no plan was chosen.
    pub rule: String,
    /// Temperature of the softmax that is sampled; `None` for argmax.
    pub temperature: Option<f32>,
}

/// Environment of the rollouts.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EnvironmentUsed {
    /// Id of the environment, as in the contract.
    pub id: String,
    /// Version of the environment.
    pub version: String,
    /// Control period, in seconds.
    pub control_period_s: f64,
    /// Number of control steps of the longest episode.
    pub max_steps: usize,
}

/// The known instruction that a sentence outside the table is most like.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NearestKnown {
    /// Id of the known instruction.
    pub id: String,
    /// Text of the known instruction.
    pub text: String,
    /// Similarity of the sentence to the known instruction, from -1 to 1.
    pub similarity: f32,
    /// Similarity from which on the bundle follows a sentence; `None` where its contract has no threshold.
    pub threshold: Option<f32>,
    /// Whether the bundle accepts the sentence; if not, the caller insisted.
    pub accepted: bool,
}

/// The language encoder that made the word embeddings, where they are not the bundle's own.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HeardBy {
    /// Name of the language encoder.
    pub encoder: String,
    /// SHA-256 of the encoder's weights, in hexadecimal digits.
    pub sha256: String,
    /// Largest difference of an element from the bundle's table; `None` for a sentence outside it.
    pub largest_difference: Option<f32>,
    /// Known instruction that a sentence outside the table is most like; absent for known instructions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nearest: Option<NearestKnown>,
}

/// Results of one `lads-run`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Results {
    /// Always [`FORMAT`].
    pub format: &'static str,
    /// Always [`FORMAT_VERSION`].
    pub format_version: u32,
    /// Environment of the rollouts.
    pub environment: EnvironmentUsed,
    /// SHA-256 of the bundle file, in hexadecimal digits.
    pub bundle_sha256: String,
    /// SHA-256 of the program image that ran.
    pub image_sha256: String,
    /// Seed of all random streams.
    pub seed: u64,
    /// Noise level of the environment.
    pub noise: String,
    /// Rule by which plans were chosen.
    pub decision: DecisionUsed,
    /// Episodes asked for per instruction.
    pub episodes_per_instruction: u32,
    /// Encoder of the word embeddings; absent where they are the bundle's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heard_by: Option<HeardBy>,
    /// Faults between policy and environment; absent without faults.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub faults: Option<Faults>,
    /// Whether the policy followed given plans; absent where it decided.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub plans_commanded: bool,
    /// Agreement of plans in force with plans encoded from what was executed; absent where not asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub plan_agreement: Option<Agreement>,
    /// Versions of what the numbers depend on, by name.
    pub versions: BTreeMap<String, String>,
    /// Scores by split.
    pub splits: Splits,
    /// Results by instruction, in the contract's order.
    pub instructions: Vec<InstructionResult>,
    /// Latency of the controller.
    pub latency_us: LatencyByKind,
    /// Use of time.
    pub time: TimeUse,
}

/// Agreement of the plans in force with those that the encoder sees in what was executed.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Agreement {
    /// Number of segments encoded as the plan that was in force.
    pub agreed: usize,
    /// Number of segments, each as long as the encoder reads.
    pub segments: usize,
    /// Wilson 95 % interval of the share of agreeing segments.
    pub interval: Option<Interval>,
    /// Counts, for each plan that was in force, ascending, of the plans that its segments were encoded as.
    pub encoded_as: BTreeMap<u32, BTreeMap<u32, usize>>,
}
