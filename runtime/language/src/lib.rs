//! Encodes sentences that are in no bundle's table as the word embeddings `[n, E]` that the core's
//! `Controller::set_instruction` takes.
//!
//! The language encoder is not part of a bundle: the exporter writes it once into a
//! [cache](default_folder), and [`Encoder::open`] loads it only if its weights made the bundle's
//! own embeddings. It runs on the host, before the first control step, and allocates; the
//! controller never waits for it. A policy follows any words, nonsense too: before it is given a
//! sentence, find the most similar known instruction by `lads_core::similarity::nearest`, and
//! compare the similarity with the contract's `language.acceptance`. What can fail: the encoder is
//! missing, damaged or another one; a sentence is empty or longer than encoder or policy can take.
//! Each is one line with its remedy.
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod encoder;
mod error;
mod manifest;

use std::path::PathBuf;

pub use encoder::Encoder;
pub use error::LanguageError;

/// Environment variable that names the folder of this user's downloaded and built files.
pub const CACHE_VARIABLE: &str = "LADS_CACHE";

/// Returns the folder into which the exporter writes an encoder: `language/NAME` in `$LADS_CACHE`,
/// else in `lads` in `$XDG_CACHE_HOME` or `~/.cache`.
///
/// The name comes from a bundle, so a name that is not a plain file name is refused.
pub fn default_folder(encoder: &str) -> Result<PathBuf, LanguageError> {
    let plain = !encoder.is_empty()
        && !encoder.starts_with('.')
        && !encoder.contains(|c: char| c.is_control() || matches!(c, '/' | '\\' | ':'));
    if !plain {
        return Err(LanguageError::Name(encoder.escape_debug().to_string()));
    }
    let set = |variable: &str| {
        let value = std::env::var_os(variable).filter(|value| !value.is_empty());
        value.map(PathBuf::from)
    };
    let cache = set(CACHE_VARIABLE)
        .or_else(|| set("XDG_CACHE_HOME").map(|folder| folder.join("lads")))
        .or_else(|| set("HOME").map(|home| home.join(".cache/lads")));
    let cache = cache.ok_or(LanguageError::NoCache)?;
    Ok(cache.join("language").join(encoder))
}
