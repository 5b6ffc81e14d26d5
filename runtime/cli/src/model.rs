//! A policy from a file, whichever of its two forms: the bundle (ONNX), which is compiled on the way, or a compiled program image.
//!
//! What can fail: the file cannot be read, is neither of the two, or is broken; each is one line with the remedy. A `Model` that was
//! opened holds an image that was checked.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use lads_compiler::{Aligned, Bundle, Image, Options, compile_with};
use lads_core::{KnownInstruction, Policy};

use crate::refusal::{Refusal, chain};

/// How many known instructions are shown to one who asked for an unknown one.
const SUGGESTIONS: usize = 3;

/// Where the image comes from, and the image.
enum Bytes {
    /// Compiled from a bundle just now.
    Compiled(Image),
    /// Read from a file.
    Read(Aligned),
}

/// A policy that was read, with its compiled image.
pub struct Model {
    /// Where it was read from.
    pub path: PathBuf,
    bytes: Bytes,
}

impl Model {
    /// Reads and, where it is a bundle, compiles the policy at `path`, with 32-bit weights.
    pub fn open(path: &Path) -> Result<Self, Refusal> {
        Self::compile(path, Options::default())
    }

    /// The same with other weights or another cache; an image has those that it was compiled with.
    pub fn compile(path: &Path, options: Options) -> Result<Self, Refusal> {
        let file = lads_host::input::read(path).map_err(|error| {
            Refusal::new(
                path.display(),
                error,
                "name a bundle (.onnx) or a compiled image (.lads)",
            )
        })?;
        let bytes = if file.starts_with(&lads_core::image::MAGIC.to_le_bytes()) {
            Bytes::Read(Aligned::new(&file))
        } else {
            let about = |error: &dyn std::error::Error| {
                Refusal::with_remedy_inside(path.display(), chain(error))
            };
            let bundle = Bundle::from_bytes(&file).map_err(|error| about(&error))?;
            let image = compile_with(&bundle, options);
            Bytes::Compiled(image.map_err(|error| about(&error))?)
        };
        let model = Self {
            path: path.to_owned(),
            bytes,
        };
        let intact = model.policy()?.checksum_matches();
        if !intact {
            return Err(Refusal::new(
                path.display(),
                "its checksum does not match: it was changed after it was compiled",
                "compile it again from its bundle",
            ));
        }
        Ok(model)
    }

    /// Whether it was read from a bundle and compiled, not read as an image.
    pub fn is_bundle(&self) -> bool {
        matches!(self.bytes, Bytes::Compiled(_))
    }

    /// The compiled image.
    pub fn image(&self) -> &[u8] {
        match &self.bytes {
            Bytes::Compiled(image) => image.as_bytes(),
            Bytes::Read(bytes) => bytes.as_bytes(),
        }
    }

    /// The checked view on the image.
    pub fn policy(&self) -> Result<Policy<'_>, Refusal> {
        Policy::new_checked(self.image()).map_err(|error| {
            Refusal::new(
                self.path.display(),
                error,
                "compile it again from its bundle",
            )
        })
    }

    /// What is wrong with the policy, by an error that says itself what to do.
    pub fn refused(&self, error: impl Display) -> Refusal {
        Refusal::with_remedy_inside(self.path.display(), error)
    }

    /// The number of the instruction with this id, or with this text up to case and white space.
    pub fn instruction(&self, wanted: &str) -> Result<u32, Refusal> {
        let contract = self.policy()?.contract();
        let text = plain(wanted);
        let is_it =
            |known: KnownInstruction<'_>| known.id == wanted.trim() || plain(known.text) == text;
        if let Some(number) = contract.instructions().position(is_it) {
            return Ok(number as u32);
        }
        let likeness = |known: &str| strsim::normalized_damerau_levenshtein(&text, &plain(known));
        let mut nearest: Vec<_> = contract
            .instructions()
            .map(|known| (likeness(known.text).max(likeness(known.id)), known))
            .collect();
        nearest.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        let nearest: Vec<_> = nearest
            .iter()
            .take(SUGGESTIONS)
            .map(|(_, known)| format!("'{}' ({})", known.text, known.id))
            .collect();
        Err(Refusal::new(
            format_args!("instruction '{wanted}'"),
            "the policy does not know it",
            format_args!("the nearest that it knows: {}", nearest.join(", ")),
        ))
    }
}

/// A text as it is compared: lower case, single spaces.
fn plain(text: &str) -> String {
    text.split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
        .to_lowercase()
}
