//! Tracks which process a controller belongs to: a copy that a fork made is refused.
//!
//! `lads/__init__.py` has `os.register_at_fork` call [`forked`] in every child, so that the check
//! costs no system call. A fork that Python does not make is not noticed.

use std::sync::atomic::{AtomicU32, Ordering};

use pyo3::prelude::*;

use crate::errors::ForkError;

/// Number of forks between the first process and this one.
static GENERATION: AtomicU32 = AtomicU32::new(0);

/// Counts a fork; called in the child of every fork.
#[pyfunction]
pub fn forked() {
    GENERATION.fetch_add(1, Ordering::Relaxed);
}

/// Identity of the process in which an object was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Process(u32);

impl Process {
    /// Returns the current process.
    pub fn current() -> Self {
        Self(GENERATION.load(Ordering::Relaxed))
    }

    /// Returns whether this is the current process.
    pub fn is_current(self) -> bool {
        self == Self::current()
    }

    /// Refuses an object that was made before a fork; `how` explains how to make a new one.
    pub fn check(self, what: &str, how: &str) -> PyResult<()> {
        if self.is_current() {
            return Ok(());
        }
        Err(ForkError::new_err(format!(
            "the {what} was made before this process was forked, and belongs to the other one; make one here, by {how}"
        )))
    }
}
