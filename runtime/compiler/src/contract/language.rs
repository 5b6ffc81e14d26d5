//! Language encoder of a contract, and its rule for sentences outside the table of instructions.

use serde::Deserialize;

use super::Faults;

/// Pooling of the words of an instruction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Pooling {
    /// Every word is kept.
    #[default]
    None,
    /// The mean of the encoder's last layer over all tokens, as one word.
    Mean,
}

/// Measure of the similarity of a sentence and a known instruction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Similarity {
    /// Measured by [`lads_core::similarity::alignment`].
    Alignment,
}

/// Rule for following sentences outside the table of instructions, as the exporter calibrated it.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Acceptance {
    /// Measure of similarity.
    pub similarity: Similarity,
    /// Smallest similarity to the nearest known instruction at which a sentence is followed.
    pub threshold: f32,
    /// Share of accepted sentences among the calibration's sentences that ask for something that
    /// the policy knows.
    pub accepted_known: f32,
    /// Share of accepted sentences among the calibration's sentences that ask for something else,
    /// or for nothing.
    pub accepted_other: f32,
}

/// Language encoder that made the word embeddings.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Language {
    /// Name of the encoder.
    pub encoder: String,
    /// SHA-256 of the encoder's weights.
    pub sha256: String,
    /// Number of elements of a word embedding, `E`.
    pub dim: usize,
    /// Index of the hidden layer that is read; negative counts from the last.
    pub layer: i32,
    /// Pooling of the words; none if left out.
    #[serde(default)]
    pub pooling: Pooling,
    /// Rule for following sentences outside the table; if left out, none is followed unless the
    /// caller insists.
    #[serde(default)]
    pub acceptance: Option<Acceptance>,
}

impl Acceptance {
    pub(super) fn check(&self, faults: &mut Faults) {
        for (part, value, least) in [
            ("threshold", self.threshold, -1.0),
            ("accepted_known", self.accepted_known, 0.0),
            ("accepted_other", self.accepted_other, 0.0),
        ] {
            let field = format!("language.acceptance.{part}");
            if faults.sound(&[&field]) && !(least..=1.0).contains(&value) {
                faults.add(&field, format!("is {value}, it must be {least} to 1"));
            }
        }
    }
}
