//! Errors of a schedule.

use core::error::Error;
use core::fmt;

use lads_image::ProgramError;

/// Reason why the parts of an image do not form a valid policy. Indices count the image's records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ScheduleError {
    /// There are more states, or more steps of a context, than an image may have.
    TooMany,
    /// A state is unused, has a name twice, lies in the wrong place or has a lifetime that its kind
    /// does not allow.
    State {
        /// Number of the state.
        state: u32,
    },
    /// An entry has no ops, or names a KV cache that is not one.
    Entry {
        /// Number of the entry.
        entry: u32,
    },
    /// The program of an entry is not well formed.
    Program {
        /// Number of the entry.
        entry: u32,
        /// Fault of the program.
        error: ProgramError,
    },
    /// A port is unbound, or its length differs from what it is bound to.
    Port {
        /// Number of the entry.
        entry: u32,
        /// Number of the port among the inputs or outputs.
        port: u32,
        /// True if the port is an output.
        output: bool,
    },
    /// A call names a record that does not exist, or does what its event does not allow.
    Call {
        /// Number of the call.
        call: u32,
    },
    /// An index is read before one has been selected.
    NothingSelected,
    /// A control step writes no action.
    NoAction {
        /// Timestep of the control step.
        timestep: u32,
    },
    /// A KV cache does not have the rows that the longest context needs.
    Rows {
        /// Number of the state.
        state: u32,
        /// Rows that the image states.
        stated: u32,
        /// Rows that are needed.
        needed: u32,
    },
    /// The work that the image states differs from that of its worst step.
    Work {
        /// Multiply-adds that the image states.
        stated: u64,
        /// Multiply-adds that were counted.
        counted: u64,
    },
}

impl fmt::Display for ScheduleError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::TooMany => f.write_str("there are more states or steps than an image may have"),
            Self::State { state } => write!(f, "state {state} is invalid"),
            Self::Entry { entry } => write!(f, "entry {entry} is invalid"),
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
            Self::Call { call } => write!(f, "call {call} of the schedule is invalid"),
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
