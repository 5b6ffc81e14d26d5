//! Opens the policy that is given to a command, with refusals that name its file.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use lads_compiler::Options;
use lads_core::Policy;
use lads_host::Opened;

use crate::refusal::{Refusal, chain};

/// A policy that was read, with its compiled image.
pub struct Model {
    /// Path that the policy was read from.
    pub path: PathBuf,
    opened: Opened,
}

impl Model {
    /// Reads the policy at `path` and compiles it if it is a bundle, with the formats that it was
    /// tuned for.
    pub fn open(path: &Path) -> Result<Self, Refusal> {
        Self::compile(path, &Options::default())
    }

    /// Reads the policy at `path` and compiles it if it is a bundle, with these options; an image
    /// keeps the formats that it was compiled with.
    pub fn compile(path: &Path, options: &Options) -> Result<Self, Refusal> {
        let opened = lads_host::open_with(path, options);
        Ok(Self {
            path: path.to_owned(),
            opened: opened.map_err(|error| Refusal::of(chain(&error)))?,
        })
    }

    /// Returns the policy.
    pub fn opened(&self) -> &Opened {
        &self.opened
    }

    /// Returns whether the policy was read from a bundle and compiled, not read as an image.
    pub fn is_bundle(&self) -> bool {
        self.opened.is_bundle()
    }

    /// Returns the compiled image.
    pub fn image(&self) -> &[u8] {
        self.opened.image()
    }

    /// Returns the checked view on the image.
    pub fn policy(&self) -> Policy<'_> {
        self.opened.policy()
    }

    /// Makes a refusal of the policy from an error that names the remedy itself.
    pub fn refused(&self, error: impl Display) -> Refusal {
        Refusal::with_remedy_inside(self.path.display(), error)
    }

    /// Returns the number of the instruction with this id, or with this text up to case and white
    /// space.
    pub fn instruction(&self, wanted: &str) -> Result<u32, Refusal> {
        self.opened.instruction(wanted).map_err(Refusal::of)
    }
}
