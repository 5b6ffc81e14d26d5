//! Opens a policy from a file in either of its two forms: the bundle (ONNX), which is compiled on
//! the way, or a compiled program image.
//!
//! The form is recognised by the first bytes, not by the file's name. Invariant of an [`Opened`]:
//! its image and its checksum were checked. What can fail: the file cannot be read, is neither of
//! the two, or is broken ([`OpenError`]).

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

/// A policy that was read and checked, with its image in large pages.
#[derive(Debug)]
pub struct Opened {
    image: Aligned,
    #[cfg(feature = "compile")]
    bundle: Option<Box<Bundle>>,
}

/// Reads the policy at `path`; a bundle is compiled with the number formats that it was tuned for.
pub fn open(path: &Path) -> Result<Opened, OpenError> {
    at(path, from_bytes)
}

/// Reads a policy from a file's content; a bundle is compiled with the number formats that it was
/// tuned for.
pub fn from_bytes(bytes: &[u8]) -> Result<Opened, OpenError> {
    if is_image(bytes) {
        return image(bytes);
    }
    #[cfg(feature = "compile")]
    return compiled(bytes, &Options::default());
    #[cfg(not(feature = "compile"))]
    return Err(Problem::NoCompiler.into());
}

/// Reads the policy at `path` and compiles a bundle with these `options`; an image keeps the
/// options that it was compiled with.
#[cfg(feature = "compile")]
pub fn open_with(path: &Path, options: &Options) -> Result<Opened, OpenError> {
    at(path, |bytes| from_bytes_with(bytes, options))
}

/// Reads a policy from a file's content and compiles a bundle with these `options`; an image keeps
/// the options that it was compiled with.
#[cfg(feature = "compile")]
pub fn from_bytes_with(bytes: &[u8], options: &Options) -> Result<Opened, OpenError> {
    if is_image(bytes) {
        image(bytes)
    } else {
        compiled(bytes, options)
    }
}

/// Returns whether a file's content is a program image, of whatever version.
fn is_image(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC.to_le_bytes())
}

/// Reads the policy at a path and names the file in errors.
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
    /// Returns the program image.
    pub fn image(&self) -> &[u8] {
        self.image.as_bytes()
    }

    /// Returns the checked view on the image.
    pub fn policy(&self) -> Policy<'_> {
        match Policy::new_checked(self.image()) {
            Ok(policy) => policy,
            Err(error) => unreachable!("it was checked when it was opened: {error}"),
        }
    }

    /// Returns whether the policy was read from a bundle and compiled, not read as an image.
    pub fn is_bundle(&self) -> bool {
        #[cfg(feature = "compile")]
        return self.bundle.is_some();
        #[cfg(not(feature = "compile"))]
        return false;
    }

    /// Returns the bundle that the policy was read from, whose contract is more detailed than the
    /// image's.
    #[cfg(feature = "compile")]
    pub fn bundle(&self) -> Option<&Bundle> {
        self.bundle.as_deref()
    }

    /// Returns the number of the known instruction that a person means, by [the one
    /// rule](lads_core::Contract::instructions_called).
    pub fn instruction(&self, wanted: &str) -> Result<u32, UnknownInstruction> {
        instruction::find(self.policy().contract(), wanted)
    }

    /// Allocates the memory of one controller.
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
    /// Returns the policy.
    pub fn opened(&self) -> &Opened {
        &self.opened
    }

    /// Makes a fresh controller on the widest instruction set that this CPU offers.
    pub fn controller(&mut self) -> Controller<'_, '_> {
        self.controller_with(Isa::detect())
    }

    /// Makes a fresh controller on a chosen instruction set.
    pub fn controller_with(&mut self, isa: Isa) -> Controller<'_, '_> {
        let policy = self.opened.policy();
        match self.memory.controller_with(&policy, isa) {
            Ok(controller) => controller,
            Err(error) => unreachable!("the memory was made for this policy: {error}"),
        }
    }
}

/// Reason why a file cannot be used as a policy; one line that names the file, where there is one,
/// and the remedy.
#[derive(Debug, thiserror::Error)]
#[error("{}{problem}", path.as_ref().map(|path| format!("{}: ", path.display())).unwrap_or_default())]
pub struct OpenError {
    /// Path of the file, unless only its content was given.
    pub path: Option<PathBuf>,
    /// Problem of the file.
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

/// Problem of a file that was to be opened as a policy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The file cannot be read.
    #[error("{0}; name a bundle (.onnx) or a compiled image (.lads)")]
    Read(io::Error),
    /// The file is an image that cannot be used.
    #[error("{0}; compile it again from its bundle")]
    Image(PolicyError),
    /// The file is an image that changed after the compiler wrote it.
    #[error(
        "its checksum does not match: it was changed after it was compiled; compile it again from its bundle"
    )]
    Changed,
    /// The file is not an image, and this build has no compiler.
    #[cfg(not(feature = "compile"))]
    #[error("it is not a program image; compile it from its bundle first")]
    NoCompiler,
    /// The file is not a usable bundle.
    #[cfg(feature = "compile")]
    #[error(transparent)]
    Bundle(BundleError),
    /// The file is a bundle that does not compile.
    #[cfg(feature = "compile")]
    #[error(transparent)]
    Compile(CompileError),
}
