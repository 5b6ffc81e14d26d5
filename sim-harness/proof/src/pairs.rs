//! Compares the policy's episodes, driven by itself, with the reference's, in pairs. The same episodes, each driven by the policy itself,
//! beside the reference's.
//!
//! Closed loop with the reference's seeds: paired, because episode `n` of an instruction starts alike and sees the same noise in both.
//! Nothing here can fail.

use serde::Serialize;

use super::frames::Digest;
use super::numbering::Numbering;
use super::reference::Reference;
use super::statistics::{Counts, Difference, Pairs};
use crate::episode::Episode;

/// Largest negligible difference of a success rate.
pub const RATE_MARGIN: f64 = 0.05;
/// Largest negligible difference of the N-rate, the mean number of completed sub-tasks.
pub const N_RATE_MARGIN: f64 = 0.1;
/// Difference of an observation element up to which two trajectories agree: rounding of observations, before physics has made more of it.
pub const TRAJECTORY_TOLERANCE: f64 = 1e-6;

/// Difference of a state element (rad or m) up to which two episodes ended alike.
pub const FINAL_TOLERANCE: f64 = 1e-3;

/// A rate in run and reference.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RatePair {
    /// Name of the sub-task, or `full success`.
    pub name: String,
    /// Pairs of episodes by outcome.
    pub pairs: Pairs,
    /// Two-sided p-value of McNemar's exact test.
    pub mcnemar_p: f64,
    /// Difference of the rates as pairs; this one is judged.
    pub paired: Difference,
    /// Difference of the rates as of two independent samples.
    pub unpaired: Difference,
}

/// N-rate of run and reference.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NRatePair {
    /// N-rate of the run.
    pub run: f64,
    /// N-rate of the reference.
    pub reference: f64,
    /// Difference of the N-rates as pairs; this one is judged.
    pub paired: Difference,
    /// Difference of the N-rates as of two independent samples.
    pub unpaired: Difference,
}

/// Comparison of all episodes with the reference's.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Paired {
    /// Number of pairs of episodes.
    pub episodes: usize,
    /// Share of pairs in which the same sub-tasks were completed, in the same order.
    pub identical_completions: f64,
    /// Share of pairs in which they were also completed at the same control steps.
    pub identical_steps: f64,
    /// Share of pairs with the same plans from beginning to end.
    pub identical_plans: f64,
    /// Share of pairs whose noise-free states at the end differ by less than [`FINAL_TOLERANCE`].
    pub same_final_state: f64,
    /// First control step at which plans differ, median over the episodes in which they do; `None` where they never do.
    pub median_first_plan_difference: Option<usize>,
    /// Earliest control step at which plans differ; `None` where they never do.
    pub earliest_plan_difference: Option<usize>,
    /// Largest absolute action difference in traced episodes while trajectories agree.
    pub largest_action_difference: f64,
    /// Number of control steps over which trajectories of traced episodes agreed, and of all their steps.
    pub agreeing_steps: [usize; 2],
    /// N-rate, the mean number of completed sub-tasks.
    pub n_rate: NRatePair,
    /// Rates of each sub-task that is commanded, then of full success.
    pub rates: Vec<RatePair>,
}

impl Paired {
    /// Compares the episodes of each instruction with the reference's, whose plans have the run's numbers by `numbering`; `sub_tasks` are the
    /// environment's, `lens` those of observation and action.
    pub fn new<'r>(
        (reference, numbering): (&Reference, &Numbering),
        sub_tasks: &[&str],
        episodes: impl IntoIterator<Item = Episodes<'r>>,
        traces: impl IntoIterator<Item = Traced<'r>>,
        lens: [usize; 2],
    ) -> Self {
        let mut sum = Sum {
            outcomes: vec![Pairs::default(); sub_tasks.len() + 1],
            ..Sum::default()
        };
        for ours in episodes {
            let Some(theirs) = reference.instructions.get(ours.instruction) else {
                continue;
            };
            for (run, recorded) in ours.episodes.iter().zip(&theirs.episodes) {
                let decided = Decided {
                    plans: recorded
                        .plans
                        .iter()
                        .map(|&plan| numbering.of_run(plan))
                        .collect(),
                    at: reference.decided_at(recorded),
                };
                sum.add(run, recorded, ours.commanded, sub_tasks, &decided);
            }
        }
        for ours in traces {
            let instruction = reference.instructions.get(ours.instruction);
            let recorded = instruction.and_then(|row| row.episodes.get(ours.episode));
            if let Some(theirs) = recorded.and_then(|episode| episode.trace.as_ref()) {
                sum.follow(&ours.steps, theirs, lens);
            }
        }
        sum.finish(sub_tasks)
    }
}

/// Episodes of one instruction in the run.
#[derive(Debug, Clone, Copy)]
pub struct Episodes<'r> {
    /// Index of the instruction.
    pub instruction: usize,
    /// The environment's indices of the sub-tasks that the instruction commands.
    pub commanded: &'r [usize],
    /// Episodes in order of their numbers.
    pub episodes: &'r [Episode],
}

/// A traced episode of the run.
#[derive(Debug, Clone)]
pub struct Traced<'r> {
    /// Index of the instruction.
    pub instruction: usize,
    /// Number of the episode.
    pub episode: usize,
    /// What the policy was given and did at each control step.
    pub steps: Vec<Done<'r>>,
}

/// A control step of a traced episode.
#[derive(Debug, Clone, Copy)]
pub struct Done<'r> {
    /// Observed vector; empty of a policy that sees by cameras alone.
    pub observation: &'r [f32],
    /// Digest of what the cameras showed; `None` of a policy without.
    pub shown: Option<Digest>,
    /// Action of the policy.
    pub action: &'r [f32],
}

/// Plans of the reference in the run's numbers, and the control steps at which they were decided.
struct Decided {
    plans: Vec<u32>,
    at: Vec<usize>,
}

#[derive(Default)]
struct Sum {
    episodes: usize,
    completions: usize,
    steps: usize,
    final_states: usize,
    first_plan_differences: Vec<usize>,
    counts: Counts,
    outcomes: Vec<Pairs>,
    largest_action_difference: f64,
    agreeing_steps: [usize; 2],
}

impl Sum {
    fn add(
        &mut self,
        run: &Episode,
        recorded: &super::reference::Episode,
        commanded: &[usize],
        sub_tasks: &[&str],
        decided: &Decided,
    ) {
        self.episodes += 1;
        let ours: Vec<_> = run
            .completions
            .iter()
            .map(|c| (sub_tasks[c.sub_task], c.step))
            .collect();
        let theirs: Vec<_> = recorded
            .completions
            .iter()
            .map(|c| (c.sub_task.as_str(), c.step))
            .collect();
        let names = |list: &[(&str, usize)]| {
            list.iter()
                .map(|(name, _)| (*name).to_owned())
                .collect::<Vec<_>>()
        };
        self.completions += usize::from(names(&ours) == names(&theirs));
        self.steps += usize::from(ours == theirs && run.steps == recorded.steps);
        let mut ends = run.final_state.iter().zip(&recorded.final_state);
        self.final_states += usize::from(ends.all(|(a, b)| (a - b).abs() < FINAL_TOLERANCE));
        if run.plans != decided.plans {
            let both = run.plans.iter().zip(&decided.plans);
            let same = both.take_while(|(a, b)| a == b).count();
            let step = decided.at.get(same).copied();
            self.first_plan_differences
                .push(step.unwrap_or(recorded.steps));
        }
        let done = |list: &[(&str, usize)], index: usize| {
            list.iter().any(|(name, _)| *name == sub_tasks[index])
        };
        let mut completed = [0, 0];
        for &index in commanded {
            let (a, b) = (done(&ours, index), done(&theirs, index));
            completed[0] += usize::from(a);
            completed[1] += usize::from(b);
            self.outcomes[index].add(a, b);
        }
        self.counts.add(completed[0], completed[1], commanded.len());
        if let Some(full) = self.outcomes.last_mut() {
            full.add(run.success, recorded.success);
        }
    }

    /// Compares actions for as long as both trajectories are the same.
    fn follow(
        &mut self,
        ours: &[Done<'_>],
        theirs: &super::reference::Trace,
        [observation_len, action_len]: [usize; 2],
    ) {
        let done = theirs.actions.chunks_exact(action_len);
        self.agreeing_steps[1] += done.len();
        let largest = |a: &[f32], b: &[f32]| {
            a.iter()
                .zip(b)
                .map(|(a, b)| f64::from((a - b).abs()))
                .fold(0.0, f64::max)
        };
        for (number, (ours, done)) in ours.iter().zip(done).enumerate() {
            let seen = theirs.observations.get(number * observation_len..);
            let apart = largest(ours.observation, seen.unwrap_or_default());
            let shown = ours.shown.as_ref();
            if apart > TRAJECTORY_TOLERANCE || shown != theirs.frames.get(number) {
                return;
            }
            self.agreeing_steps[0] += 1;
            self.largest_action_difference = self
                .largest_action_difference
                .max(largest(ours.action, done));
        }
    }

    fn finish(mut self, sub_tasks: &[&str]) -> Paired {
        let share = |count: usize| count as f64 / self.episodes.max(1) as f64;
        self.first_plan_differences.sort_unstable();
        let differing = &self.first_plan_differences;
        let [run, reference] = self.counts.means();
        let names = sub_tasks.iter().copied().chain(["full success"]);
        let rates = names
            .zip(&self.outcomes)
            .filter(|(_, pairs)| !pairs.is_empty());
        Paired {
            episodes: self.episodes,
            identical_completions: share(self.completions),
            identical_steps: share(self.steps),
            identical_plans: share(self.episodes - differing.len()),
            same_final_state: share(self.final_states),
            median_first_plan_difference: differing.get(differing.len() / 2).copied(),
            earliest_plan_difference: differing.first().copied(),
            largest_action_difference: self.largest_action_difference,
            agreeing_steps: self.agreeing_steps,
            n_rate: NRatePair {
                run,
                reference,
                paired: self.counts.paired(N_RATE_MARGIN),
                unpaired: self.counts.unpaired(N_RATE_MARGIN),
            },
            rates: rates
                .map(|(name, &pairs)| RatePair {
                    name: name.to_owned(),
                    pairs,
                    mcnemar_p: pairs.mcnemar(),
                    paired: pairs.paired(RATE_MARGIN),
                    unpaired: pairs.unpaired(RATE_MARGIN),
                })
                .collect(),
        }
    }
}

impl RatePair {
    /// Rates of run and reference.
    pub fn shares(&self) -> [f64; 2] {
        self.pairs.shares()
    }
}
