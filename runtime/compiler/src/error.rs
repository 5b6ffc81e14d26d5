//! Errors of a bundle and of its compilation: one line that names the thing and the remedy.

use std::fmt;
use std::path::PathBuf;

use lads_core::{Policy, PolicyError, SelfTestError};

use crate::contract::Fault;

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

/// Largest number of faults that an error's text has; `lads inspect` lists them all.
const MOST_SHOWN: usize = 20;

/// Joins faults to one text.
fn all<T: fmt::Display>(faults: &[T]) -> String {
    let shown: Vec<String> = faults.iter().take(MOST_SHOWN).map(T::to_string).collect();
    let more = faults.len() - shown.len();
    let shown = shown.join("; ");
    if more == 0 {
        return shown;
    }
    format!("{shown}; and {more} more, which `lads inspect` lists")
}

/// Reason why a file cannot be used as a bundle.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BundleError {
    /// The file cannot be read.
    #[error("cannot be read: {0}; check the path")]
    Read(#[from] std::io::Error),
    /// The file is not an ONNX model.
    #[error("not an ONNX model: {problem}; give the .onnx bundle that the exporter wrote")]
    NotOnnx {
        /// Fault of the file.
        problem: Line,
    },
    /// The file ends too early.
    #[error("truncated: {needed} bytes are needed, the file has {got}; copy or export it again")]
    Truncated {
        /// Number of bytes up to the end of the part that the file announces last.
        needed: u64,
        /// Number of bytes in the file.
        got: u64,
    },
    /// The ONNX model has no policy contract.
    #[error(
        "no `lads.contract` in the model's metadata, so it is not a policy bundle; `lads import` makes one of any ONNX policy"
    )]
    NoContract,
    /// The contract is of another version than this crate reads.
    #[error(
        "the contract has version {found}, this program reads version {supported}; export the bundle again or use the matching release"
    )]
    ContractVersion {
        /// Version in the file.
        found: Line,
        /// Version that this crate reads.
        supported: u32,
    },
    /// The contract is of the first version.
    #[error(
        "the contract has version 1, this program reads version 2; upgrade it: `python -m lads_exporter upgrade FILE`"
    )]
    ContractV1,
    /// The contract misses something or contradicts itself.
    #[error("contract: {}; export the bundle again", all(faults))]
    Contract {
        /// All faults that the contract has.
        faults: Vec<Fault>,
    },
    /// Graphs contradict the contract, or miss an entry.
    #[error("{}; export the bundle again", all(problems))]
    Entry {
        /// Names of values, each with its fault and the field of the contract.
        problems: Vec<Line>,
    },
    /// The recorded episode is invalid.
    #[error("`lads.golden`: {}; export the bundle again", all(problems))]
    Golden {
        /// Faults of the episode.
        problems: Vec<Line>,
    },
    /// The record of how an image's numbers are stored is invalid.
    #[error("`lads.storage`: {problem}; tune the bundle again: `lads-run tune`")]
    Storage {
        /// Fault of the record.
        problem: Line,
    },
    /// Error of a bundle file, with its path.
    #[error("{path}: {source}", path = path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the file.
        source: Box<BundleError>,
    },
}

/// Reason why a bundle does not compile.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CompileError {
    /// The graphs contradict the contract.
    #[error(transparent)]
    Bundle(BundleError),
    /// An operator, or a use of it, that the compiler does not support.
    #[error("entry {entry}, node `{node}`: operator {operator} {problem}")]
    Operator {
        /// Name of the entry, for example `high_level/step`.
        entry: Line,
        /// Name of the ONNX operator.
        operator: Line,
        /// Name of the node, or of its first output.
        node: Line,
        /// Unsupported use, and the supported alternative.
        problem: Line,
    },
    /// A value is missing or has another shape than the contract states.
    #[error("entry {entry}: {problem}; export the bundle again")]
    Entry {
        /// Name of the entry.
        entry: Line,
        /// Fault of the value.
        problem: Line,
    },
    /// The verifier refused a memory plan: a defect of this compiler.
    #[error(
        "program {program}: the memory plan is wrong ({fault}); this is a defect of the compiler, please report it with the bundle"
    )]
    Plan {
        /// Name of the program.
        program: Line,
        /// Fault that the verifier found.
        fault: crate::verify::PlanFault,
    },
    /// Weights or a cache of fewer bits change the policy's actions or indices.
    #[error(
        "with {stored} the golden episode does not replay: {error} (tolerance {tolerance:e}); store more bits, or name the tolerance that the machine can live with"
    )]
    Gate {
        /// Storage of weights and cache.
        stored: Line,
        /// Difference from the recorded episode.
        error: SelfTestError,
        /// Largest absolute difference of an action that counts as equal.
        tolerance: f32,
    },
    /// Formats of fewer bits were asked for, and the policy does not replay its golden episode with
    /// 32-bit floats either.
    #[error(
        "the golden episode does not replay with 32-bit floats either: {error}; the weights are not those that it was recorded with: export the bundle again"
    )]
    Unlike {
        /// Difference from the recorded episode.
        error: SelfTestError,
    },
    /// Formats are given for parts that the bundle does not have.
    #[error(
        "the storage names {parts}, and the bundle has no entry and no layer of that name; tune the bundle again, or name others"
    )]
    UnknownParts {
        /// Names of all such parts, separated by commas.
        parts: Line,
    },
    /// The policy is too large for an image, whose offsets have 32 bits.
    #[error(
        "{what} is too large for a program image, whose offsets have 32 bits; use a smaller network"
    )]
    TooLarge {
        /// Part of the policy that is too large.
        what: Line,
    },
    /// A controller of the policy would need more memory than any policy may have.
    #[error(
        "the policy asks for a workspace of {bytes} bytes, and gets at most {most}; do not trust it, or export a bundle with a shorter context",
        most = Policy::MEMORY_LIMIT
    )]
    Excessive {
        /// Number of bytes that the controller would need.
        bytes: usize,
    },
    /// The compiled image does not load: a defect of this compiler.
    #[error(
        "the compiled image does not load ({0}); this is a defect of the compiler, please report it with the bundle"
    )]
    Image(PolicyError),
}
