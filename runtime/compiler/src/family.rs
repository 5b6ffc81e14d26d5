//! Families of policies: which entries a bundle of each has, which states they share, and when each is called.
//!
//! A family is one file with the fields of its contract and its blueprint, and one row of the table below. Nothing else of this
//! project knows families: the compiler writes the blueprint into the image as states, entries and calls, and the runtime runs
//! those. What can fail: a contract whose fields make no such policy (`Kind::check`).

mod blueprint;
pub mod history;
pub mod lads;
pub mod lang_dt;
pub mod lcsd;
pub mod lisa;
pub mod plain;
pub mod skilldiffuser;
pub mod vae;

use lads_image::records::{NoiseRule, SelectionRule};
use serde::Deserialize;

use crate::contract::{Contract, MAX_LEN, Network};

pub use blueprint::RESERVED;
pub(crate) use blueprint::{Blueprint, Bound, Call, Entry, Keep, Origin, Times};

/// What the table asks of a family.
pub(crate) trait Kind {
    /// Control steps from one selection to the next; `None` for a family that selects nothing.
    fn period(&self) -> Option<usize> {
        None
    }

    /// How an index is picked.
    fn selection(&self) -> Selection {
        Selection::default()
    }

    /// Where noise comes from.
    fn noise(&self) -> Noise {
        Noise::default()
    }

    /// Checks the family's own fields against the rest of the contract.
    fn check(&self, contract: &Contract) -> Result<(), String>;

    /// The parts of a policy of this family.
    fn blueprint(&self, contract: &Contract) -> Blueprint;
}

/// The enum of all families, and the dispatch to them.
macro_rules! families {
    ($($(#[$meta:meta])* $name:ident($kind:ty) = $tag:literal,)*) => {
        /// A family with the fields of its contract.
        #[derive(Debug, Clone, PartialEq, Deserialize)]
        #[serde(tag = "kind")]
        pub enum Family { $($(#[$meta])* #[serde(rename = $tag)] $name($kind),)* }

        impl Family {
            /// Its name in a contract.
            pub fn name(&self) -> &'static str {
                match self { $(Self::$name(_) => $tag,)* }
            }

            pub(crate) fn kind(&self) -> &dyn Kind {
                match self { $(Self::$name(kind) => kind,)* }
            }
        }
    };
}

families! {
    /// Words, latent plans held for a horizon, and a low level: LADS, and its ablations and baselines of the same shape.
    Lads(lads::Lads) = "lads",
    /// A transformer that gives the action itself, with no plan.
    LangDt(lang_dt::LangDt) = "lang_dt",
    /// Plans held for a horizon, and a low level that attends to the steps under its plan.
    Lisa(lisa::Lisa) = "lisa",
    /// Plans that are vectors, by their mean or drawn.
    Vae(vae::Vae) = "vae",
    /// A plan in every step, and an action by denoising.
    Lcsd(lcsd::Lcsd) = "lcsd",
    /// A chunk of states by denoising, and the actions between them.
    SkillDiffuser(skilldiffuser::SkillDiffuser) = "skilldiffuser",
    /// Plans held for a horizon, and a low level that attends to a window of earlier steps as well.
    History(history::History) = "history",
    /// One graph from observations to an action, with or without memory.
    Plain(plain::Plain) = "plain",
}

impl Family {
    /// Control steps from one selection to the next; `None` for a family that selects nothing.
    pub fn period(&self) -> Option<usize> {
        self.kind().period()
    }

    pub(crate) fn check(&self, contract: &Contract) -> Result<(), String> {
        self.kind().check(contract)
    }
}

/// The codebook of latent plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Codebook {
    /// Entries, `M`.
    pub size: usize,
    /// Elements of an entry, `D`.
    pub dim: usize,
}

/// How an index is picked from scores.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// The largest score.
    Argmax,
    /// At random with the softmax of the scores over the temperature.
    Sample,
}

/// The decision rule and its parameters.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Decision {
    /// How an index is picked.
    pub rule: Rule,
    /// Divides the scores when sampling.
    #[serde(default = "one")]
    pub temperature: f32,
    /// Seed of the sampling.
    #[serde(default)]
    pub seed: u64,
}

fn one() -> f32 {
    1.0
}

impl Decision {
    fn check(self) -> Result<(), String> {
        let temperature = self.temperature;
        if temperature.is_finite() && temperature > 0.0 {
            return Ok(());
        }
        Err(format!(
            "field `family.decision.temperature` is {temperature}, it must be positive"
        ))
    }

    fn selection(self) -> Selection {
        Selection {
            rule: match self.rule {
                Rule::Argmax => SelectionRule::Argmax,
                Rule::Sample => SelectionRule::Sample,
            },
            temperature: self.temperature,
            seed: self.seed,
        }
    }
}

/// Where the noise of a denoising family comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NoiseKind {
    /// Standard normals of a generator.
    Seeded,
    /// Zeros.
    Zero,
}

/// Noise of a contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct NoiseSource {
    /// Where it comes from.
    pub rule: NoiseKind,
    /// Seed of the generator.
    #[serde(default)]
    pub seed: u64,
}

impl NoiseSource {
    fn noise(self) -> Noise {
        Noise {
            rule: match self.rule {
                NoiseKind::Seeded => NoiseRule::Seeded,
                NoiseKind::Zero => NoiseRule::Zero,
            },
            seed: self.seed,
        }
    }
}

/// Denoising of a contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Denoise {
    /// Runs of the denoising entry.
    pub steps: usize,
}

/// A selection as the image has it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Selection {
    pub rule: SelectionRule,
    pub temperature: f32,
    pub seed: u64,
}

impl Default for Selection {
    fn default() -> Self {
        Self {
            rule: SelectionRule::Argmax,
            temperature: 1.0,
            seed: 0,
        }
    }
}

/// Noise as the image has it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Noise {
    pub rule: NoiseRule,
    pub seed: u64,
}

impl Default for Noise {
    fn default() -> Self {
        Self {
            rule: NoiseRule::Zero,
            seed: 0,
        }
    }
}

/// Refuses a length of zero, or beyond what any contract claims.
fn lengths<const N: usize>(fields: [(&str, usize); N]) -> Result<(), String> {
    for (field, len) in fields {
        if !(1..=MAX_LEN).contains(&len) {
            return Err(format!(
                "field `family.{field}` is {len}, it must be 1 to {MAX_LEN}"
            ));
        }
    }
    Ok(())
}

/// The sizes of a transformer, which the family cannot do without.
fn network(network: Option<Network>, field: &str) -> Result<Network, String> {
    let sizes = network.ok_or_else(|| format!("missing field `{field}`"))?;
    for (part, len) in [
        ("layers", sizes.layers),
        ("heads", sizes.heads),
        ("head_dim", sizes.head_dim),
    ] {
        if !(1..=MAX_LEN).contains(&len) {
            return Err(format!(
                "field `{field}.{part}` is {len}, it must be 1 to {MAX_LEN}"
            ));
        }
    }
    Ok(sizes)
}

/// What every family with a transformer over words needs: an instruction channel, a context and the transformer's sizes.
fn instructed(contract: &Contract) -> Result<(), String> {
    if contract.words().is_none() {
        return Err(format!(
            "field `channels` has no instruction, which family {} takes",
            contract.family.name()
        ));
    }
    if contract.context.is_none() {
        return Err("missing field `context`".into());
    }
    network(contract.network, "network")?;
    Ok(())
}

/// A noise channel, if there is exactly one.
fn one_noise(contract: &Contract) -> Result<(), String> {
    let role = crate::contract::Role::Noise;
    let count = contract
        .channels
        .iter()
        .filter(|channel| channel.role == role)
        .count();
    if count == 1 {
        return Ok(());
    }
    Err(format!(
        "field `channels` has {count} noise channels, it must have one"
    ))
}
