//! Reads `manifest.json`, the description of an encoder's folder.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::Path;

use lads_compiler::contract::Language;
use lads_compiler::sha256;
use serde::Deserialize;

use crate::error::LanguageError;

const FORMAT: &str = "lads-language";
const FORMAT_VERSION: u32 = 1;
const FILE: &str = "manifest.json";

/// Description of an exported encoder; `python -m lads_exporter language` writes it.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Manifest {
    format: String,
    format_version: u32,
    /// Name of the encoder in contracts.
    pub encoder: String,
    /// SHA-256 of the weights that the encoder was exported from, hexadecimal, as contracts state
    /// it.
    pub sha256: String,
    /// Number of hidden layers, the embeddings included.
    pub layers: usize,
    /// Number of elements of a word embedding, `E`.
    pub dim: usize,
    /// Number of tokens of the longest sentence, with the two that mark its ends.
    pub max_tokens: usize,
    /// SHA-256 of each file of the folder, by its name.
    files: BTreeMap<String, String>,
}

impl Manifest {
    /// Reads the manifest of the encoder that a bundle names.
    pub fn read(folder: &Path, wanted: &Language) -> Result<Self, LanguageError> {
        let path = folder.join(FILE);
        let damaged = |problem: String| LanguageError::Damaged {
            path: path.clone(),
            problem,
        };
        let text = std::fs::read_to_string(&path).map_err(|error| match error.kind() {
            ErrorKind::NotFound | ErrorKind::NotADirectory => LanguageError::Missing {
                encoder: wanted.encoder.clone(),
                folder: folder.to_owned(),
            },
            _ => damaged(error.to_string()),
        })?;
        let read: Self = serde_json::from_str(&text)
            .map_err(|error| damaged(format!("no manifest of a language encoder ({error})")))?;
        if read.format != FORMAT || read.format_version != FORMAT_VERSION {
            let got = format!("{} {}", read.format, read.format_version);
            return Err(damaged(format!(
                "says {got:.60}, this program reads {FORMAT} {FORMAT_VERSION}"
            )));
        }
        Ok(read)
    }

    /// Checks whether this encoder made the bundle's embeddings.
    pub fn check(&self, folder: &Path, wanted: &Language) -> Result<(), LanguageError> {
        if self.sha256 != wanted.sha256 {
            return Err(LanguageError::Other {
                folder: folder.to_owned(),
                got: self.sha256.clone(),
                encoder: wanted.encoder.clone(),
                needed: wanted.sha256.clone(),
            });
        }
        if self.dim != wanted.dim {
            return Err(LanguageError::Contract {
                field: "dim",
                wanted: wanted.dim.to_string(),
                encoder: wanted.encoder.clone(),
                has: self.dim.to_string(),
            });
        }
        Ok(())
    }

    /// Reads a file of the folder, if it has the checksum that the manifest states.
    pub fn file(&self, folder: &Path, name: &str) -> Result<Vec<u8>, LanguageError> {
        let path = folder.join(name);
        let damaged = |problem: String| LanguageError::Damaged {
            path: path.clone(),
            problem,
        };
        let bytes = std::fs::read(&path).map_err(|error| damaged(error.to_string()))?;
        let digest = sha256(&bytes);
        if self.files.get(name) != Some(&digest) {
            return Err(damaged(format!(
                "its sha256 {digest:.12} is not the manifest's"
            )));
        }
        Ok(bytes)
    }
}
