//! Reason why a measurement could not be made, in one line: the thing, the fault, the remedy.

use std::fmt::Display;

/// One line that describes the error to the user.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct BenchError(String);

impl BenchError {
    /// Makes an error from the `thing` (a file, a contender, an argument), its fault, and the
    /// remedy.
    pub fn new(thing: impl Display, wrong: impl Display, remedy: impl Display) -> Self {
        Self::of(&format_args!("{thing}: {wrong}; {remedy}"))
    }

    /// Makes an error from one that names thing and remedy itself.
    pub fn of(error: &dyn Display) -> Self {
        let text = error.to_string();
        let words: Vec<_> = text.split_whitespace().collect();
        Self(words.join(" "))
    }
}
