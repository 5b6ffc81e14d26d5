//! What can go wrong, each one line that names the thing and the remedy.

use std::path::PathBuf;

use thiserror::Error;

/// Why there are no word embeddings.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LanguageError {
    /// An encoder whose name is no file name.
    #[error(
        "the bundle's language encoder is called '{0}', which names no folder; export the bundle again"
    )]
    Name(String),
    /// A policy that takes no instructions.
    #[error(
        "the policy takes no instructions, so no sentence can be put to it; leave the sentence out"
    )]
    Deaf,
    /// Nothing says where the cache is.
    #[error(
        "no folder for the language encoder: none of LADS_CACHE, XDG_CACHE_HOME and HOME is set; set LADS_CACHE"
    )]
    NoCache,
    /// There is no encoder.
    #[error("the language encoder {encoder} is not in {}; export it once with `python -m lads_exporter language`", folder.display())]
    Missing {
        /// Its name.
        encoder: String,
        /// Where it was looked for.
        folder: PathBuf,
    },
    /// A file of it cannot be read, or is not what its manifest says.
    #[error("{}: {problem}; export it again with `python -m lads_exporter language`", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// An encoder with other weights than the one that made the bundle's embeddings.
    #[error(
        "the language encoder in {} has weights of sha256 {got:.12}, the bundle's embeddings were made by {encoder} with {needed:.12}; name the folder of that one, or export it with `python -m lads_exporter language`",
        folder.display()
    )]
    Other {
        /// Where it lies.
        folder: PathBuf,
        /// SHA-256 of its weights.
        got: String,
        /// The name in the bundle.
        encoder: String,
        /// The SHA-256 in the bundle.
        needed: String,
    },
    /// The bundle asks for what this encoder does not have.
    #[error(
        "the bundle's field `language.{field}` is {wanted}, the language encoder {encoder} has {has}; export the bundle again"
    )]
    Contract {
        /// The contract's field.
        field: &'static str,
        /// Its value.
        wanted: String,
        /// The encoder.
        encoder: String,
        /// What it has.
        has: String,
    },
    /// A sentence in which there is nothing to hear.
    #[error("'{0}': an empty sentence; say what is to be done")]
    Empty(String),
    /// A sentence longer than the policy or the encoder can hear.
    #[error("'{text}': {got} word pieces, {who} hears at most {most}; say it in fewer words")]
    TooLong {
        /// The sentence, or its beginning.
        text: String,
        /// Word pieces in it.
        got: usize,
        /// The most that are heard.
        most: usize,
        /// Who hears no more.
        who: &'static str,
    },
    /// The encoder failed on a sentence that it should take.
    #[error(
        "'{text}': the language encoder failed ({problem}); export it again with `python -m lads_exporter language`"
    )]
    Run {
        /// The sentence.
        text: String,
        /// What it says.
        problem: String,
    },
}
