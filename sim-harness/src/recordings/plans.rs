//! Sequences of plans: got from recorded episodes by the trajectory encoder, stored in a file, and given to the low level to follow.
//!
//! The encoder maps one horizon of observations and actions to the codebook entry that it was trained to be (the paper's equation 2 and the
//! nearest entry of the codebook). Steps of a recording beyond its last full horizon have the plan of the horizon that ends with the last
//! step, so that whoever follows the plans acts until the recording's end. What can fail: a policy without an encoder, a recording of other lengths, a file that is none or asks for what the policy does not have.

use std::collections::BTreeMap;
use std::path::Path;

use lads_compiler::{Memory, MemoryError};
use lads_core::{Contract, EncodeError, Policy};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::trace::{Step, Trace};
use lads_proof::metrics::wilson;
pub use lads_proof::results::Agreement;

/// Value of the file's `format`.
pub const FORMAT: &str = "lads-plans";

/// Version of the file's form.
pub const FORMAT_VERSION: u32 = 1;

/// The plans of one episode, as in a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanSequence {
    /// The instruction, by its text or its id in the contract.
    pub instruction: String,
    /// Number of the episode; left out, the plans are for every episode of the instruction.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub episode: Option<u32>,
    /// Indices into the codebook, one per horizon.
    pub plans: Vec<u32>,
}

/// A file of plans.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanFile {
    /// [`FORMAT`].
    pub format: String,
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// Control steps that each plan is for.
    pub horizon: usize,
    /// The sequences.
    pub episodes: Vec<PlanSequence>,
}

/// Why plans cannot be had or followed.
#[derive(Debug, Error)]
pub enum PlanError {
    /// The file cannot be read.
    #[error("{0}")]
    Read(std::io::Error),
    /// It is no file of plans.
    #[error("it is no {FORMAT} file of version {FORMAT_VERSION} ({0})")]
    Form(String),
    /// It was made for another horizon.
    #[error("its plans are for {file} control steps each, the policy's for {policy}")]
    Horizon {
        /// What the file says.
        file: usize,
        /// The policy's.
        policy: usize,
    },
    /// The policy does not know an instruction.
    #[error("the policy does not know the instruction '{0}'")]
    Instruction(String),
    /// A plan is not in the codebook.
    #[error("plan {plan} of '{instruction}': the codebook has {size}")]
    Plan {
        /// The plan.
        plan: u32,
        /// Whose it is.
        instruction: String,
        /// Entries of the codebook.
        size: usize,
    },
    /// A sequence has no plans.
    #[error("'{0}' has no plans")]
    Empty(String),
    /// The same episode twice.
    #[error("'{0}' has plans for the same episode twice")]
    Twice(String),
    /// There is no memory for the policy's controller.
    #[error(transparent)]
    Memory(MemoryError),
    /// The encoder refused.
    #[error("the trajectory encoder: {0}")]
    Encode(EncodeError),
}

/// Plans by instruction and episode, checked against a policy.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PlanBook {
    sequences: BTreeMap<(u32, Option<u32>), Vec<u32>>,
}

impl PlanFile {
    /// Plans of episodes, one sequence each.
    pub fn new(horizon: usize, episodes: Vec<PlanSequence>) -> Self {
        Self {
            format: FORMAT.to_owned(),
            format_version: FORMAT_VERSION,
            horizon,
            episodes,
        }
    }

    /// Reads a file.
    pub fn read(path: &Path) -> Result<Self, PlanError> {
        let text = lads_host::input::read_to_string(path).map_err(PlanError::Read)?;
        let file: Self =
            serde_json::from_str(&text).map_err(|error| PlanError::Form(error.to_string()))?;
        if file.format != FORMAT || file.format_version != FORMAT_VERSION {
            let got = format!("it says {} {}", file.format, file.format_version);
            return Err(PlanError::Form(got));
        }
        Ok(file)
    }

    /// Checks every sequence against the policy's contract; `index` finds an instruction by its text or id.
    pub fn check(
        &self,
        contract: &Contract<'_>,
        index: impl Fn(&str) -> Option<u32>,
    ) -> Result<PlanBook, PlanError> {
        if self.horizon != contract.horizon() {
            return Err(PlanError::Horizon {
                file: self.horizon,
                policy: contract.horizon(),
            });
        }
        let size = contract.codebook_len();
        let mut sequences = BTreeMap::new();
        for sequence in &self.episodes {
            let name = || sequence.instruction.clone();
            let instruction =
                index(&sequence.instruction).ok_or_else(|| PlanError::Instruction(name()))?;
            if sequence.plans.is_empty() {
                return Err(PlanError::Empty(name()));
            }
            if let Some(&plan) = sequence.plans.iter().find(|&&plan| plan as usize >= size) {
                return Err(PlanError::Plan {
                    plan,
                    instruction: name(),
                    size,
                });
            }
            let key = (instruction, sequence.episode);
            if sequences.insert(key, sequence.plans.clone()).is_some() {
                return Err(PlanError::Twice(name()));
            }
        }
        Ok(PlanBook { sequences })
    }
}

impl PlanBook {
    /// The plans of an episode: its own, or those for every episode of the instruction.
    pub fn of(&self, instruction: u32, episode: u32) -> Option<&[u32]> {
        let own = self.sequences.get(&(instruction, Some(episode)));
        own.or_else(|| self.sequences.get(&(instruction, None)))
            .map(Vec::as_slice)
    }

    /// Whether it has plans for an instruction.
    pub fn knows(&self, instruction: u32) -> bool {
        self.sequences
            .keys()
            .any(|&(known, _)| known == instruction)
    }
}

/// The plan that the trajectory encoder sees in each horizon of a recording; what was executed counts, not what was asked for.
///
/// Steps beyond the last full horizon are the end of one more, which begins earlier: every step has a plan, unless the recording is
/// shorter than one horizon, which has none.
pub fn encode<'t>(
    policy: &Policy<'_>,
    recordings: impl IntoIterator<Item = &'t [Step]>,
) -> Result<Vec<Vec<u32>>, PlanError> {
    let horizon = policy.contract().horizon();
    let mut memory = Memory::of(policy).map_err(PlanError::Memory)?;
    let mut controller = memory.controller(policy).map_err(PlanError::Memory)?;
    let mut of_segment = |segment: &[Step]| {
        let observations: Vec<f32> = segment.iter().flat_map(|s| s.observation.clone()).collect();
        let actions: Vec<f32> = segment.iter().flat_map(|s| s.executed.clone()).collect();
        let plan = controller.encode(&observations, &actions);
        plan.map(|plan| plan.0).map_err(PlanError::Encode)
    };
    recordings
        .into_iter()
        .map(|steps| {
            let whole = steps.chunks_exact(horizon);
            let last = steps.len().checked_sub(horizon);
            let tail = last.filter(|_| !whole.remainder().is_empty());
            let tail = tail.and_then(|from| steps.get(from..));
            whole.chain(tail).map(&mut of_segment).collect()
        })
        .collect()
}

/// Encodes every executed segment and compares with the plan that was in force.
pub fn agreement(policy: &Policy<'_>, traces: &[Trace]) -> Result<Agreement, PlanError> {
    let encoded = encode(policy, traces.iter().map(|trace| trace.steps.as_slice()))?;
    let horizon = policy.contract().horizon();
    let mut total = Agreement::default();
    for (trace, encoded) in traces.iter().zip(&encoded) {
        // Without the tail's plan: its horizon has steps of two plans.
        for (segment, &plan) in trace.steps.chunks_exact(horizon).zip(encoded) {
            let commanded = segment.first().map_or(plan, |step| step.plan);
            let of_plan = total.encoded_as.entry(commanded).or_default();
            *of_plan.entry(plan).or_default() += 1;
            total.segments += 1;
            total.agreed += usize::from(plan == commanded);
        }
    }
    total.interval = (total.segments > 0).then(|| wilson(total.agreed, total.segments));
    Ok(total)
}
