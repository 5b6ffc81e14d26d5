//! Errors of the language encoder, each one line that names the thing and the remedy.

use std::path::PathBuf;

use thiserror::Error;

/// Reason why there are no word embeddings.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LanguageError {
    /// The encoder's name is not a plain file name.
    #[error(
        "the bundle's language encoder is called '{0}', which names no folder; export the bundle again"
    )]
    Name(String),
    /// The policy takes no instructions.
    #[error(
        "the policy takes no instructions, so no sentence can be put to it; leave the sentence out"
    )]
    NoInstructions,
    /// No environment variable gives the folder of the cache.
    #[error(
        "no folder for the language encoder: none of LADS_CACHE, XDG_CACHE_HOME and HOME is set; set LADS_CACHE"
    )]
    NoCache,
    /// The encoder is missing.
    #[error("the language encoder {encoder} is not in {}; export it once with `python -m lads_exporter language`", folder.display())]
    Missing {
        /// Name of the encoder.
        encoder: String,
        /// Folder in which it was looked for.
        folder: PathBuf,
    },
    /// A file of the encoder cannot be read, or does not match its manifest.
    #[error("{}: {problem}; export it again with `python -m lads_exporter language`", path.display())]
    Damaged {
        /// Path of the file.
        path: PathBuf,
        /// Fault of the file.
        problem: String,
    },
    /// The encoder has other weights than the one that made the bundle's embeddings.
    #[error(
        "the language encoder in {} has weights of sha256 {got:.12}, the bundle's embeddings were made by {encoder} with {needed:.12}; name the folder of that one, or export it with `python -m lads_exporter language`",
        folder.display()
    )]
    Other {
        /// Folder of the encoder.
        folder: PathBuf,
        /// SHA-256 of the encoder's weights.
        got: String,
        /// Name of the encoder in the bundle.
        encoder: String,
        /// SHA-256 of the weights in the bundle.
        needed: String,
    },
    /// The bundle asks for something that this encoder does not have.
    #[error(
        "the bundle's field `language.{field}` is {wanted}, the language encoder {encoder} has {has}; export the bundle again"
    )]
    Contract {
        /// Name of the contract's field.
        field: &'static str,
        /// Value of the field.
        wanted: String,
        /// Name of the encoder.
        encoder: String,
        /// Value that the encoder has.
        has: String,
    },
    /// The sentence has no words.
    #[error("'{0}': an empty sentence; give an instruction")]
    Empty(String),
    /// The sentence is longer than the policy or the encoder takes.
    #[error("'{text}': {got} word pieces, {who} takes at most {most}; use fewer words")]
    TooLong {
        /// The sentence, or its beginning.
        text: String,
        /// Number of word pieces in the sentence.
        got: usize,
        /// Largest number that is taken.
        most: usize,
        /// Which of the two takes no more: the policy or the encoder.
        who: &'static str,
    },
    /// The encoder failed on a sentence that it should take.
    #[error(
        "'{text}': the language encoder failed ({problem}); export it again with `python -m lads_exporter language`"
    )]
    Run {
        /// The sentence, or its beginning.
        text: String,
        /// Error of the network.
        problem: String,
    },
}
