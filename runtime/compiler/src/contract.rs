//! The contract of a bundle: what the policy expects and promises, as JSON in the model's metadata.
//!
//! [`Contract::parse`] checks it as a whole: every field there, every number in its range, no name twice. Fields that this
//! version does not know are skipped; a change of meaning changes the version.

mod channel;
mod language;

use std::collections::HashSet;

use serde::Deserialize;

use crate::error::BundleError;
use crate::family::{Family, RESERVED};

pub use channel::{Channel, DType, Element, QuaternionOrder, Role};
pub use language::{Acceptance, Language, Pooling, Similarity};

/// Version of the contract that this crate reads.
pub const CONTRACT_VERSION: u32 = 2;

/// The environment that the policy was made for.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Environment {
    /// For example `franka-kitchen`.
    pub id: String,
    /// Version of the environment.
    pub version: String,
}

/// How a state of a plain policy is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StateKind {
    /// As a whole.
    Plain,
    /// The last rows.
    Ring,
}

/// What clears a state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClearedBy {
    /// The end of an episode.
    #[default]
    Episode,
    /// Another instruction.
    Instruction,
}

/// What stands for rows that a ring does not have yet.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fill {
    /// Zeros.
    #[default]
    Zero,
    /// The oldest row.
    First,
}

/// A state of a plain policy: what of one control step the next one reads.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct State {
    /// Name; the graph reads it by this name and gives `next_NAME`.
    pub name: String,
    /// How it is kept.
    pub kind: StateKind,
    /// Shape of a plain state.
    #[serde(default)]
    pub shape: Vec<usize>,
    /// Rows of a ring.
    #[serde(default)]
    pub rows: usize,
    /// The channel that is appended to a ring in every step, before the graph runs.
    #[serde(default)]
    pub source: Option<String>,
    /// What stands for missing rows of a ring.
    #[serde(default)]
    pub fill: Fill,
    /// What clears it.
    #[serde(default)]
    pub cleared_by: ClearedBy,
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
}

/// How an instruction is evaluated.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Evaluated {
    /// The sub-tasks that it asks for.
    pub sub_tasks: Vec<String>,
    /// Name of the set that it belongs to: `seen` and `unseen`, or the benchmark's own names.
    pub split: String,
}

/// How the policy is evaluated; never part of an image.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
pub struct Evaluation {
    /// One for each instruction, in their order; or none at all.
    #[serde(default)]
    pub instructions: Vec<Evaluated>,
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
    /// The family of policies that it belongs to, with that family's own fields.
    pub family: Family,
    /// The environment.
    pub environment: Environment,
    /// Time from one control step to the next, in seconds.
    pub control_period_s: f32,
    /// The values at its edge.
    pub channels: Vec<Channel>,
    /// What a plain policy remembers.
    #[serde(default)]
    pub states: Vec<State>,
    /// The context; without one, time goes on without end.
    #[serde(default)]
    pub context: Option<Context>,
    /// The known instructions.
    #[serde(default)]
    pub instructions: Vec<Instruction>,
    /// The language encoder, where there are instructions.
    #[serde(default)]
    pub language: Option<Language>,
    /// The transformer that reads the instruction.
    #[serde(default)]
    pub network: Option<Network>,
    /// How the policy is evaluated.
    #[serde(default)]
    pub evaluation: Evaluation,
    /// How the policy was trained: anything that the exporter wrote.
    pub provenance: serde_json::Value,
}

/// The largest length that a contract may claim. Generous, and small enough that products of a few fit 64 bits.
pub(crate) const MAX_LEN: usize = 1 << 20;

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
        match version.as_u64() {
            Some(1) => return Err(BundleError::ContractV1),
            Some(found) if found == u64::from(CONTRACT_VERSION) => {}
            _ => {
                return Err(BundleError::ContractVersion {
                    found: version.to_string().into(),
                    supported: CONTRACT_VERSION,
                });
            }
        }
        // From the text, so that the error tells where.
        let contract: Self =
            serde_json::from_str(json).map_err(|error| refused(error.to_string()))?;
        contract.check().map_err(refused)?;
        Ok(contract)
    }

    /// The channel of a name.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    /// The channels that the caller gives in every control step, in their order.
    pub fn observations(&self) -> impl Iterator<Item = &Channel> {
        self.with(Role::Observation)
    }

    /// The first channel that the caller gives in every control step, the only one of most policies.
    pub fn observation(&self) -> &Channel {
        self.known(Role::Observation)
    }

    /// The action channel.
    pub fn action(&self) -> &Channel {
        self.known(Role::Action)
    }

    /// Words of the longest instruction, and elements of a word; `None` for a policy that takes none.
    pub fn words(&self) -> Option<[usize; 2]> {
        let channel = self.with(Role::Instruction).next()?;
        Some([channel.shape[0], channel.shape[1]])
    }

    /// Control steps from one selection to the next; `None` for a policy that selects nothing.
    pub fn period(&self) -> Option<usize> {
        self.family.period()
    }

    /// The sub-tasks and the split of an instruction; empty where the bundle does not say.
    pub fn evaluated(&self, instruction: usize) -> (&[String], &str) {
        self.evaluation
            .instructions
            .get(instruction)
            .map_or((&[], ""), |found| (&found.sub_tasks, &found.split))
    }

    fn with(&self, role: Role) -> impl Iterator<Item = &Channel> {
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

    fn check(&self) -> Result<(), String> {
        let period = self.control_period_s;
        if !(period.is_finite() && period > 0.0) {
            return Err(format!(
                "field `control_period_s` is {period}, it must be positive"
            ));
        }
        self.check_channels()?;
        for (i, state) in self.states.iter().enumerate() {
            self.check_state(state, &format!("states[{i}]"))?;
        }
        let names = self.states.iter().map(|state| state.name.as_str());
        let channels = self.channels.iter().map(|channel| channel.name.as_str());
        distinct("states", "name", names.clone())?;
        distinct("channels and states", "name", channels.chain(names))?;
        // Before the context, whose length is a multiple of the family's period.
        self.family.check(self)?;
        self.check_context()?;
        self.check_instructions()
    }

    fn check_channels(&self) -> Result<(), String> {
        for (i, channel) in self.channels.iter().enumerate() {
            channel.check(&format!("channels[{i}]"))?;
        }
        distinct(
            "channels",
            "name",
            self.channels.iter().map(|c| c.name.as_str()),
        )?;
        let count = |role| self.with(role).count();
        let observations = count(Role::Observation);
        if !(1..=lads_core::MAX_OBSERVATIONS).contains(&observations) {
            return Err(format!(
                "field `channels` has {observations} observations, it must have 1 to {}",
                lads_core::MAX_OBSERVATIONS
            ));
        }
        if count(Role::Action) != 1 {
            return Err(format!(
                "field `channels` has {} actions, it must have one",
                count(Role::Action)
            ));
        }
        if count(Role::Instruction) > 1 {
            return Err("field `channels` has more than one instruction".into());
        }
        let seen = self.observations().map(|channel| &channel.name);
        let named = seen.chain(self.states.iter().map(|state| &state.name));
        if let Some(name) = named
            .into_iter()
            .find(|name| RESERVED.contains(&name.as_str()))
        {
            return Err(format!(
                "an observation or a state is called \"{name}\", which means something else to a graph; give it another name"
            ));
        }
        for channel in &self.channels {
            let floats = channel.role == Role::Observation || channel.dtype == DType::F32;
            let words = channel.role != Role::Instruction || channel.shape.len() == 2;
            if !floats || !words {
                return Err(format!(
                    "channel {}: only observations may have elements other than f32, and an instruction has two axes",
                    channel.name
                ));
            }
        }
        Ok(())
    }

    fn check_state(&self, state: &State, at: &str) -> Result<(), String> {
        match state.kind {
            StateKind::Plain => {
                let len = state.shape.iter().product::<usize>();
                if state.shape.is_empty() || !(1..=MAX_LEN).contains(&len) {
                    return Err(format!(
                        "field `{at}.shape` is {:?}, it must have 1 to {MAX_LEN} elements",
                        state.shape
                    ));
                }
                if state.source.is_some() {
                    return Err(format!("field `{at}.source`: only a ring has a source"));
                }
            }
            StateKind::Ring => {
                if !(1..=MAX_LEN).contains(&state.rows) {
                    return Err(format!(
                        "field `{at}.rows` is {}, it must be 1 to {MAX_LEN}",
                        state.rows
                    ));
                }
                let source = state.source.as_deref().unwrap_or("");
                if !self.observations().any(|channel| channel.name == source) {
                    return Err(format!(
                        "field `{at}.source` is \"{source}\", it must name an observation channel"
                    ));
                }
            }
        }
        Ok(())
    }

    fn check_context(&self) -> Result<(), String> {
        let Some(context) = &self.context else {
            return Ok(());
        };
        for (field, len) in [
            ("context.words", context.words),
            ("context.steps", context.steps),
        ] {
            if !(1..=MAX_LEN).contains(&len) {
                return Err(format!(
                    "field `{field}` is {len}, it must be 1 to {MAX_LEN}"
                ));
            }
        }
        if let Some(period) = self.period()
            && !context.steps.is_multiple_of(period)
        {
            return Err(format!(
                "field `context.steps` is {}, it must be a multiple of the period of {period} control steps: a context that starts again would decide between",
                context.steps
            ));
        }
        Ok(())
    }

    fn check_instructions(&self) -> Result<(), String> {
        let Some([words, dim]) = self.words() else {
            if !self.instructions.is_empty() {
                return Err("field `instructions`: no channel takes an instruction".into());
            }
            return Ok(());
        };
        if !(1..=MAX_LEN).contains(&self.instructions.len()) {
            return Err(format!(
                "field `instructions` has {}, it must have 1 to {MAX_LEN}",
                self.instructions.len()
            ));
        }
        let language = self.language.as_ref().ok_or("missing field `language`")?;
        if language.dim != dim {
            return Err(format!(
                "field `language.dim` is {}, the instruction channel's words have {dim} elements",
                language.dim
            ));
        }
        if self.context.is_some_and(|context| context.words != words) {
            return Err(format!(
                "field `context.words` is not the instruction channel's {words} words"
            ));
        }
        if let Some(acceptance) = &language.acceptance {
            acceptance.check()?;
        }
        for (i, known) in self.instructions.iter().enumerate() {
            if known.text.trim().is_empty() {
                return Err(format!("field `instructions[{i}].text` is empty"));
            }
        }
        let evaluated = self.evaluation.instructions.len();
        if evaluated != 0 && evaluated != self.instructions.len() {
            return Err(format!(
                "field `evaluation.instructions` has {evaluated}, there are {} instructions",
                self.instructions.len()
            ));
        }
        for (i, known) in self.evaluation.instructions.iter().enumerate() {
            if known.split.trim().is_empty() {
                return Err(format!(
                    "field `evaluation.instructions[{i}].split` is empty"
                ));
            }
        }
        // Texts may repeat: benchmarks ask for the same in other words, and for the same words by other measures.
        let ids = self.instructions.iter().map(|known| known.id.as_str());
        distinct("instructions", "id", ids)
    }
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
