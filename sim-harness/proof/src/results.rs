//! What a run of episodes reports, and its JSON form (documented in results.schema.json).
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

/// How plans were chosen.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DecisionUsed {
    /// `argmax` or `sample`; `uniform` where actions were drawn at random and no plan was chosen.
    pub rule: String,
    /// Temperature of the softmax that is sampled; `None` for argmax.
    pub temperature: Option<f32>,
}

/// Which environment the rollouts ran in.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EnvironmentUsed {
    /// The contract's environment id.
    pub id: String,
    /// Its version.
    pub version: String,
    /// Control period, in seconds.
    pub control_period_s: f64,
    /// Longest episode, in control steps.
    pub max_steps: usize,
}

/// What a sentence outside the table is most like.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NearestKnown {
    /// Id of the known instruction.
    pub id: String,
    /// Its text.
    pub text: String,
    /// Similarity of the sentence to it, from -1 to 1.
    pub similarity: f32,
    /// Similarity from which on the bundle follows a sentence; `None` where its contract does not say.
    pub threshold: Option<f32>,
    /// Whether the bundle accepts the sentence; if not, the caller insisted.
    pub accepted: bool,
}

/// Who made the word embeddings, where they are not the bundle's own.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HeardBy {
    /// Name of the language encoder.
    pub encoder: String,
    /// SHA-256 of its weights, in hexadecimal digits.
    pub sha256: String,
    /// Largest difference of an element from the bundle's table; `None` for a sentence outside it.
    pub largest_difference: Option<f32>,
    /// What a sentence outside the table is most like; left out for known instructions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nearest: Option<NearestKnown>,
}

/// The whole report of one `lads-run`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Results {
    /// [`FORMAT`].
    pub format: &'static str,
    /// [`FORMAT_VERSION`].
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
    /// How plans were chosen.
    pub decision: DecisionUsed,
    /// Episodes asked for per instruction.
    pub episodes_per_instruction: u32,
    /// Who made the word embeddings; left out where they are the bundle's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heard_by: Option<HeardBy>,
    /// What was wrong between policy and environment; left out without faults.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub faults: Option<Faults>,
    /// Whether the policy followed plans that were given; left out where it decided.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub plans_commanded: bool,
    /// Plans in force against plans encoded from what was executed; left out where not asked for.
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
    /// Where the time went.
    pub time: TimeUse,
}

/// How often the encoder sees, in what was executed, the plan that was in force.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Agreement {
    /// Segments encoded as their plan.
    pub agreed: usize,
    /// Segments in all: as long as the encoder reads.
    pub segments: usize,
    /// Wilson 95 % interval of their share.
    pub interval: Option<Interval>,
    /// For each plan that was in force, ascending: which plans its segments were encoded as, and how often.
    pub encoded_as: BTreeMap<u32, BTreeMap<u32, usize>>,
}
