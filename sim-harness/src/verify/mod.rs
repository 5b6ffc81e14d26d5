//! Verifies that an exported policy is the policy that was trained: the reference's questions, its actions and its episodes, run again.
//!
//! Three comparisons, each of which can fail where the others cannot see: the policy alone ([`policy`]: open loop on the reference's
//! observations, or on frames drawn of its states, see [`shown`]), the environment alone ([`physics`]: open loop on the reference's actions), and both together ([`lads_proof::pairs`]: the reference's
//! episodes in closed loop). [`certificate`] has the rules of the verdict. What can fail: a reference that cannot be read or is of something
//! else ([`mod@reference`]), an episode that cannot be finished.

pub mod contract;
pub mod physics;
pub mod policy;
pub mod shown;

pub use lads_proof::{certificate, page, reference};

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

use lads_compiler::Bundle;
use lads_core::{DType, Noise};
use lads_proof::answers::Answers;
use lads_proof::contract::Compared;
use lads_proof::numbering::Numbering;
use lads_proof::pairs::{Done, Episodes, Paired, Traced};
use lads_proof::reference::Subject;

use crate::environment::Environment;
use crate::evaluate::{Evaluated, Evaluation, EvaluationError};
use crate::registry::Opener;
use crate::sight;
use certificate::{Certificate, ReferenceUsed, Setting};
use policy::Questions;
use reference::Reference;
use shown::Shown;

/// Number of calls that [`run`] makes to `finished`: both open-loop comparisons replay the traced episodes, one of them twice if the image has fewer bits than
/// 32, then all run in closed loop.
pub fn work(evaluation: &Evaluation<'_>) -> usize {
    let replays = 1 + policy::rounds(&evaluation.policy);
    replays * evaluation.assignments.len() * evaluation.setup.traced as usize + evaluation.len()
}

/// Runs all comparisons that the reference holds for `evaluation`'s instructions and episodes. `evaluation` has the reference's seed and
/// traces as many episodes as the reference does; `finished` is called after each episode of each comparison, see [`work`].
pub fn run(
    evaluation: &Evaluation<'_>,
    bundle: &Bundle,
    reference: &Reference,
    open: &Opener,
    versions: BTreeMap<String, String>,
    stop: &AtomicBool,
    finished: &(dyn Fn() + Sync),
) -> Result<Certificate, EvaluationError> {
    let contract = evaluation.policy.contract();
    let traced = evaluation.setup.traced;
    let mut environment = open();
    let shown = Shown::draw(
        (evaluation.contract, &evaluation.policy),
        environment.as_ref(),
        (reference, evaluation.assignments, traced),
        stop,
    )?;
    let questions = Questions {
        reference,
        assignments: evaluation.assignments,
        episodes: traced,
        shown: shown.as_ref(),
    };
    let image = (&evaluation.policy, evaluation.isa);
    let (asked, numbering) = policy::judge(image, bundle, questions, stop, finished)?;
    let physics = physics::replay(
        environment.as_mut(),
        reference,
        evaluation.assignments,
        traced,
        stop,
        finished,
    )?;
    let evaluated = evaluation.run(open, stop, finished)?;
    let rollouts = compared(
        (reference, &numbering),
        environment.sub_tasks(),
        evaluation,
        &evaluated,
    );
    let setting = Setting {
        environment: environment.id().to_owned(),
        bundle_sha256: contract.bundle_sha256().to_owned(),
        image_sha256: lads_compiler::sha256(evaluation.policy.image()),
        image_stored: lads_host::stored(&evaluation.policy),
        decision: contract::rule(contract),
        isa: evaluation.isa.name().to_owned(),
        seed: evaluation.seed,
        noise: reference.noise.clone(),
        episodes_per_instruction: evaluation.episodes,
        instructions: evaluation.assignments.len(),
        versions,
    };
    let used = ReferenceUsed {
        bundle_sha256: reference.bundle_sha256.clone(),
        // Tuning changes how an image's numbers are stored, not the policy.
        same_bundle: [bundle.sha256(), bundle.untuned_sha256()]
            .contains(&reference.bundle_sha256.as_str()),
        weights_from: reference.weights_from.clone(),
        words_from: reference.words_from.clone(),
        logits_from: reference.logits_from.clone(),
        versions: reference.versions.clone(),
    };
    let stated = bundle
        .metadata("lads.contract")
        .and_then(|text| serde_json::from_str(text).ok());
    let bundled = contract::of_bundle(bundle).map_err(EvaluationError::Bundle)?;
    let compared = Compared {
        remedy: "complete it: python -m lads_exporter reference --complete",
        ..Compared::new(
            &stated.unwrap_or_default(),
            reference.contract.as_ref(),
            [&contract::of_image(&evaluation.policy), &bundled],
        )
    };
    let mut not_covered = unseen(evaluation, &asked.policy);
    if asked.rounding.is_some() {
        let tuned = lads_compiler::compile(bundle).map_err(EvaluationError::Exact)?;
        if tuned.as_bytes() != evaluation.policy.image() {
            not_covered.push(
                "weights of the image beyond what they decide: it is not what the bundle compiles to as it was tuned"
                    .to_owned(),
            );
        }
    }
    Ok(Certificate::new(
        setting,
        used,
        compared,
        asked,
        (physics, shown.map(|shown| shown.compared)),
        rollouts,
        not_covered,
    ))
}

/// Describes a bundle, as far as its reference must agree with it.
pub fn subject<'s>(bundle: &'s Bundle, environment: &'s dyn Environment) -> Subject<'s> {
    let contract = bundle.contract();
    let known = &contract.instructions;
    // A policy with a camera may observe the first elements of the state alone.
    let mut vectors = contract.observations().filter(|it| !sight::is_image(it));
    let observation = vectors.next();
    Subject {
        contract: bundle.metadata("lads.contract").unwrap_or_default(),
        instructions: known.iter().map(|row| row.text.as_str()).collect(),
        environment_id: environment.id(),
        environment_version: environment.version(),
        state_len: environment.state().len(),
        observation_len: observation.map_or(0, |it| it.shape.iter().product()),
        sees: contract.observations().any(sight::is_image),
        draws: matches!(contract.noise(), Noise::Seeded { .. }),
        action_len: environment.action_len(),
    }
}

/// Lists what the episodes of this run could not show.
fn unseen(evaluation: &Evaluation<'_>, answers: &Answers) -> Vec<String> {
    let contract = evaluation.policy.contract();
    let mut unseen = Vec::new();
    let known = contract.instructions().count();
    if evaluation.assignments.len() < known {
        unseen.push(format!(
            "{} of {known} instructions",
            known - evaluation.assignments.len()
        ));
    }
    let longest = answers.longest_episode;
    let context = contract.context_steps().filter(|&steps| longest <= steps);
    if let Some(steps) = context {
        unseen.push(format!(
            "what happens after {longest} control steps: no replayed episode is longer, and the policy's context holds {steps}"
        ));
    }
    unseen
}

fn compared(
    reference: (&Reference, &Numbering),
    sub_tasks: &[&str],
    evaluation: &Evaluation<'_>,
    evaluated: &Evaluated,
) -> Paired {
    let contract = evaluation.policy.contract();
    let episodes = evaluation.assignments.iter().zip(&evaluated.episodes);
    let episodes = episodes.map(|(assignment, episodes)| Episodes {
        instruction: assignment.instruction as usize,
        commanded: &assignment.commanded,
        episodes,
    });
    let traces = evaluated.traces.iter().map(|trace| Traced {
        instruction: trace.instruction as usize,
        episode: trace.episode as usize,
        steps: trace
            .steps
            .iter()
            .map(|step| Done {
                observation: &step.observation,
                shown: step.shown,
                action: &step.action,
            })
            .collect(),
    });
    let mut vectors = contract.observations();
    let vector = vectors.find(|channel| channel.dtype() == DType::F32);
    let lens = [
        vector.map_or(0, |channel| channel.len()),
        contract.action_len(),
    ];
    Paired::new(reference, sub_tasks, episodes, traces, lens)
}
