//! Why a call of the controller was refused: one small enum per operation.

use core::error::Error;
use core::fmt;

use crate::exec::ExecError;

/// Why an instruction was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InstructionError {
    /// The contract has no instruction of this number.
    Unknown {
        /// The number.
        id: u32,
        /// How many there are.
        count: u32,
    },
    /// The embeddings are no whole number of words.
    Length {
        /// Elements given.
        got: usize,
        /// Elements of one word.
        word_dim: usize,
    },
    /// No words, or more than the policy takes.
    Words {
        /// Words given.
        got: usize,
        /// The most that the policy takes.
        most: usize,
    },
    /// An element of the embeddings is not a number or infinite.
    NotFinite {
        /// The first such element.
        index: usize,
    },
    /// The program failed; the controller has no instruction now.
    Program(ExecError),
}

impl fmt::Display for InstructionError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Unknown { id, count } => {
                write!(f, "no instruction {id}; the policy knows {count}")
            }
            Self::Length { got, word_dim } => {
                write!(
                    f,
                    "{got} elements are no whole number of words of {word_dim} elements"
                )
            }
            Self::Words { got, most } => write!(
                f,
                "an instruction of {got} words; the policy takes 1 to {most}"
            ),
            Self::NotFinite { index } => write!(f, "word element {index} is not finite"),
            Self::Program(error) => write!(f, "the instruct program failed: {error}"),
        }
    }
}

impl Error for InstructionError {}

/// Why a control step, or what was said about the executed action, was refused.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StepError {
    /// No instruction has been set.
    NoInstruction,
    /// The observation has another length than the contract's.
    ObservationLength {
        /// Elements given.
        got: usize,
        /// Elements in the contract.
        needed: usize,
    },
    /// The action has another length than the contract's.
    ActionLength {
        /// Elements given.
        got: usize,
        /// Elements in the contract.
        needed: usize,
    },
    /// An element that was given is not a number or infinite.
    NotFinite {
        /// The first such element.
        index: usize,
    },
    /// An element of the observation is outside the contract's limits.
    OutOfLimits {
        /// The first such element.
        index: usize,
        /// Its value.
        value: f32,
        /// Smallest value allowed.
        min: f32,
        /// Largest value allowed.
        max: f32,
    },
    /// The context holds as many control steps as the policy was trained on, and the contract says to stop there.
    ContextFull {
        /// Control steps of a context.
        steps: usize,
    },
    /// There was no step whose action could have been executed.
    NothingExecuted,
    /// The policy computed something that is not finite.
    NotFiniteResult,
    /// A program failed.
    Program(ExecError),
}

impl fmt::Display for StepError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::NoInstruction => f.write_str("no instruction has been set"),
            Self::ObservationLength { got, needed } => {
                write!(
                    f,
                    "an observation of {got} elements, the contract says {needed}"
                )
            }
            Self::ActionLength { got, needed } => {
                write!(f, "an action of {got} elements, the contract says {needed}")
            }
            Self::NotFinite { index } => write!(f, "element {index} is not finite"),
            Self::OutOfLimits {
                index,
                value,
                min,
                max,
            } => {
                write!(
                    f,
                    "observation element {index} is {value}, the contract's limits are {min} to {max}"
                )
            }
            Self::ContextFull { steps } => {
                write!(f, "the context is full after {steps} control steps: reset")
            }
            Self::NothingExecuted => f.write_str("no step has been taken yet"),
            Self::NotFiniteResult => f.write_str("the policy computed a value that is not finite"),
            Self::Program(error) => write!(f, "a program failed: {error}"),
        }
    }
}

impl Error for StepError {}

/// Why the low level alone gave no action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActError {
    /// The observation or the action has another length than the contract's.
    Length {
        /// Elements given.
        got: usize,
        /// Elements in the contract.
        needed: usize,
    },
    /// The codebook has no such plan.
    Plan {
        /// Index given.
        got: u32,
        /// Plans in the codebook.
        size: u32,
    },
    /// An element of the observation is not a number or infinite.
    NotFinite {
        /// The first such element.
        index: usize,
    },
    /// The policy computed something that is not finite.
    NotFiniteResult,
    /// The program failed.
    Program(ExecError),
}

impl fmt::Display for ActError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Length { got, needed } => {
                write!(f, "{got} elements, the contract says {needed}")
            }
            Self::Plan { got, size } => write!(f, "plan {got} of a codebook of {size}"),
            Self::NotFinite { index } => write!(f, "element {index} is not finite"),
            Self::NotFiniteResult => f.write_str("the policy computed a value that is not finite"),
            Self::Program(error) => write!(f, "the low level's program failed: {error}"),
        }
    }
}

impl Error for ActError {}

/// Why a demonstration could not be encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EncodeError {
    /// The image was compiled without the trajectory encoder.
    NoEncoder,
    /// Observations or actions are not one horizon long.
    Length {
        /// Elements given.
        got: usize,
        /// Elements of one horizon.
        needed: usize,
    },
    /// An element is not a number or infinite.
    NotFinite,
    /// The program failed.
    Program(ExecError),
}

impl fmt::Display for EncodeError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::NoEncoder => f.write_str("the image was compiled without the trajectory encoder"),
            Self::Length { got, needed } => write!(f, "{got} elements, one horizon has {needed}"),
            Self::NotFinite => f.write_str("an element is not finite"),
            Self::Program(error) => write!(f, "the encode program failed: {error}"),
        }
    }
}

impl Error for EncodeError {}
