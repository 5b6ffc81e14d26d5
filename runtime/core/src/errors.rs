//! Errors of the controller's calls: one small enum per operation.

use core::error::Error;
use core::fmt;

use lads_image::ExecError;

/// Error in the values that a caller gave for the channels.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum InputError {
    /// A channel was not given, or the policy has more channels than the one that was given.
    Missing {
        /// Number of the channel.
        channel: u32,
    },
    /// A value was given for a channel that this call does not take, or that was given before.
    Unknown {
        /// Number of the channel.
        channel: u32,
    },
    /// The values have another type than the channel.
    Type {
        /// Number of the channel.
        channel: u32,
    },
    /// The number of values differs from the channel's elements.
    Length {
        /// Number of the channel.
        channel: u32,
        /// Number of elements given.
        got: usize,
        /// Number of elements in the contract.
        needed: usize,
    },
    /// An element is NaN or infinite.
    NotFinite {
        /// Number of the channel.
        channel: u32,
        /// Index of the first such element.
        index: usize,
    },
    /// An element is outside the contract's limits.
    OutOfLimits {
        /// Number of the channel.
        channel: u32,
        /// Index of the first such element.
        index: usize,
        /// Value of the element.
        value: f32,
        /// Smallest value allowed.
        min: f32,
        /// Largest value allowed.
        max: f32,
    },
}

impl InputError {
    /// Returns the channel at fault.
    pub fn channel(&self) -> u32 {
        match *self {
            Self::Missing { channel }
            | Self::Unknown { channel }
            | Self::Type { channel }
            | Self::Length { channel, .. }
            | Self::NotFinite { channel, .. }
            | Self::OutOfLimits { channel, .. } => channel,
        }
    }

    /// Returns the element at fault, if the error concerns one.
    pub fn element(&self) -> Option<usize> {
        match *self {
            Self::NotFinite { index, .. } | Self::OutOfLimits { index, .. } => Some(index),
            _ => None,
        }
    }
}

impl fmt::Display for InputError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Missing { channel } => write!(f, "channel {channel} is not given"),
            Self::Unknown { channel } => {
                write!(
                    f,
                    "channel {channel} is not one to be given here, or is given twice"
                )
            }
            Self::Type { channel } => write!(f, "channel {channel} has elements of another type"),
            Self::Length {
                channel,
                got,
                needed,
            } => write!(
                f,
                "channel {channel} got {got} elements, the contract says {needed}"
            ),
            Self::NotFinite { channel, index } => {
                write!(f, "element {index} of channel {channel} is not finite")
            }
            Self::OutOfLimits {
                channel,
                index,
                value,
                min,
                max,
            } => write!(
                f,
                "element {index} of channel {channel} is {value}, the contract's limits are {min} to {max}"
            ),
        }
    }
}

impl Error for InputError {}

/// Reason why the programs of a call gave no usable result. It never occurs with a sound image and
/// finite weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum RunError {
    /// A program failed.
    Program(ExecError),
    /// A program computed a value that is not finite.
    NotFinite,
}

impl fmt::Display for RunError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Program(error) => write!(f, "a program failed: {error}"),
            Self::NotFinite => f.write_str("the policy computed a value that is not finite"),
        }
    }
}

impl Error for RunError {}

/// Reason why an instruction was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum InstructionError {
    /// The policy takes no instruction.
    NotTaken,
    /// The contract has no instruction with this number.
    Unknown {
        /// Number that was given.
        id: u32,
        /// Number of instructions in the contract.
        count: u32,
    },
    /// The length of the embeddings is not a multiple of the word dimension.
    Length {
        /// Number of elements given.
        got: usize,
        /// Number of elements of one word.
        word_dim: usize,
    },
    /// The instruction has no words, or more than the policy takes.
    Words {
        /// Number of words given.
        got: usize,
        /// Largest number of words that the policy takes.
        most: usize,
    },
    /// An element of the embeddings is NaN or infinite.
    NotFinite {
        /// Index of the first such element.
        index: usize,
    },
    /// The programs failed; the controller has no instruction now.
    Run(RunError),
}

impl fmt::Display for InstructionError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::NotTaken => f.write_str("the policy takes no instruction"),
            Self::Unknown { id, count } => {
                write!(f, "no instruction {id}; the policy knows {count}")
            }
            Self::Length { got, word_dim } => write!(
                f,
                "{got} elements are not a whole number of words of {word_dim} elements"
            ),
            Self::Words { got, most } => write!(
                f,
                "an instruction of {got} words; the policy takes 1 to {most}"
            ),
            Self::NotFinite { index } => write!(f, "word element {index} is not finite"),
            Self::Run(error) => write!(f, "the instruction could not be processed: {error}"),
        }
    }
}

impl Error for InstructionError {}

/// Reason why a control step, or a report of the executed action, was refused.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum StepError {
    /// The policy takes an instruction and none has been set.
    NoInstruction,
    /// The observation or the executed action violates the contract.
    Input(InputError),
    /// The length of the action differs from the contract's.
    ActionLength {
        /// Number of elements given.
        got: usize,
        /// Number of elements in the contract.
        needed: usize,
    },
    /// The context holds as many control steps as the policy was trained on, and the contract says
    /// to refuse more.
    ContextFull {
        /// Number of control steps of a context.
        steps: usize,
    },
    /// No step has been taken whose action could have been executed.
    NothingExecuted,
    /// The policy computed no usable result.
    Run(RunError),
}

impl fmt::Display for StepError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::NoInstruction => f.write_str("no instruction has been set"),
            Self::Input(error) => error.fmt(f),
            Self::ActionLength { got, needed } => {
                write!(f, "an action of {got} elements, the contract says {needed}")
            }
            Self::ContextFull { steps } => {
                write!(f, "the context is full after {steps} control steps: reset")
            }
            Self::NothingExecuted => f.write_str("no step has been taken yet"),
            Self::Run(error) => error.fmt(f),
        }
    }
}

impl Error for StepError {}

impl From<InputError> for StepError {
    fn from(error: InputError) -> Self {
        Self::Input(error)
    }
}

impl From<RunError> for StepError {
    fn from(error: RunError) -> Self {
        Self::Run(error)
    }
}

/// Reason why [`Controller::follow`](crate::Controller::follow) gave no action.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum FollowError {
    /// The policy cannot compute an action from an index alone.
    NotOffered,
    /// The observation violates the contract.
    Input(InputError),
    /// The length of the action differs from the contract's.
    ActionLength {
        /// Number of elements given.
        got: usize,
        /// Number of elements in the contract.
        needed: usize,
    },
    /// The index is out of range.
    Index {
        /// Index that was given.
        got: u32,
        /// Number of indices.
        count: u32,
    },
    /// The policy computed no usable result.
    Run(RunError),
}

impl fmt::Display for FollowError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::NotOffered => f.write_str("the policy has no action for an index alone"),
            Self::Input(error) => error.fmt(f),
            Self::ActionLength { got, needed } => {
                write!(f, "an action of {got} elements, the contract says {needed}")
            }
            Self::Index { got, count } => write!(f, "index {got} of {count}"),
            Self::Run(error) => error.fmt(f),
        }
    }
}

impl Error for FollowError {}

impl From<InputError> for FollowError {
    fn from(error: InputError) -> Self {
        Self::Input(error)
    }
}

impl From<RunError> for FollowError {
    fn from(error: RunError) -> Self {
        Self::Run(error)
    }
}

/// Reason why a demonstration could not be encoded.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum EncodeError {
    /// The image has no encoder.
    NoEncoder,
    /// The demonstration violates the contract.
    Input(InputError),
    /// The policy computed no usable result.
    Run(RunError),
}

impl fmt::Display for EncodeError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::NoEncoder => f.write_str("the image was compiled without a trajectory encoder"),
            Self::Input(error) => error.fmt(f),
            Self::Run(error) => error.fmt(f),
        }
    }
}

impl Error for EncodeError {}

impl From<InputError> for EncodeError {
    fn from(error: InputError) -> Self {
        Self::Input(error)
    }
}

impl From<RunError> for EncodeError {
    fn from(error: RunError) -> Self {
        Self::Run(error)
    }
}
