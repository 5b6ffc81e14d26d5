//! The one line with which the command refuses: the thing, the fault, the remedy. If a person has
//! to settle many things at once, a line for each follows.
//!
//! Invariant: every line of a printed refusal was made here, whatever the errors underneath contain.

use std::error::Error;
use std::fmt::{self, Display};

/// Reason why the command ended without doing its work; exit code 2.
#[derive(Debug)]
pub struct Refusal(String);

impl Refusal {
    /// Makes a refusal from the `thing` (a path, an argument, a line of input), its fault, and the
    /// remedy.
    pub fn new(thing: impl Display, wrong: impl Display, remedy: impl Display) -> Self {
        Self(one_line(&format!("{thing}: {wrong}; {remedy}")))
    }

    /// Makes a refusal from an error that names the thing and the remedy itself.
    pub fn of(error: impl Display) -> Self {
        Self(one_line(&error.to_string()))
    }

    /// Makes a refusal that lists all faults of `thing`, a line for each, and the remedy.
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

    /// Makes a refusal from the `thing` and an error that names the remedy itself.
    pub fn with_remedy_inside(thing: impl Display, error: impl Display) -> Self {
        Self(one_line(&format!("{thing}: {error}")))
    }
}

impl Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Formats an error and its causes as one line.
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

/// Joins lines and drops unprintable characters.
pub fn one_line(text: &str) -> String {
    let words = text.split(|c: char| c.is_whitespace() || c.is_control());
    words
        .filter(|word| !word.is_empty())
        .collect::<Vec<_>>()
        .join(" ")
}

/// Replaces control characters but line ends by what names them, such as `\u{1b}`.
pub fn without_controls(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for c in text.chars() {
        if c.is_control() && c != '\n' {
            shown.extend(c.escape_default());
        } else {
            shown.push(c);
        }
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_control_character_is_left() {
        let shown = without_controls("hip\u{1b}[2J\u{7}\r\nknee é\n");
        assert_eq!(shown, "hip\\u{1b}[2J\\u{7}\\r\nknee é\n");
    }

    #[test]
    fn always_one_line() {
        let refusal = Refusal::new("a.onnx", "broken\n\tin two\u{1b} ways", "export it again");
        assert_eq!(
            refusal.to_string(),
            "a.onnx: broken in two ways; export it again"
        );
    }
}
