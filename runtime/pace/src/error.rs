//! Why a measurement could not be made, in one line: the thing, what is wrong with it, the remedy.

use std::fmt::Display;

/// One line for the user.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct BenchError(String);

impl BenchError {
    /// `thing` (a file, a contender, an argument), what is wrong with it, and the remedy.
    pub fn new(thing: impl Display, wrong: impl Display, remedy: impl Display) -> Self {
        Self::of(&format_args!("{thing}: {wrong}; {remedy}"))
    }

    /// An error that names thing and remedy itself.
    pub fn of(error: &dyn Display) -> Self {
        let text = error.to_string();
        let words: Vec<_> = text.split_whitespace().collect();
        Self(words.join(" "))
    }
}
