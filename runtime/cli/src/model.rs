//! A policy that the command was given: as lads-host opens it, and refusals that name its file.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use lads_compiler::Options;
use lads_core::Policy;
use lads_host::Opened;

use crate::refusal::{Refusal, chain};

/// A policy that was read, with its compiled image.
pub struct Model {
    /// Where it was read from.
    pub path: PathBuf,
    opened: Opened,
}

impl Model {
    /// Reads and, where it is a bundle, compiles the policy at `path`, its numbers stored as it was tuned.
    pub fn open(path: &Path) -> Result<Self, Refusal> {
        Self::compile(path, &Options::default())
    }

    /// The same, stored otherwise; an image has those that it was compiled with.
    pub fn compile(path: &Path, options: &Options) -> Result<Self, Refusal> {
        let opened = lads_host::open_with(path, options);
        Ok(Self {
            path: path.to_owned(),
            opened: opened.map_err(|error| Refusal::of(chain(&error)))?,
        })
    }

    /// The policy.
    pub fn opened(&self) -> &Opened {
        &self.opened
    }

    /// Whether it was read from a bundle and compiled, not read as an image.
    pub fn is_bundle(&self) -> bool {
        self.opened.is_bundle()
    }

    /// The compiled image.
    pub fn image(&self) -> &[u8] {
        self.opened.image()
    }

    /// The checked view on the image.
    pub fn policy(&self) -> Policy<'_> {
        self.opened.policy()
    }

    /// What is wrong with the policy, by an error that says itself what to do.
    pub fn refused(&self, error: impl Display) -> Refusal {
        Refusal::with_remedy_inside(self.path.display(), error)
    }

    /// The number of the instruction with this id, or with this text up to case and white space.
    pub fn instruction(&self, wanted: &str) -> Result<u32, Refusal> {
        self.opened.instruction(wanted).map_err(Refusal::of)
    }
}
