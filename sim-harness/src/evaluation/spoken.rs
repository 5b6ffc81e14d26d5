//! Instructions from outside the bundle's table: sentences in any words, and known ones that the language encoder encodes again.
//!
//! A sentence outside the table commands no sub-tasks of its own. Without any, its episodes last their full time and have no success rate;
//! with some, they start, last and succeed as the benchmark's episodes of these sub-tasks. What can fail: a sub-task that nobody knows, and
//! a sentence that is too little like what the policy knows ([`accept`]).

use std::collections::{BTreeMap, BTreeSet};

use lads_compiler::Contract;
use lads_compiler::contract::Acceptance;
use lads_core::similarity;
use thiserror::Error;

use crate::environment::Environment;
use crate::evaluate::Assignment;
use crate::fit;
use crate::results::{Asked, InstructionResult};

/// Id and split of a sentence outside the table, in results.
pub const FREE: &str = "free";

/// Word embeddings by instruction, which replace those of the table.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WordBook {
    words: BTreeMap<u32, Vec<f32>>,
    /// The sentence outside the table, if there is one; its number is the table's length.
    pub sentence: Option<Sentence>,
}

impl WordBook {
    /// Sets the embeddings `[n, E]` of an instruction.
    pub fn set(&mut self, instruction: u32, words: Vec<f32>) {
        self.words.insert(instruction, words);
    }

    /// Returns the embeddings of an instruction; `None` where those of the table are used.
    pub fn of(&self, instruction: u32) -> Option<&[f32]> {
        self.words.get(&instruction).map(Vec::as_slice)
    }
}

/// Why the sub-tasks by which a sentence is judged cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SubTaskError {
    /// No sub-task was named.
    #[error("no sub-task is named; name some of: {known}")]
    None {
        /// All sub-tasks that the environment watches.
        known: String,
    },
    /// The environment does not watch the named sub-task.
    #[error("the environment watches no sub-task '{name}'; name some of: {known}")]
    Unknown {
        /// The named sub-task.
        name: String,
        /// All sub-tasks that the environment watches.
        known: String,
    },
}

/// A sentence outside the table, and the sub-tasks that it is judged by.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sentence {
    text: String,
    sub_tasks: Vec<String>,
    commanded: Vec<usize>,
}

impl Sentence {
    /// Makes a sentence that is judged by the comma-separated `sub_tasks`.
    pub fn new(
        text: &str,
        sub_tasks: Option<&str>,
        environment: &dyn Environment,
    ) -> Result<Self, SubTaskError> {
        let watched = environment.sub_tasks();
        let known = || watched.join(", ");
        let names: Vec<&str> =
            sub_tasks.map_or_else(Vec::new, |list| fit::sub_tasks(list).collect());
        if sub_tasks.is_some() && names.is_empty() {
            return Err(SubTaskError::None { known: known() });
        }
        let mut commanded = Vec::new();
        for &name in &names {
            let place = watched.iter().position(|&watched| watched == name);
            let place = place.ok_or_else(|| SubTaskError::Unknown {
                name: name.to_owned(),
                known: known(),
            })?;
            if !commanded.contains(&place) {
                commanded.push(place);
            }
        }
        let names = commanded.iter().filter_map(|&place| watched.get(place));
        let names = names.map(|&name| name.to_owned());
        Ok(Self {
            text: text.to_owned(),
            sub_tasks: names.collect(),
            commanded,
        })
    }

    /// Assignment of the sentence's episodes: numbered behind the table, and as long as those of the first known instruction with the same
    /// sub-tasks; where there is none, as long as the benchmark's longest.
    pub fn assignment(&self, contract: &Contract, environment: &dyn Environment) -> Assignment {
        let set = |names: &[String]| names.iter().cloned().collect::<BTreeSet<_>>();
        let own = set(&self.sub_tasks);
        let known = contract.instructions.len();
        let mut evaluated = (0..known).map(|index| contract.evaluated(index));
        let alike = evaluated.find(|(sub_tasks, _)| set(sub_tasks) == own);
        let splits = (0..known).map(|index| environment.max_steps(contract.evaluated(index).1));
        let max_steps = alike.map_or_else(
            || splits.max().unwrap_or(0),
            |(_, split)| environment.max_steps(split),
        );
        Assignment {
            instruction: known as u32,
            commanded: self.commanded.clone(),
            max_steps,
        }
    }

    /// Describes how the sentence is evaluated, in the same form as an instruction of the table.
    pub fn asked(&self) -> Asked<'_> {
        Asked {
            id: FREE,
            text: &self.text,
            split: FREE,
            sub_tasks: self.sub_tasks.iter().map(String::as_str).collect(),
        }
    }
}

/// Finds the known instruction that `words` are most like, and their similarity: [`similarity::alignment`].
pub fn nearest(contract: &lads_core::Contract<'_>, words: &[f32]) -> Option<(usize, f32)> {
    let known = contract.instructions().map(|known| known.words);
    similarity::nearest(words, known, contract.word_dim())
}

/// Why a sentence is not followed.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum Unaccepted {
    /// The similarity to the nearest known instruction is below the bundle's threshold.
    #[error("the bundle follows a sentence from {threshold:.3} on")]
    Below {
        /// The contract's threshold.
        threshold: f32,
    },
    /// The bundle has no calibrated threshold.
    #[error("the bundle's contract does not say from where on it follows one")]
    Uncalibrated,
}

/// Decides whether a sentence of this similarity to the nearest known instruction is followed.
pub fn accept(acceptance: Option<&Acceptance>, similarity: f32) -> Result<(), Unaccepted> {
    let threshold = acceptance.ok_or(Unaccepted::Uncalibrated)?.threshold;
    if similarity >= threshold {
        Ok(())
    } else {
        Err(Unaccepted::Below { threshold })
    }
}

/// Describes in one line what a sentence that names no sub-tasks has completed: all, and what of it the nearest known instruction does not
/// ask for.
///
/// Nobody said what the sentence asks for; beside the nearest instruction a person sees what was done un-instructed.
pub fn completed(nearest: &Asked<'_>, result: &InstructionResult) -> String {
    let asked = &nearest.sub_tasks;
    let list = |beyond: bool| {
        let all = result.un_instructed_completions.iter();
        let done = all.filter(|of| !beyond || !asked.contains(&of.sub_task.as_str()));
        let done: Vec<_> = done
            .map(|of| format!("{} {}", of.sub_task, of.rate.count))
            .collect();
        if done.is_empty() {
            "nothing".to_owned()
        } else {
            done.join(", ")
        }
    };
    format!(
        "completed in {} episodes: {}; of these un-instructed by '{}', the nearest known instruction: {}",
        result.score.episodes,
        list(false),
        nearest.text,
        list(true)
    )
}

#[cfg(test)]
mod tests {
    use lads_compiler::contract::Similarity;

    use super::*;

    #[test]
    fn sentences_are_accepted_from_the_threshold_on() {
        let calibrated = Acceptance {
            similarity: Similarity::Alignment,
            threshold: 0.608,
            accepted_known: 0.9,
            accepted_other: 0.1,
        };
        assert_eq!(accept(Some(&calibrated), 0.608), Ok(()));
        let below = accept(Some(&calibrated), 0.607).unwrap_err();
        assert!(below.to_string().contains("from 0.608 on"), "{below}");
        assert!(accept(Some(&calibrated), f32::NAN).is_err());
        assert_eq!(accept(None, 1.0), Err(Unaccepted::Uncalibrated));
    }
}
