//! A policy from a file, whichever of its two forms: the bundle (ONNX), which is compiled on the way, or a compiled program image.
//!
//! Which of them it is, is told by its first bytes, not by its name. Invariant of an [`Opened`]: its image was checked, and its
//! checksum is right. What can fail: the file cannot be read, is neither of the two, or is broken ([`OpenError`]).

use std::io;
use std::path::{Path, PathBuf};

#[cfg(feature = "compile")]
use lads_compiler::{Bundle, BundleError, CompileError, Options};
use lads_core::{Controller, Isa, Policy, PolicyError};
use lads_image::format::MAGIC;

use crate::aligned::Aligned;
use crate::input;
use crate::instruction::{self, UnknownInstruction};
use crate::memory::{Memory, MemoryError};

/// A policy that was read and checked, its image in large pages.
#[derive(Debug)]
pub struct Opened {
    image: Aligned,
    #[cfg(feature = "compile")]
    bundle: Option<Box<Bundle>>,
}

/// Reads the policy at `path`; a bundle is compiled, its numbers stored as it was tuned.
pub fn open(path: &Path) -> Result<Opened, OpenError> {
    at(path, from_bytes)
}

/// Reads a policy from a file's content; a bundle is compiled, its numbers stored as it was tuned.
pub fn from_bytes(bytes: &[u8]) -> Result<Opened, OpenError> {
    if is_image(bytes) {
        return image(bytes);
    }
    #[cfg(feature = "compile")]
    return compiled(bytes, &Options::default());
    #[cfg(not(feature = "compile"))]
    return Err(Problem::NoCompiler.into());
}

/// Reads the policy at `path` and compiles it as `options` say; an image has what it was compiled with.
#[cfg(feature = "compile")]
pub fn open_with(path: &Path, options: &Options) -> Result<Opened, OpenError> {
    at(path, |bytes| from_bytes_with(bytes, options))
}

/// Reads a policy from a file's content and compiles it as `options` say; an image has what it was compiled with.
#[cfg(feature = "compile")]
pub fn from_bytes_with(bytes: &[u8], options: &Options) -> Result<Opened, OpenError> {
    if is_image(bytes) {
        image(bytes)
    } else {
        compiled(bytes, options)
    }
}

/// Whether a file's content is a program image, of whatever version.
fn is_image(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC.to_le_bytes())
}

/// Reads the file, and names it in errors.
fn at(
    path: &Path,
    read: impl FnOnce(&[u8]) -> Result<Opened, OpenError>,
) -> Result<Opened, OpenError> {
    let opened = input::read(path)
        .map_err(|error| Problem::Read(error).into())
        .and_then(|bytes| read(&bytes));
    opened.map_err(|error| OpenError {
        path: Some(path.to_owned()),
        ..error
    })
}

fn image(bytes: &[u8]) -> Result<Opened, OpenError> {
    let image = Aligned::new(bytes);
    let policy = Policy::new_checked(image.as_bytes()).map_err(Problem::Image)?;
    if !policy.checksum_matches() {
        return Err(Problem::Changed.into());
    }
    Ok(Opened {
        image,
        #[cfg(feature = "compile")]
        bundle: None,
    })
}

#[cfg(feature = "compile")]
fn compiled(bytes: &[u8], options: &Options) -> Result<Opened, OpenError> {
    let bundle = Bundle::from_bytes(bytes).map_err(Problem::Bundle)?;
    let image = lads_compiler::compile_with(&bundle, options).map_err(Problem::Compile)?;
    let image = Aligned::new(image.as_bytes());
    Policy::new_checked(image.as_bytes()).map_err(Problem::Image)?;
    Ok(Opened {
        image,
        bundle: Some(Box::new(bundle)),
    })
}

impl Opened {
    /// The program image.
    pub fn image(&self) -> &[u8] {
        self.image.as_bytes()
    }

    /// The checked view on the image.
    pub fn policy(&self) -> Policy<'_> {
        match Policy::new_checked(self.image()) {
            Ok(policy) => policy,
            Err(error) => unreachable!("it was checked when it was opened: {error}"),
        }
    }

    /// Whether it was read from a bundle and compiled, not read as an image.
    pub fn is_bundle(&self) -> bool {
        #[cfg(feature = "compile")]
        return self.bundle.is_some();
        #[cfg(not(feature = "compile"))]
        return false;
    }

    /// The bundle that it was read from, with a contract that says more than the image's.
    #[cfg(feature = "compile")]
    pub fn bundle(&self) -> Option<&Bundle> {
        self.bundle.as_deref()
    }

    /// The number of the known instruction that a person means, by [the one rule](lads_core::Contract::instructions_called).
    pub fn instruction(&self, wanted: &str) -> Result<u32, UnknownInstruction> {
        instruction::find(self.policy().contract(), wanted)
    }

    /// Gives it the memory of one controller.
    pub fn load(self) -> Result<Loaded, MemoryError> {
        let memory = Memory::of(&self.policy())?;
        Ok(Loaded {
            opened: self,
            memory,
        })
    }
}

/// A policy with the memory of one controller.
#[derive(Debug)]
pub struct Loaded {
    opened: Opened,
    memory: Memory,
}

impl Loaded {
    /// The policy.
    pub fn opened(&self) -> &Opened {
        &self.opened
    }

    /// A fresh controller on the widest instructions that this CPU offers.
    pub fn controller(&mut self) -> Controller<'_, '_> {
        self.controller_with(Isa::detect())
    }

    /// A fresh controller on chosen instructions.
    pub fn controller_with(&mut self, isa: Isa) -> Controller<'_, '_> {
        let policy = self.opened.policy();
        match self.memory.controller_with(&policy, isa) {
            Ok(controller) => controller,
            Err(error) => unreachable!("the memory was made for this policy: {error}"),
        }
    }
}

/// Why a file is no policy that can be used; one line that names the file, where there is one, and the remedy.
#[derive(Debug, thiserror::Error)]
#[error("{}{problem}", path.as_ref().map(|path| format!("{}: ", path.display())).unwrap_or_default())]
pub struct OpenError {
    /// The file, unless only its content was given.
    pub path: Option<PathBuf>,
    /// What is wrong with it.
    #[source]
    pub problem: Problem,
}

impl From<Problem> for OpenError {
    fn from(problem: Problem) -> Self {
        Self {
            path: None,
            problem,
        }
    }
}

/// What is wrong with a file that was to be opened as a policy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// It cannot be read.
    #[error("{0}; name a bundle (.onnx) or a compiled image (.lads)")]
    Read(io::Error),
    /// It is an image that cannot be used.
    #[error("{0}; compile it again from its bundle")]
    Image(PolicyError),
    /// It is an image that is not what the compiler wrote.
    #[error(
        "its checksum does not match: it was changed after it was compiled; compile it again from its bundle"
    )]
    Changed,
    /// It is no image, and no compiler is there.
    #[cfg(not(feature = "compile"))]
    #[error("it is no program image; compile it from its bundle first")]
    NoCompiler,
    /// It is no bundle that can be used.
    #[cfg(feature = "compile")]
    #[error(transparent)]
    Bundle(BundleError),
    /// It is a bundle that does not compile.
    #[cfg(feature = "compile")]
    #[error(transparent)]
    Compile(CompileError),
}
