//! Sentences that are in no bundle's table, to the word embeddings `[n, E]` that the core's `Controller::set_instruction` takes.
//!
//! The language encoder is no part of a bundle: the exporter writes it once into a [cache](default_folder), and [`Encoder::open`] takes
//! it only if its weights are those that made the bundle's own embeddings. It runs on the host, before the first control step, and
//! allocates; the controller never waits for it. A policy follows whatever it hears, nonsense too: before it is told a sentence,
//! `lads_core::similarity::nearest` says which known instruction the words are most like and how much, and the contract's
//! `language.acceptance` from where on that is enough. What can fail: the encoder is missing, damaged or another one; a sentence is empty or longer
//! than encoder or policy can hear. Each is one line with its remedy.
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod encoder;
mod error;
mod manifest;

use std::path::PathBuf;

pub use encoder::Encoder;
pub use error::LanguageError;

/// Names the folder that holds what was downloaded or built once for this user.
pub const CACHE_VARIABLE: &str = "LADS_CACHE";

/// Where the exporter puts an encoder: `language/NAME` in `$LADS_CACHE`, else in `lads` in `$XDG_CACHE_HOME` or `~/.cache`.
///
/// The name comes from a bundle, so one that is no plain file name is refused.
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
