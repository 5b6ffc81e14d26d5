//! The contract of a bundle: what the policy expects and promises, as JSON in the model's metadata.
//!
//! [`Contract::parse`] checks it as a whole: every field there, every number in its range, no name twice. Fields that this
//! version does not know are skipped; a change of meaning changes the version.

use std::collections::HashSet;

use serde::Deserialize;

use crate::error::BundleError;

/// Version of the contract that this crate reads.
pub const CONTRACT_VERSION: u32 = 1;

/// What kind of policy a bundle holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Learned alignment of discrete skills.
    Lads,
}

/// The environment that the policy was made for.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Environment {
    /// For example `franka-kitchen`.
    pub id: String,
    /// Version of the environment.
    pub version: String,
}

/// The codebook of latent plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Codebook {
    /// Entries, `M`.
    pub size: usize,
    /// Elements of an entry, `D`.
    pub dim: usize,
}

/// How a plan is picked from the logits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// The largest logit.
    Argmax,
    /// At random with the softmax of the logits over the temperature.
    Sample,
}

/// The decision rule and its parameters.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Decision {
    /// How a plan is picked.
    pub rule: Rule,
    /// Divides the logits when sampling.
    pub temperature: f32,
    /// Seed of the sampling.
    pub seed: u64,
}

/// One element of the observation or the action.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Element {
    /// Name.
    pub name: String,
    /// Unit, `1` for none.
    pub unit: String,
    /// Smallest value.
    pub min: f32,
    /// Largest value.
    pub max: f32,
    /// The joint that it belongs to.
    #[serde(default)]
    pub joint: Option<String>,
}

/// Order of the components of quaternions in the observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum QuaternionOrder {
    /// There are none.
    None,
    /// Scalar first.
    Wxyz,
    /// Scalar last.
    Xyzw,
}

/// What happens when the context is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Beyond {
    /// The words stay, time starts again at 0.
    Restart,
    /// The step is refused.
    Refuse,
}

/// What the transformer's context holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Context {
    /// Words of the longest instruction, `L`.
    pub words: usize,
    /// Control steps.
    pub steps: usize,
    /// What happens then.
    pub beyond: Beyond,
}

/// A known instruction; its position is its index in the table.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Instruction {
    /// Short name.
    pub id: String,
    /// What the person says.
    pub text: String,
    /// The sub-tasks that it asks for.
    pub sub_tasks: Vec<String>,
    /// Name of the set that it belongs to in evaluations: `seen` and `unseen`, or the benchmark's own names.
    pub split: String,
}

/// What becomes of the words of an instruction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Pooling {
    /// Each is heard.
    #[default]
    None,
    /// The mean of the encoder's last layer over all tokens is heard, as one word.
    Mean,
}

/// How the likeness of a sentence and a known instruction is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Similarity {
    /// [`lads_core::similarity::alignment`].
    Alignment,
}

/// Which sentences outside the table of instructions are followed, as the exporter calibrated it.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Acceptance {
    /// The measure.
    pub similarity: Similarity,
    /// Similarity to the nearest known instruction from which on a sentence is followed.
    pub threshold: f32,
    /// Share of the calibration's sentences that ask for what the policy knows that it accepts.
    pub accepted_known: f32,
    /// Share of the calibration's sentences that ask for something else, or for nothing, that it accepts all the same.
    pub accepted_other: f32,
}

/// The language encoder that made the word embeddings.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Language {
    /// Its name.
    pub encoder: String,
    /// SHA-256 of its weights.
    pub sha256: String,
    /// Elements of a word embedding, `E`.
    pub dim: usize,
    /// The hidden layer that is read; negative counts from the last.
    pub layer: i32,
    /// What becomes of the words; left out, nothing.
    #[serde(default)]
    pub pooling: Pooling,
    /// Which sentences outside the table are followed; left out, none without the caller's insistence.
    #[serde(default)]
    pub acceptance: Option<Acceptance>,
}

/// Sizes of the transformer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Network {
    /// Layers.
    pub layers: usize,
    /// Attention heads.
    pub heads: usize,
    /// Elements per head.
    pub head_dim: usize,
}

/// What a policy expects and promises.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Contract {
    /// Version of the contract's form.
    pub version: u32,
    /// Kind of policy.
    pub kind: Kind,
    /// The environment.
    pub environment: Environment,
    /// Time from one control step to the next, in seconds.
    pub control_period_s: f32,
    /// Control steps from one decision to the next, `H`.
    pub horizon: usize,
    /// The codebook of latent plans.
    pub codebook: Codebook,
    /// How plans are picked.
    pub decision: Decision,
    /// The observation's elements.
    pub observation: Vec<Element>,
    /// The action's elements.
    pub action: Vec<Element>,
    /// Order of quaternions in the observation.
    pub quaternion_order: QuaternionOrder,
    /// The transformer's context.
    pub context: Context,
    /// The known instructions.
    pub instructions: Vec<Instruction>,
    /// The language encoder.
    pub language: Language,
    /// The transformer.
    pub network: Network,
    /// How the policy was trained: anything that the exporter wrote.
    pub provenance: serde_json::Value,
}

/// The largest length that a contract may claim. Generous, and small enough that products of a few fit 64 bits.
const MAX_LEN: usize = 1 << 20;

impl Contract {
    /// Reads and checks a contract.
    pub fn parse(json: &str) -> Result<Self, BundleError> {
        let refused = |problem: String| BundleError::Contract {
            problem: problem.into(),
        };
        let value: serde_json::Value =
            serde_json::from_str(json).map_err(|error| refused(format!("is no JSON: {error}")))?;
        let version = value
            .get("version")
            .ok_or_else(|| refused("missing field `version`".into()))?;
        if version.as_u64() != Some(u64::from(CONTRACT_VERSION)) {
            return Err(BundleError::ContractVersion {
                found: version.to_string().into(),
                supported: CONTRACT_VERSION,
            });
        }
        // From the text, so that the error tells where.
        let contract: Self =
            serde_json::from_str(json).map_err(|error| refused(error.to_string()))?;
        contract.check().map_err(refused)?;
        Ok(contract)
    }

    fn check(&self) -> Result<(), String> {
        let lengths = [
            ("horizon", self.horizon),
            ("codebook.size", self.codebook.size),
            ("codebook.dim", self.codebook.dim),
            ("observation", self.observation.len()),
            ("action", self.action.len()),
            ("context.words", self.context.words),
            ("context.steps", self.context.steps),
            ("instructions", self.instructions.len()),
            ("language.dim", self.language.dim),
            ("network.layers", self.network.layers),
            ("network.heads", self.network.heads),
            ("network.head_dim", self.network.head_dim),
        ];
        for (field, len) in lengths {
            if !(1..=MAX_LEN).contains(&len) {
                return Err(format!(
                    "field `{field}` is {len}, it must be 1 to {MAX_LEN}"
                ));
            }
        }
        for (field, value) in [
            ("control_period_s", self.control_period_s),
            ("decision.temperature", self.decision.temperature),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(format!("field `{field}` is {value}, it must be positive"));
            }
        }
        if let Some(acceptance) = &self.language.acceptance {
            acceptance.check()?;
        }
        elements("observation", &self.observation)?;
        elements("action", &self.action)?;
        for (i, known) in self.instructions.iter().enumerate() {
            for (part, value) in [("text", &known.text), ("split", &known.split)] {
                if value.trim().is_empty() {
                    return Err(format!("field `instructions[{i}].{part}` is empty"));
                }
            }
        }
        // Texts may repeat: benchmarks ask for the same in other words, and for the same words by other measures.
        let ids = self.instructions.iter().map(|known| known.id.as_str());
        distinct("instructions", "id", ids)
    }
}

impl Acceptance {
    fn check(&self) -> Result<(), String> {
        for (part, value, least) in [
            ("threshold", self.threshold, -1.0),
            ("accepted_known", self.accepted_known, 0.0),
            ("accepted_other", self.accepted_other, 0.0),
        ] {
            if !(least..=1.0).contains(&value) {
                return Err(format!(
                    "field `language.acceptance.{part}` is {value}, it must be {least} to 1"
                ));
            }
        }
        Ok(())
    }
}

fn elements(field: &str, elements: &[Element]) -> Result<(), String> {
    for (i, element) in elements.iter().enumerate() {
        let Element { name, min, max, .. } = element;
        if !(min.is_finite() && max.is_finite() && min < max) {
            return Err(format!(
                "field `{field}[{i}]` ({name}) has limits {min} to {max}, which is no range"
            ));
        }
    }
    distinct(
        field,
        "name",
        elements.iter().map(|element| element.name.as_str()),
    )
}

fn distinct<'a>(
    field: &str,
    part: &str,
    names: impl Iterator<Item = &'a str>,
) -> Result<(), String> {
    let mut seen = HashSet::new();
    for (i, name) in names.enumerate() {
        if name.trim().is_empty() {
            return Err(format!("field `{field}[{i}].{part}` is empty"));
        }
        if !seen.insert(name) {
            return Err(format!("field `{field}[{i}].{part}` repeats \"{name}\""));
        }
    }
    Ok(())
}
