//! Why a schedule is refused.

use core::error::Error;
use core::fmt;

use lads_image::ProgramError;

/// Why the parts of an image make no policy. Indices count the image's records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ScheduleError {
    /// More states, or more steps of a context, than an image may have.
    TooMany,
    /// A state is of no use, has a name twice, lies in the wrong place or lasts as its kind cannot.
    State {
        /// Which one.
        state: u32,
    },
    /// An entry has no ops, or a KV cache that is none.
    Entry {
        /// Which one.
        entry: u32,
    },
    /// The program of an entry is not well formed.
    Program {
        /// Which one.
        entry: u32,
        /// What is wrong with it.
        error: ProgramError,
    },
    /// A port is bound to nothing, or is not as long as what it is bound to.
    Port {
        /// Of which entry.
        entry: u32,
        /// Its number among the inputs or outputs.
        port: u32,
        /// Whether it is an output.
        output: bool,
    },
    /// A call names what is not there, or does what its event does not allow.
    Call {
        /// Which one.
        call: u32,
    },
    /// An index is read and none has been selected.
    NothingSelected,
    /// A control step writes no action.
    NoAction {
        /// At this timestep.
        timestep: u32,
    },
    /// A KV cache has not the rows that the longest context needs.
    Rows {
        /// Which state.
        state: u32,
        /// Rows that it has.
        stated: u32,
        /// Rows that are needed.
        needed: u32,
    },
    /// The image states another amount of work than its worst step has.
    Work {
        /// Multiply-adds stated.
        stated: u64,
        /// Multiply-adds counted.
        counted: u64,
    },
}

impl fmt::Display for ScheduleError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::TooMany => f.write_str("there are more states or steps than an image may have"),
            Self::State { state } => write!(f, "state {state} makes no sense"),
            Self::Entry { entry } => write!(f, "entry {entry} makes no sense"),
            Self::Program { entry, error } => write!(f, "entry {entry}, {error}"),
            Self::Port {
                entry,
                port,
                output,
            } => {
                let side = if *output { "output" } else { "input" };
                write!(
                    f,
                    "entry {entry}, {side} {port} is bound to nothing that fits"
                )
            }
            Self::Call { call } => write!(f, "call {call} of the schedule makes no sense"),
            Self::NothingSelected => f.write_str("an index is read before one is selected"),
            Self::NoAction { timestep } => {
                write!(f, "the step at timestep {timestep} writes no action")
            }
            Self::Rows {
                state,
                stated,
                needed,
            } => write!(
                f,
                "state {state} has {stated} rows, the longest context needs {needed}"
            ),
            Self::Work { stated, counted } => write!(
                f,
                "{stated} multiply-adds are stated for the worst step, it has {counted}"
            ),
        }
    }
}

impl Error for ScheduleError {}
