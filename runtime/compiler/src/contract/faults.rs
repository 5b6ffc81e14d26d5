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

/// Faults found so far.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    found: Vec<(String, Fault)>,
}

impl Faults {
    /// Adds the fault of a field.
    pub fn add(&mut self, field: &str, problem: impl Into<Line>) {
        let fault = Fault {
            field: field.into(),
            problem: problem.into(),
        };
        self.found.push((field.to_owned(), fault));
    }

    /// Returns whether none of these parts of the contract has a fault: what is judged by a faulty
    /// field would be a fault that nobody made.
    pub fn spare(&self, parts: &[&str]) -> bool {
        let within = |field: &str, part: &str| {
            field.strip_prefix(part).is_some_and(|rest| {
                rest.is_empty() || rest.starts_with('.') || rest.starts_with('[')
            })
        };
        let hit = |field: &str| parts.iter().any(|part| within(field, part));
        !self.found.iter().any(|(field, _)| hit(field))
    }

    /// Returns whether there is none.
    pub fn is_empty(&self) -> bool {
        self.found.is_empty()
    }

    /// Returns the number of faults.
    pub fn len(&self) -> usize {
        self.found.len()
    }

    /// Returns the faults, in the order in which they were found.
    pub fn into_vec(self) -> Vec<Fault> {
        self.found.into_iter().map(|(_, fault)| fault).collect()
    }
}
