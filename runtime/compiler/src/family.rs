//! Families of policies: the entries that a bundle of each has, the states that they share, and
//! when each is called.
//!
//! A family is one file with the fields of its contract and its blueprint, and one row of the table
//! below. No other part of this project depends on families: the compiler writes the blueprint into
//! the image as states, entries and calls, and the runtime runs those. What can fail: a contract
//! whose fields do not describe such a policy (`Kind::check`).

mod blueprint;
pub mod history;
pub mod lads;
pub mod lang_dt;
pub mod lcsd;
pub mod lisa;
pub mod plain;
pub mod recall;
pub mod skilldiffuser;
pub mod vae;

use lads_image::records::{NoiseRule, SelectionRule};
use serde::Deserialize;

use crate::contract::{Contract, Faults, MAX_LEN, Network, Role, roles_are_known};

pub use blueprint::RESERVED;
pub(crate) use blueprint::{Blueprint, Bound, Call, Entry, Keep, Origin, Times};

/// Interface of a family of policies.
pub(crate) trait Kind {
    /// Returns the number of control steps from one selection to the next; `None` for a family that
    /// selects nothing.
    fn period(&self) -> Option<usize> {
        None
    }

    /// Returns the rule by which an index is picked.
    fn selection(&self) -> Selection {
        Selection::default()
    }

    /// Returns the source of noise.
    fn noise(&self) -> Noise {
        Noise::default()
    }

    /// Checks the family's own fields against the rest of the contract.
    fn check(&self, contract: &Contract, faults: &mut Faults);

    /// Returns the parts of a policy of this family.
    fn blueprint(&self, contract: &Contract) -> Blueprint;
}

/// Defines the enum of all families, and the dispatch to them.
macro_rules! families {
    ($($(#[$meta:meta])* $name:ident($module:ident::$kind:ident) = $tag:literal,)*) => {
        /// Family of a policy, with the family's fields of the contract.
        #[derive(Debug, Clone, PartialEq, Deserialize)]
        #[serde(tag = "kind")]
        pub enum Family { $($(#[$meta])* #[serde(rename = $tag)] $name($module::$kind),)* }

        impl Family {
            /// Returns the name of the family in a contract.
            pub fn name(&self) -> &'static str {
                match self { $(Self::$name(_) => $tag,)* }
            }

            /// Names of all families.
            #[cfg(test)]
            pub(crate) const NAMES: &[&str] = &[$($tag),*];

            /// Returns the fields of a family as JSON, with every field that it may have.
            pub(crate) fn example(name: &str) -> Option<&'static str> {
                match name { $($tag => Some($module::EXAMPLE),)* _ => None }
            }

            pub(crate) fn kind(&self) -> &dyn Kind {
                match self { $(Self::$name(kind) => kind,)* }
            }
        }
    };
}

families! {
    /// LADS, with its ablations and baselines of the same shape: words, latent plans held for a
    /// horizon, and a low level.
    Lads(lads::Lads) = "lads",
    /// Lang DT: a transformer that outputs the action itself, without a plan.
    LangDt(lang_dt::LangDt) = "lang_dt",
    /// LISA: plans held for a horizon, and a low level that attends to the steps under its plan.
    Lisa(lisa::Lisa) = "lisa",
    /// VAE: plans that are vectors, by their mean or drawn.
    Vae(vae::Vae) = "vae",
    /// LCSD: a plan in every step, and an action by denoising.
    Lcsd(lcsd::Lcsd) = "lcsd",
    /// `SkillDiffuser`: a chunk of states by denoising, and the actions between them.
    SkillDiffuser(skilldiffuser::SkillDiffuser) = "skilldiffuser",
    /// LADS with a history: plans held for a horizon, and a low level that also attends to a window
    /// of earlier steps.
    History(history::History) = "history",
    /// Plain policy: one graph from observations to an action, with or without memory.
    Plain(plain::Plain) = "plain",
}

impl Family {
    /// Returns the number of control steps from one selection to the next; `None` for a family that
    /// selects nothing.
    pub fn period(&self) -> Option<usize> {
        self.kind().period()
    }

    pub(crate) fn check(&self, contract: &Contract, faults: &mut Faults) {
        self.kind().check(contract, faults);
    }
}

/// Sizes of the codebook of latent plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Codebook {
    /// Number of entries, `M`.
    pub size: usize,
    /// Number of elements of an entry, `D`.
    pub dim: usize,
}

impl Codebook {
    fn check(self, faults: &mut Faults) {
        lengths(
            [("codebook.size", self.size), ("codebook.dim", self.dim)],
            faults,
        );
    }
}

/// Rule by which an index is picked from scores.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// The index with the largest score.
    Argmax,
    /// An index drawn at random with the softmax of the scores over the temperature.
    Sample,
}

/// The decision rule and its parameters.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Decision {
    /// Rule by which an index is picked.
    pub rule: Rule,
    /// Divisor of the scores when sampling.
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
    fn check(self, faults: &mut Faults) {
        let temperature = self.temperature;
        let field = "family.decision.temperature";
        if faults.sound(&[field]) && !(temperature.is_finite() && temperature > 0.0) {
            faults.add(field, format!("is {temperature}, it must be positive"));
        }
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

/// Source of the noise of a denoising family.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NoiseKind {
    /// Standard normal numbers of a seeded generator.
    Seeded,
    /// Noise of zeros.
    Zero,
}

/// Noise fields of a contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct NoiseSource {
    /// Source of the noise.
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

/// Denoising fields of a contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Denoise {
    /// Number of runs of the denoising entry.
    pub steps: usize,
}

/// Selection rule in the image's form.
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

/// Noise rule in the image's form.
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

/// Checks lengths of the family's own fields: neither zero nor beyond
/// [`MAX_LEN`](crate::contract::MAX_LEN).
fn lengths<const N: usize>(fields: [(&str, usize); N], faults: &mut Faults) {
    for (field, len) in fields {
        length(&format!("family.{field}"), len, faults);
    }
}

fn length(field: &str, len: usize, faults: &mut Faults) {
    if faults.sound(&[field]) && !(1..=MAX_LEN).contains(&len) {
        faults.add(field, format!("is {len}, it must be 1 to {MAX_LEN}"));
    }
}

/// Checks the sizes of a transformer that the family requires.
fn network(network: Option<Network>, field: &str, faults: &mut Faults) {
    let Some(sizes) = network else {
        if !faults.sound(&[field]) {
            return;
        }
        return faults.add(
            field,
            "is missing: `layers`, `heads` and `head_dim` of the transformer",
        );
    };
    for (part, len) in [
        ("layers", sizes.layers),
        ("heads", sizes.heads),
        ("head_dim", sizes.head_dim),
    ] {
        length(&format!("{field}.{part}"), len, faults);
    }
}

/// Checks the fields that every family with a transformer over words needs: an instruction channel,
/// a context and the transformer's sizes.
fn instructed(contract: &Contract, faults: &mut Faults) {
    let known = roles_are_known(contract, faults);
    if known && contract.with(Role::Instruction).next().is_none() {
        let family = contract.family.name();
        faults.add(
            "channels",
            format!("has no instruction, which family {family} takes"),
        );
    }
    if contract.context.is_none() && faults.sound(&["context"]) {
        faults.add(
            "context",
            "is missing: `words`, `steps`, and what is done beyond",
        );
    }
    network(contract.network, "network", faults);
}

/// Checks that there is exactly one noise channel.
fn one_noise(contract: &Contract, faults: &mut Faults) {
    let count = contract.with(Role::Noise).count();
    if count != 1 && roles_are_known(contract, faults) {
        faults.add(
            "channels",
            format!("has {count} noise channels, it must have one"),
        );
    }
}
