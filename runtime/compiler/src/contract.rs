//! The contract of a bundle: the policy's channels, states, instructions and family, as JSON in the
//! model's metadata.
//!
//! [`Contract::parse`] checks it as a whole: every field present, every number in its range, no
//! name twice. Fields that this version does not know are skipped; a change of meaning changes the
//! version.

mod channel;
mod check;
mod faults;
mod form;
mod language;

use lads_image::records::{NoiseRule, SelectionRule};
use serde::Deserialize;

use crate::error::BundleError;
use crate::family::Family;

pub(crate) use check::{all_free, roles_are_known};
pub(crate) use faults::Faults;
pub(crate) use form::REQUIRED;

pub use channel::{Channel, DType, Element, QuaternionOrder, Role};
pub use faults::Fault;
pub use language::{Acceptance, Language, Pooling, Similarity};

/// Version of the contract that this crate reads.
pub const CONTRACT_VERSION: u32 = 2;

/// The environment that the policy was made for.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Environment {
    /// Name of the environment, for example `franka-kitchen`.
    pub id: String,
    /// Version of the environment.
    pub version: String,
}

/// Way in which a state of a plain policy is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StateKind {
    /// Values replaced as a whole.
    Plain,
    /// Ring of the last rows.
    Ring,
}

/// Event that clears a state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClearedBy {
    /// The end of an episode.
    #[default]
    Episode,
    /// The start of another instruction.
    Instruction,
}

/// Content of the rows that a ring does not have yet.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fill {
    /// Rows of zeros.
    #[default]
    Zero,
    /// Copies of the oldest row.
    First,
}

/// State of a plain policy: memory that one control step leaves for the next.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct State {
    /// Name of the state; the graph reads it by this name and writes `next_NAME`.
    pub name: String,
    /// Way in which the state is stored.
    pub kind: StateKind,
    /// Shape of a plain state.
    #[serde(default)]
    pub shape: Vec<usize>,
    /// Number of rows of a ring.
    #[serde(default)]
    pub rows: usize,
    /// Channel whose values are appended to a ring in every step, before the graph runs.
    #[serde(default)]
    pub source: Option<String>,
    /// Content of a ring's missing rows.
    #[serde(default)]
    pub fill: Fill,
    /// Event that clears the state.
    #[serde(default)]
    pub cleared_by: ClearedBy,
}

/// Behaviour when the context is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Beyond {
    /// Keep the words and restart the time at 0.
    Restart,
    /// Refuse the step.
    Refuse,
}

/// Capacity of the transformer's context.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Context {
    /// Number of words of the longest instruction, `L`.
    pub words: usize,
    /// Number of control steps.
    pub steps: usize,
    /// Behaviour after that many control steps.
    pub beyond: Beyond,
}

/// A known instruction; its position is its index in the table.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Instruction {
    /// Short name of the instruction.
    pub id: String,
    /// The instruction as a person says it.
    pub text: String,
}

/// Evaluation of one instruction.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Evaluated {
    /// Names of the sub-tasks that the instruction asks for.
    pub sub_tasks: Vec<String>,
    /// Name of the split that the instruction belongs to: `seen` and `unseen`, or the benchmark's
    /// own names.
    pub split: String,
}

/// Evaluation of the policy; never part of an image.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
pub struct Evaluation {
    /// Evaluation of each instruction, in their order; or none at all.
    #[serde(default)]
    pub instructions: Vec<Evaluated>,
}

/// Sizes of the transformer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Network {
    /// Number of layers.
    pub layers: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// Number of elements per head.
    pub head_dim: usize,
}

/// The contract of a policy: its channels, states, instructions and family.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Contract {
    /// Version of the contract's format.
    pub version: u32,
    /// Family of policies that the policy belongs to, with that family's own fields.
    pub family: Family,
    /// Environment that the policy was made for.
    pub environment: Environment,
    /// Control period, the time from one control step to the next, in seconds.
    pub control_period_s: f32,
    /// Inputs and outputs of the policy.
    pub channels: Vec<Channel>,
    /// States of a plain policy.
    #[serde(default)]
    pub states: Vec<State>,
    /// Context of the transformer; without one, a policy runs without a bound on time.
    #[serde(default)]
    pub context: Option<Context>,
    /// Known instructions.
    #[serde(default)]
    pub instructions: Vec<Instruction>,
    /// Language encoder, for policies with instructions.
    #[serde(default)]
    pub language: Option<Language>,
    /// Transformer that reads the instruction.
    #[serde(default)]
    pub network: Option<Network>,
    /// Evaluation of the policy.
    #[serde(default)]
    pub evaluation: Evaluation,
    /// Record of how the policy was trained, in any form that the exporter wrote.
    pub provenance: serde_json::Value,
}

/// Largest length that a contract may claim. It is generous, and small enough that products of a
/// few lengths fit 64 bits.
pub(crate) const MAX_LEN: usize = 1 << 20;

/// Largest number of channels and of states that is looked at.
const MOST_PARTS: usize = 1024;

impl Contract {
    /// Reads and checks a contract.
    pub fn parse(json: &str) -> Result<Self, BundleError> {
        match Self::read(json)? {
            (Some(contract), faults) if faults.is_empty() => Ok(contract),
            (_, faults) => Err(BundleError::Contract {
                faults: faults.into_vec(),
            }),
        }
    }

    /// Reads a contract together with all its faults; it has sound values in place of those that
    /// cannot be read. Refuses only a contract of another version, whose remedy is another program.
    pub(crate) fn read(json: &str) -> Result<(Option<Self>, Faults), BundleError> {
        let mut faults = Faults::default();
        let value: serde_json::Value = match serde_json::from_str(json) {
            Ok(value) => value,
            Err(error) => {
                faults.add("lads.contract", format!("is not JSON: {error}"));
                return Ok((None, faults));
            }
        };
        if !value.is_object() {
            faults.add("lads.contract", "is no JSON object");
            return Ok((None, faults));
        }
        // Every channel is held against every other.
        for list in ["channels", "states"] {
            let found = value.get(list).and_then(serde_json::Value::as_array);
            if let Some(len) = found.map(Vec::len).filter(|&len| len > MOST_PARTS) {
                faults.add(
                    list,
                    format!("has {len}, it must have {MOST_PARTS} at most"),
                );
                return Ok((None, faults));
            }
        }
        match value
            .get("version")
            .map(|version| (version, version.as_f64()))
        {
            Some((_, Some(1.0))) => return Err(BundleError::ContractV1),
            Some((version, found)) if found != Some(f64::from(CONTRACT_VERSION)) => {
                return Err(BundleError::ContractVersion {
                    found: version.to_string().into(),
                    supported: CONTRACT_VERSION,
                });
            }
            _ => {}
        }
        let contract = match serde_json::from_str(json) {
            Ok(contract) => Some(contract),
            Err(error) => {
                let repaired = form::read(&value, &mut faults);
                // Read as parts it is sound, as with a field that stands twice.
                if faults.is_empty() {
                    faults.add("lads.contract", format!("cannot be read: {error}"));
                }
                repaired
            }
        };
        faults.form_is_read();
        if let Some(contract) = &contract {
            check::check(contract, &mut faults);
        }
        Ok((contract, faults))
    }

    /// Returns the channel with this name.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    /// Returns the channels that the caller gives in every control step, in their order.
    pub fn observations(&self) -> impl Iterator<Item = &Channel> {
        self.with(Role::Observation)
    }

    /// Returns the first channel that the caller gives in every control step, the only one of most
    /// policies.
    pub fn observation(&self) -> &Channel {
        self.known(Role::Observation)
    }

    /// Returns the action channel.
    pub fn action(&self) -> &Channel {
        self.known(Role::Action)
    }

    /// Returns the number of words of the longest instruction, and of elements of a word; `None`
    /// for a policy that takes none.
    pub fn words(&self) -> Option<[usize; 2]> {
        let channel = self.with(Role::Instruction).next()?;
        match channel.shape[..] {
            [words, dim] => Some([words, dim]),
            _ => None,
        }
    }

    /// Returns the number of control steps from one selection to the next; `None` for a policy that
    /// selects nothing.
    pub fn period(&self) -> Option<usize> {
        self.family.period()
    }

    /// Rule by which an index is picked from scores.
    pub fn decision(&self) -> lads_core::Decision {
        let selection = self.family.kind().selection();
        match selection.rule {
            SelectionRule::Argmax => lads_core::Decision::Argmax,
            SelectionRule::Sample => lads_core::Decision::Sample {
                temperature: selection.temperature,
                seed: selection.seed,
            },
        }
    }

    /// Source of the values of noise channels.
    pub fn noise(&self) -> lads_core::Noise {
        let noise = self.family.kind().noise();
        match noise.rule {
            NoiseRule::Zero => lads_core::Noise::Zero,
            NoiseRule::Seeded => lads_core::Noise::Seeded { seed: noise.seed },
        }
    }

    /// Returns the sub-tasks and the split of an instruction; empty where the bundle does not say.
    pub fn evaluated(&self, instruction: usize) -> (&[String], &str) {
        self.evaluation
            .instructions
            .get(instruction)
            .map_or((&[], ""), |found| (&found.sub_tasks, &found.split))
    }

    pub(crate) fn with(&self, role: Role) -> impl Iterator<Item = &Channel> {
        self.channels
            .iter()
            .filter(move |channel| channel.role == role)
    }

    fn known(&self, role: Role) -> &Channel {
        static NONE: Channel = Channel {
            name: String::new(),
            role: Role::Observation,
            dtype: DType::F32,
            shape: vec![],
            quaternion_order: QuaternionOrder::None,
            reference: String::new(),
            elements: vec![],
            min: None,
            max: None,
            rendering: None,
        };
        // Always there: a contract is checked when it is parsed.
        self.with(role).next().unwrap_or(&NONE)
    }
}
