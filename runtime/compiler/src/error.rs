//! What can go wrong with a bundle: one line that names the thing and says what to do about it.

use std::fmt;
use std::path::PathBuf;

use lads_core::{Policy, PolicyError, SelfTestError};

/// Text of one line: control characters, which names in a hostile file may hold, are escaped.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Line(String);

impl From<&str> for Line {
    fn from(text: &str) -> Self {
        let escaped = |c: char| {
            if c.is_control() {
                c.escape_default().to_string()
            } else {
                c.to_string()
            }
        };
        Self(text.chars().map(escaped).collect())
    }
}

impl From<String> for Line {
    fn from(text: String) -> Self {
        Self::from(text.as_str())
    }
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Why a file is not a bundle that can be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BundleError {
    /// The file cannot be read.
    #[error("cannot be read: {0}; check the path")]
    Read(#[from] std::io::Error),
    /// The file is something else.
    #[error("not an ONNX model: {problem}; give the .onnx bundle that the exporter wrote")]
    NotOnnx {
        /// What does not fit.
        problem: Line,
    },
    /// The file ends too early.
    #[error("truncated: {needed} bytes are needed, the file has {got}; copy or export it again")]
    Truncated {
        /// Bytes that the part before the end announces.
        needed: u64,
        /// Bytes that there are.
        got: u64,
    },
    /// An ONNX model without a policy's contract.
    #[error(
        "no `lads.contract` in the model's metadata, so it is not a policy bundle; `lads import` makes one of any ONNX policy"
    )]
    NoContract,
    /// A contract that another version of this crate reads.
    #[error(
        "the contract has version {found}, this program reads version {supported}; export the bundle again or use the matching release"
    )]
    ContractVersion {
        /// Version in the file.
        found: Line,
        /// Version that is read.
        supported: u32,
    },
    /// A contract of the first version.
    #[error(
        "the contract has version 1, this program reads version 2; upgrade it: `python -m lads_exporter upgrade FILE`"
    )]
    ContractV1,
    /// A contract that misses something or contradicts itself.
    #[error("contract: {problem}; export the bundle again")]
    Contract {
        /// The field and what is wrong with it.
        problem: Line,
    },
    /// A graph that contradicts the contract, or misses an entry.
    #[error("{problem}; export the bundle again")]
    Entry {
        /// The value and the field.
        problem: Line,
    },
    /// The recorded episode does not read.
    #[error("`lads.golden`: {problem}; export the bundle again")]
    Golden {
        /// What is wrong with it.
        problem: Line,
    },
    /// The record of how an image's numbers are stored does not read.
    #[error("`lads.storage`: {problem}; tune the bundle again: `lads-run tune`")]
    Storage {
        /// What is wrong with it.
        problem: Line,
    },
    /// One of the above, in a file.
    #[error("{path}: {source}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: Box<BundleError>,
    },
}

/// Why a bundle does not compile.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CompileError {
    /// The graphs contradict the contract.
    #[error(transparent)]
    Bundle(BundleError),
    /// An operator that the compiler does not know, or uses of a known one that it does not.
    #[error("entry {entry}, node `{node}`: operator {operator} {problem}")]
    Operator {
        /// The entry, for example `high_level/step`.
        entry: Line,
        /// The ONNX operator.
        operator: Line,
        /// The node's name, or its first output's.
        node: Line,
        /// What is not supported, and instead of what.
        problem: Line,
    },
    /// A value that is missing or has another shape than the contract says.
    #[error("entry {entry}: {problem}; export the bundle again")]
    Entry {
        /// The entry.
        entry: Line,
        /// What is wrong with it.
        problem: Line,
    },
    /// A memory plan that the verifier refused: a defect of this compiler.
    #[error(
        "program {program}: the memory plan is wrong ({fault}); this is a defect of the compiler, please report it with the bundle"
    )]
    Plan {
        /// The program.
        program: Line,
        /// What the verifier found.
        fault: crate::verify::PlanFault,
    },
    /// Weights or a cache of fewer bits change what the policy does.
    #[error(
        "with {stored} the golden episode does not replay: {error} (tolerance {tolerance:e}); store more bits, or name the tolerance that the machine can live with"
    )]
    Gate {
        /// How weights and cache are stored.
        stored: Line,
        /// What came out otherwise than recorded.
        error: SelfTestError,
        /// Largest absolute difference of an action that counts as equal.
        tolerance: f32,
    },
    /// Formats for parts that the bundle does not have.
    #[error(
        "the storage names {parts}, and the bundle has no entry and no layer of that name; tune the bundle again, or name others"
    )]
    UnknownParts {
        /// All of them, with commas.
        parts: Line,
    },
    /// The policy is too large for an image, whose offsets have 32 bits.
    #[error(
        "{what} is too large for a program image, whose offsets have 32 bits; use a smaller network"
    )]
    TooLarge {
        /// What is too large.
        what: Line,
    },
    /// A controller of the policy would ask for more memory than any policy gets.
    #[error(
        "the policy asks for a workspace of {bytes} bytes, and gets at most {most}; do not trust it, or export a bundle with a shorter context",
        most = Policy::MEMORY_LIMIT
    )]
    Excessive {
        /// What it would ask for.
        bytes: usize,
    },
    /// The image that was made does not load: a defect of this compiler.
    #[error(
        "the compiled image does not load ({0}); this is a defect of the compiler, please report it with the bundle"
    )]
    Image(PolicyError),
}
