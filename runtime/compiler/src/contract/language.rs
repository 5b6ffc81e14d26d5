//! The language encoder of a contract, and which sentences outside the table of instructions are followed.

use serde::Deserialize;

/// What becomes of the words of an instruction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Pooling {
    /// Each is heard.
    #[default]
    None,
    /// The mean of the encoder's last layer over all tokens is heard, as one word.
    Mean,
}

/// How the likeness of a sentence and a known instruction is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Similarity {
    /// [`lads_core::similarity::alignment`].
    Alignment,
}

/// Which sentences outside the table of instructions are followed, as the exporter calibrated it.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Acceptance {
    /// The measure.
    pub similarity: Similarity,
    /// Similarity to the nearest known instruction from which on a sentence is followed.
    pub threshold: f32,
    /// Share of the calibration's sentences that ask for what the policy knows that it accepts.
    pub accepted_known: f32,
    /// Share of the calibration's sentences that ask for something else, or for nothing, that it accepts all the same.
    pub accepted_other: f32,
}

/// The language encoder that made the word embeddings.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Language {
    /// Its name.
    pub encoder: String,
    /// SHA-256 of its weights.
    pub sha256: String,
    /// Elements of a word embedding, `E`.
    pub dim: usize,
    /// The hidden layer that is read; negative counts from the last.
    pub layer: i32,
    /// What becomes of the words; left out, nothing.
    #[serde(default)]
    pub pooling: Pooling,
    /// Which sentences outside the table are followed; left out, none without the caller's insistence.
    #[serde(default)]
    pub acceptance: Option<Acceptance>,
}

impl Acceptance {
    pub(super) fn check(&self) -> Result<(), String> {
        for (part, value, least) in [
            ("threshold", self.threshold, -1.0),
            ("accepted_known", self.accepted_known, 0.0),
            ("accepted_other", self.accepted_other, 0.0),
        ] {
            if !(least..=1.0).contains(&value) {
                return Err(format!(
                    "field `language.acceptance.{part}` is {value}, it must be {least} to 1"
                ));
            }
        }
        Ok(())
    }
}
