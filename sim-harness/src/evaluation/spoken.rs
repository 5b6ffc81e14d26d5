//! Instructions that are not taken from the bundle's table: sentences in any words, and known ones that the language encoder hears anew.
//!
//! A sentence outside the table commands no sub-tasks of its own. Without any, its episodes last their full time and have no success rate;
//! with some, they start, last and succeed as the benchmark's episodes of these sub-tasks. What can fail: a sub-task that nobody knows.

use std::collections::{BTreeMap, BTreeSet};

use lads_core::{Contract, KnownInstruction};
use thiserror::Error;

use crate::environment::Environment;
use crate::evaluate::Assignment;
use crate::fit;

/// Id and split of a sentence outside the table, in results.
pub const FREE: &str = "free";

/// Word embeddings by instruction, heard instead of the table's.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WordBook {
    words: BTreeMap<u32, Vec<f32>>,
    /// The sentence outside the table, if one is said; its number is the table's length.
    pub sentence: Option<Sentence>,
}

impl WordBook {
    /// Sets the embeddings `[n, E]` of an instruction.
    pub fn set(&mut self, instruction: u32, words: Vec<f32>) {
        self.words.insert(instruction, words);
    }

    /// The embeddings of an instruction; `None` where the table's are heard.
    pub fn of(&self, instruction: u32) -> Option<&[f32]> {
        self.words.get(&instruction).map(Vec::as_slice)
    }
}

/// Sub-tasks by which a sentence is judged are named wrongly.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SubTaskError {
    /// There are none.
    #[error("no sub-task is named; name some of: {known}")]
    None {
        /// All that the environment watches.
        known: String,
    },
    /// The environment does not watch one.
    #[error("the environment watches no sub-task '{name}'; name some of: {known}")]
    Unknown {
        /// The sub-task.
        name: String,
        /// All that the environment watches.
        known: String,
    },
}

/// A sentence outside the table, and what it is judged by.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sentence {
    text: String,
    /// Names separated by commas, as in contracts; empty for none.
    sub_tasks: String,
    commanded: Vec<usize>,
}

impl Sentence {
    /// A sentence with the sub-tasks, separated by commas, that it is judged by.
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
        let names: Vec<_> = commanded
            .iter()
            .filter_map(|&place| watched.get(place))
            .copied()
            .collect();
        Ok(Self {
            text: text.to_owned(),
            sub_tasks: names.join(","),
            commanded,
        })
    }

    /// Its episodes: numbered behind the table, and as long as those of the first known instruction with the same sub-tasks; where there is
    /// none, as long as the benchmark's longest.
    pub fn assignment(&self, contract: &Contract<'_>, environment: &dyn Environment) -> Assignment {
        let set = |list: &str| {
            fit::sub_tasks(list)
                .map(str::to_owned)
                .collect::<BTreeSet<_>>()
        };
        let own = set(&self.sub_tasks);
        let alike = contract
            .instructions()
            .find(|known| set(known.sub_tasks) == own);
        let splits = contract
            .instructions()
            .map(|known| environment.max_steps(known.split));
        let max_steps = alike.map_or_else(
            || splits.max().unwrap_or(0),
            |known| environment.max_steps(known.split),
        );
        Assignment {
            instruction: contract.instruction_count() as u32,
            commanded: self.commanded.clone(),
            max_steps,
        }
    }

    /// As an entry of the table would say it, without its embeddings.
    pub fn known(&self) -> KnownInstruction<'_> {
        KnownInstruction {
            id: FREE,
            text: &self.text,
            sub_tasks: &self.sub_tasks,
            split: FREE,
            words: &[],
        }
    }
}

/// The known instruction whose embeddings are most like `words`, and how much: the cosine of the means over the words.
pub fn nearest<'c>(contract: &Contract<'c>, words: &[f32]) -> Option<(KnownInstruction<'c>, f64)> {
    let heard = mean(words, contract.word_dim());
    let alike = contract.instructions().map(|known| {
        (
            known,
            cosine(&mean(known.words, contract.word_dim()), &heard),
        )
    });
    alike.max_by(|(_, a), (_, b)| a.total_cmp(b))
}

fn mean(words: &[f32], dim: usize) -> Vec<f64> {
    let mut sum = vec![0.0; dim];
    for word in words.chunks_exact(dim) {
        for (sum, &x) in sum.iter_mut().zip(word) {
            *sum += f64::from(x);
        }
    }
    sum
}

fn cosine(a: &[f64], b: &[f64]) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let lengths = (dot(a, a) * dot(b, b)).sqrt();
    if lengths > 0.0 {
        dot(a, b) / lengths
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_instruction_has_the_largest_cosine() {
        let cosine = |a: &[f64], b: &[f64]| cosine(a, b);
        assert!((cosine(&[3.0, 4.0], &[6.0, 8.0]) - 1.0).abs() < 1e-12);
        assert!(cosine(&[1.0, 0.0], &[0.0, 2.0]).abs() < 1e-12);
        assert_eq!(cosine(&[0.0, 0.0], &[0.0, 2.0]), 0.0);
        assert_eq!(mean(&[1.0, 2.0, 3.0, 4.0], 2), [4.0, 6.0]);
    }
}
