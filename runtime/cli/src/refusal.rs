//! The one line with which the command refuses: what it is about, what is wrong with it, what to do. Where a person has to settle many
//! things at once, there is a line for each of them below.
//!
//! Invariant: every line of a printed refusal was made here, whatever the errors underneath contain.

use std::error::Error;
use std::fmt::{self, Display};

/// Why the command ended without doing what it was asked; exit code 2.
#[derive(Debug)]
pub struct Refusal(String);

impl Refusal {
    /// `thing` (a path, an argument, a line of input), what is wrong with it, and the remedy.
    pub fn new(thing: impl Display, wrong: impl Display, remedy: impl Display) -> Self {
        Self(one_line(&format!("{thing}: {wrong}; {remedy}")))
    }

    /// An error that names the thing and the remedy itself.
    pub fn of(error: impl Display) -> Self {
        Self(one_line(&error.to_string()))
    }

    /// All that is wrong with `thing`, a line for each, and the remedy.
    pub fn list(
        thing: impl Display,
        wrong: impl Iterator<Item = String>,
        remedy: impl Display,
    ) -> Self {
        let wrong: Vec<String> = wrong.map(|line| format!("  {}", one_line(&line))).collect();
        let things = if wrong.len() == 1 { "thing" } else { "things" };
        let head = one_line(&format!(
            "{thing}: {} {things} to settle; {remedy}",
            wrong.len()
        ));
        Self(format!("{head}\n{}", wrong.join("\n")))
    }

    /// The same with an error that says itself what to do.
    pub fn with_remedy_inside(thing: impl Display, error: impl Display) -> Self {
        Self(one_line(&format!("{thing}: {error}")))
    }
}

impl Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// An error and what caused it, as one line.
pub fn chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_text = cause.to_string();
        // Many errors already print their cause.
        if !text.contains(&cause_text) {
            text = format!("{text}: {cause_text}");
        }
        source = cause.source();
    }
    one_line(&text)
}

/// Joins lines and drops what does not print.
pub fn one_line(text: &str) -> String {
    let words = text.split(|c: char| c.is_whitespace() || c.is_control());
    words
        .filter(|word| !word.is_empty())
        .collect::<Vec<_>>()
        .join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn always_one_line() {
        let refusal = Refusal::new("a.onnx", "broken\n\tin two\u{1b} ways", "export it again");
        assert_eq!(
            refusal.to_string(),
            "a.onnx: broken in two ways; export it again"
        );
    }
}
