//! What `lads-run` reports: rollouts summed up per instruction and per split, and their JSON form (documented in results.schema.json).
//!
//! Invariants: the order is the contract's order of instructions and then of episodes, whatever the thread count; everything but
//! `latency_us` and `time` depends only on bundle, seed, noise, decision and versions.

use std::collections::BTreeMap;

use lads_core::{Contract, Decision, KnownInstruction};
use serde::{Serialize, Serializer};

use crate::environment::Environment;
use crate::faults::Faults;
use crate::fit;
use crate::metrics::{Latency, Outcome, Rate, Score};
use crate::plans::Agreement;
use crate::rollout::{Actor, Episode, Timing};

/// Value of the JSON's `format`.
pub const FORMAT: &str = "lads-results";

/// Version of the JSON form; changes when a field changes its meaning or goes.
pub const FORMAT_VERSION: u32 = 1;

/// A sub-task that was completed in an episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Completion {
    /// Name of the sub-task.
    pub sub_task: &'static str,
    /// Control step, counted from 1, after which it held for the first time.
    pub step: usize,
    /// Whether the instruction commands it.
    pub commanded: bool,
}

/// One episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Run {
    /// Number of the episode within its instruction; with the seed it names the episode's random streams.
    pub episode: usize,
    /// Control steps executed.
    pub steps: usize,
    /// Whether the instruction was carried out; `None` for a sentence that commands no sub-tasks.
    pub success: Option<bool>,
    /// Completed sub-tasks in the order of their completion.
    pub completions: Vec<Completion>,
    /// Latent plan indices in the order in which they were decided, one per horizon.
    pub plans: Vec<u32>,
}

/// How often one sub-task was completed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SubTaskRate {
    /// Name of the sub-task.
    pub sub_task: &'static str,
    /// How often, with a Wilson 95 % interval.
    #[serde(flatten)]
    pub rate: Rate,
}

/// All episodes of one instruction.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InstructionResult {
    /// The instruction's id in the contract.
    pub id: String,
    /// Its text.
    pub text: String,
    /// The split it belongs to, in the contract's name.
    pub split: String,
    /// Its score; the field `episodes` is among these.
    #[serde(flatten)]
    pub score: Score,
    /// Rate of every commanded sub-task, in the order of the instruction.
    pub completions: Vec<SubTaskRate>,
    /// Rate of every other sub-task that was completed at least once, in the environment's order.
    pub un_instructed_completions: Vec<SubTaskRate>,
    /// The episodes.
    pub runs: Vec<Run>,
}

impl InstructionResult {
    /// Sums up the episodes of one instruction; `watched` are the environment's sub-tasks.
    pub fn new(
        instruction: &KnownInstruction<'_>,
        watched: &[&'static str],
        episodes: &[Episode],
    ) -> Self {
        let asked: Vec<&str> = fit::sub_tasks(instruction.sub_tasks).collect();
        // In the instruction's order, in the environment's names.
        let commanded = asked
            .iter()
            .filter_map(|name| watched.iter().find(|known| *known == name));
        let commanded: Vec<&'static str> = commanded.copied().collect();
        let runs: Vec<Run> = episodes
            .iter()
            .enumerate()
            .map(|(number, e)| run(number, e, watched, &commanded))
            .collect();
        let rate = |sub_task: &'static str| {
            let done = |run: &&Run| run.completions.iter().any(|c| c.sub_task == sub_task);
            let count = runs.iter().filter(done).count();
            SubTaskRate {
                sub_task,
                rate: Rate::new(count, runs.len()),
            }
        };
        let others = watched.iter().filter(|name| !commanded.contains(name));
        let others = others
            .map(|&name| rate(name))
            .filter(|other| other.rate.count > 0);
        Self {
            id: instruction.id.to_owned(),
            text: instruction.text.to_owned(),
            split: instruction.split.to_owned(),
            score: score(runs.iter()),
            completions: commanded.iter().map(|&name| rate(name)).collect(),
            un_instructed_completions: others.collect(),
            runs,
        }
    }
}

/// One episode in the environment's names.
fn run(number: usize, episode: &Episode, watched: &[&'static str], commanded: &[&str]) -> Run {
    let named = |completion: &crate::environment::Completion| {
        let &sub_task = watched.get(completion.sub_task)?;
        Some(Completion {
            sub_task,
            step: completion.step,
            commanded: commanded.contains(&sub_task),
        })
    };
    Run {
        episode: number,
        steps: episode.steps,
        success: (!commanded.is_empty()).then_some(episode.success),
        completions: episode.completions.iter().filter_map(named).collect(),
        plans: episode.plans.clone(),
    }
}

/// The score of episodes that all command sub-tasks, or none of them.
fn score<'r>(runs: impl Iterator<Item = &'r Run> + Clone) -> Score {
    let outcomes: Option<Vec<_>> = runs.clone().map(outcome).collect();
    outcomes.map_or_else(
        || {
            let completions = runs.clone().map(|run| run.completions.len()).sum();
            Score::unasked(runs.count(), completions)
        },
        Score::of,
    )
}

/// `None` where nothing was commanded.
fn outcome(run: &Run) -> Option<Outcome> {
    let completed = run.completions.iter().filter(|c| c.commanded).count();
    Some(Outcome {
        completed,
        un_instructed: run.completions.len() - completed,
        success: run.success?,
    })
}

/// All instructions of one split together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SplitResult {
    /// Its score; the field `episodes` is among these.
    #[serde(flatten)]
    pub score: Score,
    /// Rate of every sub-task over the episodes that commanded it.
    pub completions: Vec<SubTaskRate>,
    /// Rate of every sub-task over the episodes that did not command it, where it was completed at least once.
    pub un_instructed_completions: Vec<SubTaskRate>,
}

/// The contract's splits in its order, by name; in JSON an object.
#[derive(Debug, Clone, PartialEq)]
pub struct Splits(pub Vec<(String, SplitResult)>);

impl Splits {
    /// Sums up all episodes of each split in `names`; `watched` are the environment's sub-tasks.
    pub fn of(
        names: &[String],
        instructions: &[InstructionResult],
        watched: &[&'static str],
    ) -> Self {
        let of_split = |name: &String| {
            let own = instructions.iter().filter(|result| result.split == *name);
            let own: Vec<_> = own.collect();
            (name.clone(), SplitResult::of(&own, watched))
        };
        Self(names.iter().map(of_split).collect())
    }

    /// The result of a split.
    pub fn get(&self, name: &str) -> Option<&SplitResult> {
        let found = self.0.iter().find(|(known, _)| known == name);
        found.map(|(_, result)| result)
    }
}

impl Serialize for Splits {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(name, result)| (name, result)))
    }
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

impl SplitResult {
    fn of(instructions: &[&InstructionResult], watched: &[&'static str]) -> Self {
        let rate = |sub_task: &'static str, commanded: bool| {
            let commands = |result: &&InstructionResult| {
                result.completions.iter().any(|c| c.sub_task == sub_task) == commanded
            };
            let runs = instructions
                .iter()
                .copied()
                .filter(commands)
                .flat_map(|result| &result.runs);
            let done = |run: &&Run| run.completions.iter().any(|c| c.sub_task == sub_task);
            let count = runs.clone().filter(done).count();
            SubTaskRate {
                sub_task,
                rate: Rate::new(count, runs.count()),
            }
        };
        let rates = |commanded| watched.iter().map(move |&name| rate(name, commanded));
        Self {
            score: score(instructions.iter().flat_map(|result| &result.runs)),
            completions: rates(true).filter(|of| of.rate.episodes > 0).collect(),
            un_instructed_completions: rates(false).filter(|of| of.rate.count > 0).collect(),
        }
    }
}

/// Latency of the controller, in microseconds, by the kind of call.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LatencyByKind {
    /// Control steps that keep the plan.
    pub ordinary: Latency,
    /// Control steps that decide a new plan, every horizon.
    pub decision: Latency,
    /// Setting an instruction, which runs its words through the high level.
    pub instruct: Latency,
}

impl LatencyByKind {
    /// Percentiles of all calls.
    pub fn of(timing: &Timing) -> Self {
        Self {
            ordinary: Latency::of_ns(&timing.ordinary_ns),
            decision: Latency::of_ns(&timing.decision_ns),
            instruct: Latency::of_ns(&timing.instruct_ns),
        }
    }
}

/// Where the time went; CPU times are summed over the threads and do not depend on what else the machine does.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TimeUse {
    /// Wall time from the first episode to the last, in seconds.
    pub wall_s: f64,
    /// Threads that ran episodes.
    pub threads: usize,
    /// CPU time inside episodes, in seconds.
    pub episodes_cpu_s: f64,
    /// CPU time inside the environment's reset and step, in seconds: physics but for noise and task checks.
    pub simulator_cpu_s: f64,
    /// CPU time inside the controller, in seconds.
    pub controller_cpu_s: f64,
    /// `simulator_cpu_s` over `episodes_cpu_s`; `None` without episodes.
    pub simulator_share: Option<f64>,
}

impl TimeUse {
    /// Sums up what was measured.
    pub fn of(timing: &Timing, wall: std::time::Duration, threads: usize) -> Self {
        let (simulator_cpu_s, episodes_cpu_s) = (
            timing.simulator_cpu.as_secs_f64(),
            timing.episodes_cpu.as_secs_f64(),
        );
        Self {
            wall_s: wall.as_secs_f64(),
            threads,
            episodes_cpu_s,
            simulator_cpu_s,
            controller_cpu_s: timing.controller_cpu.as_secs_f64(),
            simulator_share: (episodes_cpu_s > 0.0).then(|| simulator_cpu_s / episodes_cpu_s),
        }
    }
}

/// How plans were chosen.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DecisionUsed {
    /// `argmax` or `sample`; `uniform` where actions were drawn at random and no plan was chosen.
    pub rule: &'static str,
    /// Temperature of the softmax that is sampled; `None` for argmax.
    pub temperature: Option<f32>,
}

impl DecisionUsed {
    /// How the actions came about.
    pub fn of(decision: Decision, actor: Actor) -> Self {
        match actor {
            Actor::Policy => decision.into(),
            Actor::Uniform => Self {
                rule: "uniform",
                temperature: None,
            },
        }
    }
}

impl From<Decision> for DecisionUsed {
    fn from(decision: Decision) -> Self {
        match decision {
            Decision::Argmax => Self {
                rule: "argmax",
                temperature: None,
            },
            Decision::Sample { temperature, .. } => Self {
                rule: "sample",
                temperature: Some(temperature),
            },
        }
    }
}

/// Which environment the rollouts ran in.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EnvironmentUsed {
    /// The contract's environment id.
    pub id: &'static str,
    /// Its version.
    pub version: &'static str,
    /// Control period, in seconds.
    pub control_period_s: f64,
    /// Longest episode, in control steps.
    pub max_steps: usize,
}

impl EnvironmentUsed {
    /// The environment, with the longest of the splits' episodes.
    pub fn new(environment: &dyn Environment, splits: &[String]) -> Self {
        let steps = splits.iter().map(|split| environment.max_steps(split));
        Self {
            id: environment.id(),
            version: environment.version(),
            control_period_s: environment.control_period_s(),
            max_steps: steps.max().unwrap_or(0),
        }
    }
}

/// What a sentence outside the table is most like.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NearestKnown {
    /// Id of the known instruction.
    pub id: String,
    /// Its text.
    pub text: String,
    /// Similarity of the sentence to it, from -1 to 1.
    pub similarity: f32,
    /// Similarity from which on the bundle follows a sentence; `None` where its contract does not say.
    pub threshold: Option<f32>,
    /// Whether the bundle accepts the sentence; if not, the caller insisted.
    pub accepted: bool,
}

/// Who made the word embeddings, where they are not the bundle's own.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HeardBy {
    /// Name of the language encoder.
    pub encoder: String,
    /// SHA-256 of its weights, in hexadecimal digits.
    pub sha256: String,
    /// Largest difference of an element from the bundle's table; `None` for a sentence outside it.
    pub largest_difference: Option<f32>,
    /// What a sentence outside the table is most like; left out for known instructions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nearest: Option<NearestKnown>,
}

/// The whole report of one `lads-run`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Results {
    /// [`FORMAT`].
    pub format: &'static str,
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// Environment of the rollouts.
    pub environment: EnvironmentUsed,
    /// SHA-256 of the bundle file, in hexadecimal digits.
    pub bundle_sha256: String,
    /// SHA-256 of the program image that ran.
    pub image_sha256: String,
    /// Seed of all random streams.
    pub seed: u64,
    /// Noise level of the environment.
    pub noise: String,
    /// How plans were chosen.
    pub decision: DecisionUsed,
    /// Episodes asked for per instruction.
    pub episodes_per_instruction: u32,
    /// Who made the word embeddings; left out where they are the bundle's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heard_by: Option<HeardBy>,
    /// What was wrong between policy and environment; left out without faults.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub faults: Option<Faults>,
    /// Whether the low level ran alone on given plans; left out where the policy decided.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub plans_commanded: bool,
    /// Plans in force against plans encoded from what was executed; left out where not asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub plan_agreement: Option<Agreement>,
    /// Versions of what the numbers depend on, by name.
    pub versions: BTreeMap<&'static str, String>,
    /// Scores by split.
    pub splits: Splits,
    /// Results by instruction, in the contract's order.
    pub instructions: Vec<InstructionResult>,
    /// Latency of the controller.
    pub latency_us: LatencyByKind,
    /// Where the time went.
    pub time: TimeUse,
}

/// Versions of what the numbers depend on besides the bundle, by name.
pub fn versions() -> BTreeMap<&'static str, String> {
    BTreeMap::from([
        ("lads-sim", env!("CARGO_PKG_VERSION").to_owned()),
        ("mujoco", mujoco_rs::mujoco_version().to_owned()),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    const WATCHED: [&str; 5] = ["a", "b", "c", "d", "e"];

    fn episode(success: bool, done: &[(usize, usize)]) -> Episode {
        let completion = |&(sub_task, step)| crate::environment::Completion { sub_task, step };
        Episode {
            steps: 280,
            success,
            completions: done.iter().map(completion).collect(),
            plans: vec![0; 14],
            final_state: vec![0.0; 5],
        }
    }

    fn two_instructions() -> [InstructionResult; 2] {
        let known = |id, sub_tasks, split| KnownInstruction {
            id,
            text: "t",
            sub_tasks,
            split,
            words: &[],
        };
        let first = [
            episode(true, &[(0, 3), (1, 9), (4, 11), (2, 20), (3, 30)]),
            episode(false, &[(1, 5)]),
        ];
        let second = [episode(false, &[(0, 2), (3, 8)])];
        [
            InstructionResult::new(&known("dcba", "d, c, b, a", "seen"), &WATCHED, &first),
            InstructionResult::new(&known("eabc", "e,a,b,c", "unseen"), &WATCHED, &second),
        ]
    }

    fn splits_of(instructions: &[InstructionResult]) -> [SplitResult; 2] {
        let names = ["seen", "unseen"].map(str::to_owned);
        let splits = Splits::of(&names, instructions, &WATCHED);
        names.map(|name| splits.get(&name).unwrap().clone())
    }

    fn counts(rates: &[SubTaskRate]) -> Vec<(&str, usize)> {
        rates
            .iter()
            .map(|rate| (rate.sub_task, rate.rate.count))
            .collect()
    }

    #[test]
    fn rates_by_hand() {
        let [first, second] = two_instructions();
        assert_eq!(
            counts(&first.completions),
            [("d", 1), ("c", 1), ("b", 2), ("a", 1)]
        );
        assert_eq!(counts(&first.un_instructed_completions), [("e", 1)]);
        assert_eq!(
            (first.score.n_rate, first.score.full_success),
            (Some(2.5), Some(0.5))
        );
        assert_eq!(
            first.score.k_rate,
            [Some(1.0), Some(0.5), Some(0.5), Some(0.5)]
        );
        assert_eq!(counts(&second.un_instructed_completions), [("d", 1)]);
        assert_eq!(
            (second.score.n_rate, second.score.un_instructed),
            (Some(1.0), 1)
        );
        let order: Vec<_> = first.runs[0]
            .completions
            .iter()
            .map(|c| (c.sub_task, c.commanded))
            .collect();
        assert_eq!(
            order,
            [
                ("a", true),
                ("b", true),
                ("e", false),
                ("c", true),
                ("d", true)
            ]
        );
    }

    #[test]
    fn splits_by_hand() {
        let [first, second] = two_instructions();
        let [seen, unseen] = splits_of(std::slice::from_ref(&first));
        assert_eq!((seen.score.episodes, unseen.score.episodes), (2, 0));
        assert_eq!((seen.score.n_rate, unseen.score.n_rate), (Some(2.5), None));
        assert!(unseen.completions.is_empty());
        let third = InstructionResult {
            id: "b".to_owned(),
            ..second.clone()
        };
        let [seen, unseen] = splits_of(&[first, second, third]);
        assert_eq!(
            (seen.score.n_rate, unseen.score.n_rate),
            (Some(2.5), Some(1.0))
        );
        // Both unseen episodes command e, a, b, c and complete a and d; nobody commands d.
        assert_eq!(
            counts(&unseen.completions),
            [("a", 2), ("b", 0), ("c", 0), ("e", 0)]
        );
        assert_eq!(counts(&unseen.un_instructed_completions), [("d", 2)]);
        assert!(unseen.completions.iter().all(|of| of.rate.episodes == 2));
    }
}
