//! Problems between a file and a policy, collected so that a person sees all of them at once.

use std::collections::HashSet;
use std::fmt::{self, Display, Formatter};

use lads_compiler::Line;

/// One missing or contradictory thing.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Problem {
    /// Subject of the problem: a field of the robot's description, a value or a node of the graph,
    /// a file.
    pub about: String,
    /// Fault of the subject, and its remedy.
    pub wrong: String,
}

/// All problems of an import, in the order in which they were found.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Problems {
    all: Vec<Problem>,
    known: HashSet<Problem>,
}

impl Problems {
    /// Adds a problem unless it is there already.
    pub(crate) fn add(&mut self, about: impl Display, wrong: impl Display) {
        let line = |text: String| Line::from(text).to_string();
        let problem = Problem {
            about: line(about.to_string()),
            wrong: line(wrong.to_string()),
        };
        if self.known.insert(problem.clone()) {
            self.all.push(problem);
        }
    }

    /// Returns whether there are no problems.
    pub fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Returns all problems.
    pub fn all(&self) -> &[Problem] {
        &self.all
    }
}

/// Formats one line for each problem.
impl Display for Problems {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        for problem in &self.all {
            writeln!(f, "  {}: {}", problem.about, problem.wrong)?;
        }
        Ok(())
    }
}
