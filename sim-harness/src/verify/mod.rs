//! Proof that an exported policy is the policy that was trained: the reference's questions, its actions and its episodes, run again.
//!
//! Three comparisons, each of which can fail where the others cannot see: the policy alone ([`policy`]: open loop on the reference's
//! observations), the environment alone ([`physics`]: open loop on the reference's actions), and both together ([`pairs`]: the reference's
//! episodes in closed loop). [`certificate`] has the rules of the verdict. What can fail: a reference that cannot be read or is of something
//! else ([`mod@reference`]), an episode that cannot be finished.

pub mod certificate;
pub mod page;
pub mod pairs;
pub mod physics;
pub mod policy;
pub mod purpose;
pub mod reference;
pub mod statistics;

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

use crate::evaluate::{Evaluation, EvaluationError};
use crate::registry::Opener;
use certificate::{Certificate, ReferenceUsed, Setting};
use reference::Reference;

/// How often [`run`] calls `finished`: both open-loop comparisons replay the traced episodes, then all run in closed loop.
pub fn work(evaluation: &Evaluation<'_>) -> usize {
    2 * evaluation.assignments.len() * evaluation.setup.traced as usize + evaluation.len()
}

/// Runs everything that the reference holds for `evaluation`'s instructions and episodes. `evaluation` has the reference's seed and traces
/// as many episodes as the reference does; `finished` is called after each episode of each comparison, see [`work`].
pub fn run(
    evaluation: &Evaluation<'_>,
    reference: &Reference,
    open: &Opener,
    versions: BTreeMap<&'static str, String>,
    stop: &AtomicBool,
    finished: &(dyn Fn() + Sync),
) -> Result<Certificate, EvaluationError> {
    let contract = evaluation.policy.contract();
    let traced = evaluation.setup.traced;
    let answers = policy::ask(
        &evaluation.policy,
        evaluation.isa,
        reference,
        evaluation.assignments,
        traced,
        stop,
        finished,
    )?;
    let mut environment = open();
    let physics = physics::replay(
        environment.as_mut(),
        reference,
        evaluation.assignments,
        traced,
        stop,
        finished,
    )?;
    let evaluated = evaluation.run(open, stop, finished)?;
    let rollouts = pairs::Paired::new(
        reference,
        evaluation.assignments,
        environment.sub_tasks(),
        &evaluated,
        [contract.observation_len(), contract.action_len()],
    );
    let setting = Setting {
        environment: environment.id().to_owned(),
        bundle_sha256: contract.bundle_sha256().to_owned(),
        image_sha256: lads_compiler::sha256(evaluation.policy.image()),
        isa: evaluation.isa.name().to_owned(),
        seed: evaluation.seed,
        noise: reference.noise.clone(),
        episodes_per_instruction: evaluation.episodes,
        instructions: evaluation.assignments.len(),
        versions,
    };
    let used = ReferenceUsed {
        bundle_sha256: reference.bundle_sha256.clone(),
        same_bundle: reference.bundle_sha256 == contract.bundle_sha256(),
        weights_from: reference.weights_from.clone(),
        words_from: reference.words_from.clone(),
        versions: reference.versions.clone(),
    };
    Ok(Certificate::new(setting, used, answers, physics, rollouts))
}
