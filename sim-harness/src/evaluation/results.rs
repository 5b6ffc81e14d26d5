//! Results of `lads-run`: episodes of this simulator in the types of [`lads_proof::results`].
//!
//! Nothing here can fail.

use std::collections::BTreeMap;

use lads_compiler::Contract;
use lads_core::Decision;
pub use lads_proof::results::{
    Agreement, DecisionUsed, EnvironmentUsed, FORMAT, FORMAT_VERSION, HeardBy, NearestKnown,
    Results,
};
pub use lads_proof::scores::{
    Asked, Completion, InstructionResult, Run, SplitResult, Splits, SubTaskRate,
};
pub use lads_proof::timing::{LatencyByKind, TimeUse};

use crate::environment::Environment;
use crate::rollout::{Actor, Episode};

/// Returns instruction number `index` of a contract and how it is evaluated.
pub fn asked(contract: &Contract, index: usize) -> Option<Asked<'_>> {
    let known = contract.instructions.get(index)?;
    let (sub_tasks, split) = contract.evaluated(index);
    Some(Asked {
        id: &known.id,
        text: &known.text,
        split,
        sub_tasks: sub_tasks.iter().map(String::as_str).collect(),
    })
}

/// Sums up the episodes of one instruction; `watched` are the environment's sub-tasks.
pub fn of_instruction(
    asked: &Asked<'_>,
    watched: &[&str],
    episodes: &[Episode],
) -> InstructionResult {
    InstructionResult::new(asked, watched, episodes)
}

/// Names of the contract's splits, in the order in which its instructions first name them.
pub fn split_names(contract: &Contract) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for index in 0..contract.instructions.len() {
        let (_, split) = contract.evaluated(index);
        if !names.iter().any(|name| name == split) {
            names.push(split.to_owned());
        }
    }
    names
}

/// Describes how the actions were chosen.
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

/// Describes the environment, with the longest of the splits' episodes.
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
