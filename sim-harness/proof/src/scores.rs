//! Sums up episodes per instruction and per split.
//!
//! Invariants: the order is that of the instructions and then of the episodes. Nothing here can fail.

use serde::{Serialize, Serializer};

use crate::episode::Episode;
use crate::metrics::{Outcome, Rate, Score};

/// A sub-task that was completed in an episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Completion {
    /// Name of the sub-task.
    pub sub_task: String,
    /// First control step, counted from 1, after which the sub-task was done.
    pub step: usize,
    /// Whether the instruction commands the sub-task.
    pub commanded: bool,
}

/// One episode of an instruction.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Run {
    /// Number of the episode within its instruction; with the seed it identifies the episode's random streams.
    pub episode: usize,
    /// Control steps executed.
    pub steps: usize,
    /// Whether the instruction was carried out; `None` for a sentence that commands no sub-tasks.
    pub success: Option<bool>,
    /// Completed sub-tasks in the order of their completion.
    pub completions: Vec<Completion>,
    /// Selected indices, such as those of latent plans, in order; empty if the policy selects none.
    pub plans: Vec<u32>,
}

/// Rate at which one sub-task was completed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SubTaskRate {
    /// Name of the sub-task.
    pub sub_task: String,
    /// Share of episodes that completed the sub-task, with a Wilson 95 % interval.
    #[serde(flatten)]
    pub rate: Rate,
}

/// An instruction, as far as its episodes are judged by it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Asked<'a> {
    /// Id of the instruction in the contract.
    pub id: &'a str,
    /// Text of the instruction.
    pub text: &'a str,
    /// Split that the instruction belongs to.
    pub split: &'a str,
    /// Sub-tasks that the instruction commands, in its order.
    pub sub_tasks: Vec<&'a str>,
}

/// Results of all episodes of one instruction.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InstructionResult {
    /// Id of the instruction in the contract.
    pub id: String,
    /// Text of the instruction.
    pub text: String,
    /// Split that the instruction belongs to, in the contract's name.
    pub split: String,
    /// Scores of the episodes, whose fields include `episodes`.
    #[serde(flatten)]
    pub score: Score,
    /// Rate of every commanded sub-task, in the order of the instruction.
    pub completions: Vec<SubTaskRate>,
    /// Rate of every other sub-task that was completed at least once, in the environment's order.
    pub un_instructed_completions: Vec<SubTaskRate>,
    /// Episodes of the instruction.
    pub runs: Vec<Run>,
}

impl InstructionResult {
    /// Sums up the episodes of one instruction; `watched` are the environment's sub-tasks.
    pub fn new(instruction: &Asked<'_>, watched: &[&str], episodes: &[Episode]) -> Self {
        let mut commanded = instruction.sub_tasks.clone();
        commanded.retain(|name| watched.contains(name));
        let runs: Vec<Run> = episodes
            .iter()
            .enumerate()
            .map(|(number, e)| run(number, e, watched, &commanded))
            .collect();
        let rate = |sub_task: &str| {
            let done = |run: &&Run| run.completions.iter().any(|c| c.sub_task == sub_task);
            let count = runs.iter().filter(done).count();
            SubTaskRate {
                sub_task: sub_task.to_owned(),
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

/// Describes one episode with the environment's names.
fn run(number: usize, episode: &Episode, watched: &[&str], commanded: &[&str]) -> Run {
    let named = |completion: &crate::episode::Completion| {
        let &sub_task = watched.get(completion.sub_task)?;
        Some(Completion {
            sub_task: sub_task.to_owned(),
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

/// Scores episodes that all command sub-tasks, or none of them.
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

/// Outcome of an episode for the rates; `None` where nothing was commanded.
fn outcome(run: &Run) -> Option<Outcome> {
    let completed = run.completions.iter().filter(|c| c.commanded).count();
    Some(Outcome {
        completed,
        un_instructed: run.completions.len() - completed,
        success: run.success?,
    })
}

/// Results of all instructions of one split together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SplitResult {
    /// Scores of the episodes, whose fields include `episodes`.
    #[serde(flatten)]
    pub score: Score,
    /// Rate of every sub-task over the episodes that commanded it.
    pub completions: Vec<SubTaskRate>,
    /// Rate of every sub-task over the episodes that did not command it, where it was completed at least once.
    pub un_instructed_completions: Vec<SubTaskRate>,
}

/// Results of the contract's splits in its order, by name; in JSON an object.
#[derive(Debug, Clone, PartialEq)]
pub struct Splits(pub Vec<(String, SplitResult)>);

impl Splits {
    /// Sums up all episodes of each split in `names`; `watched` are the environment's sub-tasks.
    pub fn of(names: &[String], instructions: &[InstructionResult], watched: &[&str]) -> Self {
        let of_split = |name: &String| {
            let own = instructions.iter().filter(|result| result.split == *name);
            let own: Vec<_> = own.collect();
            (name.clone(), SplitResult::of(&own, watched))
        };
        Self(names.iter().map(of_split).collect())
    }

    /// Returns the result of a split.
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

impl SplitResult {
    fn of(instructions: &[&InstructionResult], watched: &[&str]) -> Self {
        let rate = |sub_task: &str, commanded: bool| {
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
                sub_task: sub_task.to_owned(),
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

#[cfg(test)]
mod tests {
    use super::*;

    const WATCHED: [&str; 5] = ["a", "b", "c", "d", "e"];

    fn episode(success: bool, done: &[(usize, usize)]) -> Episode {
        let completion = |&(sub_task, step)| crate::episode::Completion { sub_task, step };
        Episode {
            steps: 280,
            success,
            completions: done.iter().map(completion).collect(),
            plans: vec![0; 14],
            final_state: vec![0.0; 5],
        }
    }

    fn two_instructions() -> [InstructionResult; 2] {
        let known = |id, sub_tasks: &'static str, split| Asked {
            id,
            text: "t",
            split,
            sub_tasks: sub_tasks.split(',').collect(),
        };
        let first = [
            episode(true, &[(0, 3), (1, 9), (4, 11), (2, 20), (3, 30)]),
            episode(false, &[(1, 5)]),
        ];
        let second = [episode(false, &[(0, 2), (3, 8)])];
        [
            InstructionResult::new(&known("dcba", "d,c,b,a", "seen"), &WATCHED, &first),
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
            .map(|rate| (rate.sub_task.as_str(), rate.rate.count))
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
            .map(|c| (c.sub_task.as_str(), c.commanded))
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
