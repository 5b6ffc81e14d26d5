//! What `lads-run` reports: episodes of this simulator in the words of [`lads_proof::results`].
//!
//! Nothing here can fail.

use std::collections::BTreeMap;

use lads_core::{Contract, Decision, KnownInstruction};
pub use lads_proof::results::{
    Agreement, DecisionUsed, EnvironmentUsed, FORMAT, FORMAT_VERSION, HeardBy, Results,
};
pub use lads_proof::scores::{
    Asked, Completion, InstructionResult, Run, SplitResult, Splits, SubTaskRate,
};
pub use lads_proof::timing::{LatencyByKind, TimeUse};

use crate::environment::Environment;
use crate::fit;
use crate::rollout::{Actor, Episode};

/// Sums up the episodes of one instruction of a contract; `watched` are the environment's sub-tasks.
pub fn of_instruction(
    known: &KnownInstruction<'_>,
    watched: &[&str],
    episodes: &[Episode],
) -> InstructionResult {
    let asked = Asked {
        id: known.id,
        text: known.text,
        split: known.split,
        sub_tasks: fit::sub_tasks(known.sub_tasks).collect(),
    };
    InstructionResult::new(&asked, watched, episodes)
}

/// The names of the contract's splits, in the order in which its instructions first name them.
pub fn split_names(contract: &Contract<'_>) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for known in contract.instructions() {
        if !names.iter().any(|name| name == known.split) {
            names.push(known.split.to_owned());
        }
    }
    names
}

/// How the actions came about.
pub fn decision_used(decision: Decision, actor: Actor) -> DecisionUsed {
    let (rule, temperature) = match (actor, decision) {
        (Actor::Uniform, _) => ("uniform", None),
        (Actor::Policy, Decision::Argmax) => ("argmax", None),
        (Actor::Policy, Decision::Sample { temperature, .. }) => ("sample", Some(temperature)),
    };
    DecisionUsed {
        rule: rule.to_owned(),
        temperature,
    }
}

/// The environment, with the longest of the splits' episodes.
pub fn environment_used(environment: &dyn Environment, splits: &[String]) -> EnvironmentUsed {
    let steps = splits.iter().map(|split| environment.max_steps(split));
    EnvironmentUsed {
        id: environment.id().to_owned(),
        version: environment.version().to_owned(),
        control_period_s: environment.control_period_s(),
        max_steps: steps.max().unwrap_or(0),
    }
}

/// Versions of what the numbers depend on besides the bundle, by name.
pub fn versions() -> BTreeMap<String, String> {
    let versions = [
        ("lads-sim", env!("CARGO_PKG_VERSION")),
        ("mujoco", mujoco_rs::mujoco_version()),
    ];
    versions
        .map(|(name, version)| (name.to_owned(), version.to_owned()))
        .into()
}
