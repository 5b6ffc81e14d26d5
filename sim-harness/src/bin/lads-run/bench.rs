//! What every job that runs episodes needs, checked and ready: policy, word embeddings, environment and evaluation.
//!
//! What can fail: everything that a person named, before the first episode.

use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use lads_compiler::{Bundle, Contract};
use lads_core::{Decision, Policy};
use lads_sim::environment::Environment;
use lads_sim::evaluate::{Assignment, Evaluated, Evaluation, Setup};
use lads_sim::faults::Faults;
use lads_sim::results::{self, Results};
use lads_sim::rollout::Actor;
use lads_sim::sight;
use lads_sim::{assets, fit, plans, registry};

use crate::arguments::Wanted;
use crate::end::{End, refused};
use crate::language::{self, Chosen, Heard};
use crate::program::Program;
use crate::{progress, recordings, unfinished};

/// A checked evaluation, ready to run.
pub struct Bench<'b> {
    pub evaluation: Evaluation<'b>,
    pub bundle: &'b Bundle,
    pub open: &'b registry::Opener,
    pub environment: &'b dyn Environment,
    pub noise: &'b str,
    pub heard: &'b Heard<'b>,
    pub stop: &'b AtomicBool,
}

/// Opens and checks everything that `wanted` names, and passes it to `job`.
pub fn with<R>(
    wanted: &Wanted<'_>,
    stop: &AtomicBool,
    job: impl FnOnce(&Bench<'_>) -> Result<R, End>,
) -> Result<R, End> {
    let program = Program::open(wanted.policy)?;
    let (bundle, policy) = (program.bundle(), program.policy());
    let chosen = Chosen::of(wanted, bundle)?;
    let mut heard = language::hear(wanted, bundle, &policy, &chosen)?;
    program.self_test()?;
    let book = wanted.plans;
    let book = book.map(|path| recordings::plans(&policy, bundle, path));
    let book = book.transpose()?;

    let contract = bundle.contract();
    let id = contract.environment.id.as_str();
    let usual = registry::default_noise(id);
    let noise = wanted.noise.or(usual).unwrap_or("none");
    let open = registry::load(id, noise, &assets::vendor_dir()).map_err(refused)?;
    let environment = open();
    let commanded = fit::check(contract, environment.as_ref()).map_err(|misfit| {
        let model = wanted.policy.model.display();
        refused(format!(
            "{model}: {misfit}; use a bundle made for this environment"
        ))
    })?;
    let images = contract.observations().any(sight::is_image);
    if images {
        // Its cameras, before the first episode.
        let sight = sight::Sight::of(contract, &policy, environment.as_ref());
        let model = wanted.policy.model.display();
        sight.map_err(|error| refused(format!("{model}: {error}")))?;
    }
    if images && wanted.faults != Faults::default() {
        return Err(refused(
            "the policy sees images, which no fault delays or loses; leave the faults out",
        ));
    }
    heard.words.sentence = chosen.sentence(wanted, environment.as_ref())?;
    let assignments: Vec<_> = (0..)
        .zip(commanded)
        .filter(|(instruction, _)| chosen.has(*instruction))
        .filter(|(instruction, _)| book.as_ref().is_none_or(|book| book.knows(*instruction)))
        .map(|(instruction, commanded)| Assignment {
            instruction,
            commanded,
            max_steps: environment.max_steps(contract.evaluated(instruction as usize).1),
        })
        .chain(
            heard
                .words
                .sentence
                .iter()
                .map(|sentence| sentence.assignment(contract, environment.as_ref())),
        )
        .collect();
    check_plans(wanted.episodes, book.as_ref(), &assignments, contract)?;
    let actor = if wanted.uniform {
        Actor::Uniform
    } else {
        Actor::Policy
    };
    let evaluation = Evaluation {
        policy,
        contract,
        assignments: &assignments,
        episodes: wanted.episodes,
        seed: wanted.seed,
        decision: decision(&policy, wanted.sample),
        actor,
        isa: program.isa(),
        threads: wanted.threads,
        setup: Setup {
            faults: wanted.faults,
            plans: book.as_ref(),
            stop_where_refused: false,
            traced: wanted.traced,
            pictures: wanted.pictures,
            words: Some(&heard.words),
            observer: None,
        },
    };
    job(&Bench {
        evaluation,
        bundle,
        open: &open,
        environment: environment.as_ref(),
        noise,
        heard: &heard,
        stop,
    })
}

impl Bench<'_> {
    /// Runs all episodes behind a progress bar, until `stop` is raised.
    pub fn run(&self, setup: Setup<'_>, what: &str) -> Result<(Results, Evaluated), End> {
        let evaluation = Evaluation {
            setup,
            ..self.evaluation
        };
        let start = Instant::now();
        let bar = progress(evaluation.len());
        bar.set_message(what.to_owned());
        let evaluated = evaluation.run(self.open, self.stop, &|| bar.inc(1));
        bar.finish_and_clear();
        let evaluated = evaluated.map_err(unfinished)?;
        let results = self.sum_up(&evaluation, &evaluated, start.elapsed());
        Ok((results, evaluated))
    }

    /// Sums up all measurements of a run as results.
    pub fn sum_up(
        &self,
        evaluation: &Evaluation<'_>,
        evaluated: &Evaluated,
        wall: Duration,
    ) -> Results {
        let (environment, watched) = (self.environment, self.environment.sub_tasks());
        let mut splits = results::split_names(evaluation.contract);
        let sentence = self.heard.words.sentence.as_ref();
        splits.extend(sentence.map(|sentence| sentence.asked().split.to_owned()));
        let of_each = evaluation.assignments.iter().zip(&evaluated.episodes);
        let instructions: Vec<_> = of_each
            .filter(|(_, episodes)| !episodes.is_empty())
            .filter_map(|(assignment, episodes)| {
                let asked = evaluation.instruction(assignment.instruction)?;
                Some(results::of_instruction(&asked, watched, episodes))
            })
            .collect();
        let threads = evaluation.threads.min(evaluation.len());
        Results {
            format: results::FORMAT,
            format_version: results::FORMAT_VERSION,
            environment: results::environment_used(environment, &splits),
            bundle_sha256: self.bundle.sha256().to_owned(),
            image_sha256: lads_compiler::sha256(evaluation.policy.image()),
            seed: evaluation.seed,
            noise: self.noise.to_owned(),
            decision: results::decision_used(evaluation.decision, evaluation.actor),
            episodes_per_instruction: evaluation.episodes,
            heard_by: self.heard.by.clone(),
            faults: Some(evaluation.setup.faults).filter(|&faults| faults != Faults::default()),
            plans_commanded: evaluation.setup.plans.is_some(),
            plan_agreement: None,
            versions: results::versions(),
            splits: results::Splits::of(&splits, &instructions, watched),
            instructions,
            latency_us: results::LatencyByKind::of(&evaluated.timing),
            time: results::TimeUse::of(&evaluated.timing, wall, threads),
        }
    }
}

/// Refuses plans that leave an episode without any.
fn check_plans(
    episodes: u32,
    book: Option<&plans::PlanBook>,
    assignments: &[Assignment],
    contract: &Contract,
) -> Result<(), End> {
    let Some(book) = book else {
        return Ok(());
    };
    if assignments.is_empty() {
        return Err(refused(
            "--plans: the file has no plans for the instructions asked for; leave --instruction out",
        ));
    }
    for assignment in assignments {
        let missing = (0..episodes).find(|&e| book.of(assignment.instruction, e).is_none());
        if let Some(episode) = missing {
            let known = contract.instructions.get(assignment.instruction as usize);
            return Err(refused(format!(
                "--plans: the file has no plans for episode {episode} of {}; give fewer --episodes, or plans without an episode number",
                known.map_or("?", |known| known.id.as_str())
            )));
        }
    }
    Ok(())
}

/// Returns the decision rule of the run; a rule that draws gets a seed for each episode.
fn decision(policy: &Policy<'_>, sample: bool) -> Decision {
    let contract = policy.contract();
    if sample {
        contract.sampling(0)
    } else {
        contract.decision()
    }
}
