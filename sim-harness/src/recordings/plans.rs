//! Sequences of plans: derived from recorded episodes by the trajectory encoder, stored in a file, and given to the policy to follow.
//!
//! The encoder maps a segment of observations and actions to the plan that it shows (the paper's equation 2 and the nearest plan). Steps of a
//! recording beyond its last full segment have the plan of the segment that ends with the last step, so that whoever follows the plans
//! acts until the recording's end. What can fail: a policy without an encoder or that follows no plans, a recording of other lengths, a
//! file that is not one or asks for what the policy does not have.

use std::collections::BTreeMap;
use std::path::Path;

use lads_core::{
    ChannelId, Contract, Controller, Data, EncodeError, FollowError, Isa, Policy, Role,
};
use lads_host::{Memory, MemoryError};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::rollout::Commanded;
use crate::trace::{Step, Trace};
use lads_proof::metrics::wilson;
pub use lads_proof::results::Agreement;

/// Value of the file's `format`.
pub const FORMAT: &str = "lads-plans";

/// Version of the file's form.
pub const FORMAT_VERSION: u32 = 1;

/// Name of the state that holds the vector of the plan in force, in every family that keeps one.
pub const VECTOR: &str = "plan";

/// Plans of one episode, as in a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanSequence {
    /// Instruction of the episode, by its text or its id in the contract.
    pub instruction: String,
    /// Number of the episode; left out, the plans are for every episode of the instruction.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub episode: Option<u32>,
    /// Indices of the plans.
    pub plans: Vec<u32>,
}

/// A file of plan sequences.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanFile {
    /// Always [`FORMAT`].
    pub format: String,
    /// Always [`FORMAT_VERSION`].
    pub format_version: u32,
    /// Number of control steps that each plan is for.
    #[serde(rename = "horizon")]
    pub period: usize,
    /// Sequences of plans, by episode.
    pub episodes: Vec<PlanSequence>,
}

/// Why plans cannot be derived or followed.
#[derive(Debug, Error)]
pub enum PlanError {
    /// The file cannot be read.
    #[error("{0}")]
    Read(std::io::Error),
    /// The file is not a file of plans.
    #[error("it is not a {FORMAT} file of version {FORMAT_VERSION} ({0})")]
    Form(String),
    /// The plans' period is not the policy's.
    #[error("its plans are for {file} control steps each, the policy's for {policy}")]
    Period {
        /// Period in the file, in control steps.
        file: usize,
        /// Period of the policy, in control steps.
        policy: usize,
    },
    /// The policy cannot follow plans.
    #[error("the policy follows no plans: {0}")]
    Follow(FollowError),
    /// The policy does not know an instruction.
    #[error("the policy does not know the instruction '{0}'")]
    Instruction(String),
    /// A plan's index is beyond the policy's codebook.
    #[error("plan {plan} of '{instruction}': the policy has {size}")]
    Plan {
        /// Index of the plan.
        plan: u32,
        /// Instruction of the plan's sequence.
        instruction: String,
        /// Number of plans of the policy.
        size: usize,
    },
    /// A sequence has no plans.
    #[error("'{0}' has no plans")]
    Empty(String),
    /// An episode has two sequences.
    #[error("'{0}' has plans for the same episode twice")]
    Twice(String),
    /// There is no memory for the policy's controller.
    #[error(transparent)]
    Memory(MemoryError),
    /// The trajectory encoder refused a segment.
    #[error("the trajectory encoder: {0}")]
    Encode(EncodeError),
}

/// Plans by instruction and episode, checked against a policy.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PlanBook {
    period: usize,
    sequences: BTreeMap<(u32, Option<u32>), Vec<u32>>,
}

impl PlanFile {
    /// Makes a file from sequences of plans, one per episode.
    pub fn new(period: usize, episodes: Vec<PlanSequence>) -> Self {
        Self {
            format: FORMAT.to_owned(),
            format_version: FORMAT_VERSION,
            period,
            episodes,
        }
    }

    /// Reads a plan file.
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

    /// Checks every sequence against the policy, which selects a plan every `period` control steps; `index` finds an instruction by its
    /// text or id.
    pub fn check(
        &self,
        policy: &Policy<'_>,
        period: Option<usize>,
        index: impl Fn(&str) -> Option<u32>,
    ) -> Result<PlanBook, PlanError> {
        let Some(period) = period.filter(|_| policy.follows()) else {
            return Err(PlanError::Follow(FollowError::NotOffered));
        };
        if self.period != period {
            return Err(PlanError::Period {
                file: self.period,
                policy: period,
            });
        }
        let size = policy.index_count() as usize;
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
        Ok(PlanBook { period, sequences })
    }
}

impl PlanBook {
    /// Returns the plans of an episode: its own, or those for every episode of the instruction.
    pub fn of(&self, instruction: u32, episode: u32) -> Option<Commanded<'_>> {
        let own = self.sequences.get(&(instruction, Some(episode)));
        let plans = own.or_else(|| self.sequences.get(&(instruction, None)))?;
        Some(Commanded {
            plans,
            period: self.period,
        })
    }

    /// Whether the book has plans for an instruction.
    pub fn knows(&self, instruction: u32) -> bool {
        self.sequences
            .keys()
            .any(|&(known, _)| known == instruction)
    }
}

/// Buffers of a trajectory encoder's input: a segment of observations and of actions.
#[derive(Debug, Clone, Copy)]
pub struct Segment {
    observations: ChannelId,
    actions: ChannelId,
    /// Number of control steps of a segment.
    pub steps: usize,
}

impl Segment {
    /// Makes the buffers for a policy; `None` if it has no trajectory encoder.
    pub fn of(policy: &Policy<'_>) -> Option<Self> {
        let contract: &Contract<'_> = policy.contract();
        let find = |name| {
            let channel = contract.find(name)?;
            (policy.encodes() && channel.role() == Role::Demonstration).then_some(channel)
        };
        let (observations, actions) = (find("observations")?, find("actions")?);
        let steps = *observations.shape().first()? as usize;
        Some(Self {
            observations: observations.id(),
            actions: actions.id(),
            steps,
        })
    }

    /// Returns the plan that the encoder sees in this segment.
    pub fn encode(
        &self,
        controller: &mut Controller<'_, '_>,
        observations: &[f32],
        actions: &[f32],
    ) -> Result<u32, EncodeError> {
        controller.encode(&[
            (self.observations, Data::F32(observations)),
            (self.actions, Data::F32(actions)),
        ])
    }
}

/// Encodes each segment of a recording as the plan that the trajectory encoder sees in it; executed actions count, not commanded ones.
///
/// Steps beyond the last full segment are the end of one more, which begins earlier: every step has a plan, unless the recording is
/// shorter than one segment, which has none.
pub fn encode<'t>(
    policy: &Policy<'_>,
    isa: Isa,
    recordings: impl IntoIterator<Item = &'t [Step]>,
) -> Result<Vec<Vec<u32>>, PlanError> {
    let encoder = Segment::of(policy).ok_or(PlanError::Encode(EncodeError::NoEncoder))?;
    let mut memory = Memory::of(policy).map_err(PlanError::Memory)?;
    let mut controller = memory
        .controller_with(policy, isa)
        .map_err(PlanError::Memory)?;
    let mut of_segment = |segment: &[Step]| {
        let observations: Vec<f32> = segment.iter().flat_map(|s| s.observation.clone()).collect();
        let actions: Vec<f32> = segment.iter().flat_map(|s| s.executed.clone()).collect();
        let plan = encoder.encode(&mut controller, &observations, &actions);
        plan.map_err(PlanError::Encode)
    };
    recordings
        .into_iter()
        .map(|steps| {
            let whole = steps.chunks_exact(encoder.steps);
            let last = steps.len().checked_sub(encoder.steps);
            let tail = last.filter(|_| !whole.remainder().is_empty());
            let tail = tail.and_then(|from| steps.get(from..));
            whole.chain(tail).map(&mut of_segment).collect()
        })
        .collect()
}

/// Encodes every executed segment and compares with the plan that was in force.
pub fn agreement(policy: &Policy<'_>, isa: Isa, traces: &[Trace]) -> Result<Agreement, PlanError> {
    let encoded = encode(
        policy,
        isa,
        traces.iter().map(|trace| trace.steps.as_slice()),
    )?;
    let encoder = Segment::of(policy).ok_or(PlanError::Encode(EncodeError::NoEncoder))?;
    let mut total = Agreement::default();
    for (trace, encoded) in traces.iter().zip(&encoded) {
        // Without the tail's plan: its segment has steps of two plans.
        for (segment, &plan) in trace.steps.chunks_exact(encoder.steps).zip(encoded) {
            let Some(commanded) = segment.first().and_then(|step| step.plan) else {
                continue;
            };
            let of_plan = total.encoded_as.entry(commanded).or_default();
            *of_plan.entry(plan).or_default() += 1;
            total.segments += 1;
            total.agreed += usize::from(plan == commanded);
        }
    }
    total.interval = (total.segments > 0).then(|| wilson(total.agreed, total.segments));
    Ok(total)
}
