//! Faults of a contract, each with the field that it is in, collected so that all are reported at once.

use std::fmt;

use crate::error::Line;

/// Fault of one field of a contract.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// Path of the field, for example `channels[2].elements[0].unit`.
    pub field: Line,
    /// Fault of the field, and the content that it must have.
    pub problem: Line,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "field `{}` {}", self.field, self.problem)
    }
}

/// Number of faults after which no more are looked for: a person has enough to do.
const MOST: usize = 1000;

/// Faults found so far: first those of the form, in whose place the contract has parts of an
/// example, then those of the meaning.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    found: Vec<(String, Fault)>,
    of_form: usize,
    cut: bool,
}

impl Faults {
    /// Adds the fault of a field.
    pub fn add(&mut self, field: &str, problem: impl Into<Line>) {
        if self.cut {
            return;
        }
        self.cut = self.found.len() >= MOST;
        let problem = if self.cut {
            "and what follows it are not looked at: there are too many faults".into()
        } else {
            problem.into()
        };
        let fault = Fault {
            field: field.into(),
            problem,
        };
        self.found.push((field.to_owned(), fault));
    }

    /// Returns whether there are too many faults to go on; then no part counts as the contract's own.
    pub fn is_cut(&self) -> bool {
        self.cut
    }

    /// Ends the faults of the form.
    pub fn form_is_read(&mut self) {
        self.of_form = self.found.len();
    }

    /// Returns whether the contract has its own values in all these parts, as a check needs that
    /// reads them: an example's would be faults that nobody made.
    pub fn sound(&self, parts: &[&str]) -> bool {
        let mut form = self.found.iter().take(self.of_form);
        !self.cut
            && !form.any(|(field, _)| {
                let touches = |part: &&str| within(field, part) || within(part, field);
                parts.iter().any(touches)
            })
    }

    /// Returns whether a list has as many elements as the contract says.
    pub fn counted(&self, list: &str) -> bool {
        let mut form = self.found.iter().take(self.of_form);
        !self.cut && !form.any(|(field, _)| within(list, field))
    }

    /// Returns whether these parts are sound and nothing else is wrong with them.
    pub fn free(&self, parts: &[&str]) -> bool {
        let mut meant = self.found.iter().skip(self.of_form);
        let hit = |field: &str| parts.iter().any(|part| within(field, part));
        self.sound(parts) && !meant.any(|(field, _)| hit(field))
    }

    /// Returns whether there is none.
    pub fn is_empty(&self) -> bool {
        self.found.is_empty()
    }

    /// Returns the faults, in the order in which they were found.
    pub fn into_vec(self) -> Vec<Fault> {
        self.found.into_iter().map(|(_, fault)| fault).collect()
    }
}

/// Returns whether a field is a part or lies in it.
fn within(field: &str, part: &str) -> bool {
    let rest = field.strip_prefix(part);
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.') || rest.starts_with('['))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_is_sound_where_neither_it_nor_what_it_lies_in_was_replaced() {
        let mut faults = Faults::default();
        faults.add("channels[1].elements[0].min", "");
        faults.add("language", "");
        faults.form_is_read();
        faults.add("channels[0].shape", "");
        assert!(!faults.sound(&["channels[1]"]) && !faults.sound(&["channels[1].elements"]));
        assert!(!faults.sound(&["context", "language.dim"]));
        assert!(faults.sound(&["channels[1].elements[0].max", "channels[10]", "channels[0]"]));
        assert!(faults.counted("channels[1].elements") && !faults.counted("language.dim"));
        assert!(!faults.free(&["channels[0]"]) && faults.free(&["channels[0].dtype"]));
    }
}
