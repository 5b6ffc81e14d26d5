//! Instructions in a contract: those that the policy knows, the language encoder of their words, and
//! which words can be one.

use lads_image::records::InstructionRecord;

use super::Contract;
use crate::errors::InstructionError;

/// One instruction that a policy knows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownInstruction<'a> {
    /// Short name of the instruction.
    pub id: &'a str,
    /// The instruction as a person says it.
    pub text: &'a str,
    /// Word embeddings, `[n, E]`.
    pub words: &'a [f32],
}

impl<'a> Contract<'a> {
    /// Returns the number of words of the longest instruction; 0 for a policy that takes none.
    pub fn words_len(&self) -> usize {
        self.words_shape(0)
    }

    /// Returns the number of elements of a word embedding; 0 for a policy that takes no
    /// instruction.
    pub fn word_dim(&self) -> usize {
        self.words_shape(1)
    }

    /// Counts the words of an instruction, word embeddings `[n, dim]` row by row, and refuses those
    /// that no instruction can be.
    pub fn check_words(&self, words: &[f32]) -> Result<usize, InstructionError> {
        self.instruction_channel()
            .ok_or(InstructionError::NotTaken)?;
        let (dim, most) = (self.word_dim(), self.words_len());
        if words.len().checked_rem(dim) != Some(0) {
            return Err(InstructionError::Length {
                got: words.len(),
                word_dim: dim,
            });
        }
        let count = words.len().checked_div(dim).unwrap_or(0);
        if count == 0 || count > most {
            return Err(InstructionError::Words { got: count, most });
        }
        if let Some(index) = words.iter().position(|x| !x.is_finite()) {
            return Err(InstructionError::NotFinite { index });
        }
        Ok(count)
    }

    fn words_shape(&self, axis: usize) -> usize {
        self.instruction_channel()
            .and_then(|channel| channel.record.dims.get(axis).copied())
            .unwrap_or(0) as usize
    }

    /// Returns the name of the language encoder that made the word embeddings; empty without
    /// instructions.
    pub fn encoder(&self) -> &'a str {
        self.tables.text(self.record.encoder)
    }

    /// Returns the SHA-256 of the language encoder's weights, hexadecimal.
    pub fn encoder_sha256(&self) -> &'a str {
        self.tables.text(self.record.encoder_sha256)
    }

    /// Returns the smallest similarity to a known instruction at which another sentence may be
    /// followed; above 1 if none may be.
    pub fn acceptance(&self) -> f32 {
        self.record.acceptance
    }

    /// Returns the number of instructions that the policy knows.
    pub fn instruction_count(&self) -> usize {
        self.tables.instructions_len()
    }

    /// Returns the instructions that the policy knows, in the order of their numbers.
    pub fn instructions(&self) -> impl Iterator<Item = KnownInstruction<'a>> + use<'a> {
        let contract = *self;
        (0..self.instruction_count()).filter_map(move |i| contract.instruction(i))
    }

    /// Returns instruction number `i`.
    pub fn instruction(&self, i: usize) -> Option<KnownInstruction<'a>> {
        let InstructionRecord {
            id, text, words, ..
        } = self.tables.instruction(i)?;
        Some(KnownInstruction {
            id: self.tables.text(id),
            text: self.tables.text(text),
            words: self.tables.span(words),
        })
    }
}
