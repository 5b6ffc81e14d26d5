//! The numbers that calls return. They are stable: a number never changes its meaning.

use core::ffi::CStr;

use lads_core::{InstructionError, PolicyError, SelfTestError, StepError};

macro_rules! statuses {
    ($($(#[$meta:meta])* $name:ident = $code:literal, $text:literal;)*) => {
        /// What came of a call; `Ok` is 0.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[repr(i32)]
        pub enum Status {
            $(#[doc = $text] $name = $code,)*
        }

        impl Status {
            /// Every status, in the order of the numbers.
            pub const ALL: &'static [Self] = &[$(Self::$name,)*];

            /// One line in English.
            pub const fn text(self) -> &'static CStr {
                match self {
                    $(Self::$name => {
                        const TEXT: &CStr = match CStr::from_bytes_with_nul(concat!($text, "\0").as_bytes()) {
                            Ok(text) => text,
                            Err(_) => c"",
                        };
                        TEXT
                    })*
                }
            }
        }
    };
}

statuses! {
    Ok = 0, "ok";
    Null = 1, "a pointer is null";
    Misaligned = 2, "a pointer is not aligned as its type or the documentation asks";
    TooLong = 3, "a length is larger than memory can be";
    ControllerTooSmall = 4, "the memory for the controller is too small";
    Overlap = 5, "two of the memory areas overlap";
    NotAnImage = 10, "not a program image";
    ImageVersion = 11, "program image of another version: compile the bundle again";
    ImageTruncated = 12, "the program image is truncated";
    ImageMalformed = 13, "the program image is malformed";
    BigEndian = 14, "this processor stores the most significant byte first; program images do not";
    ImageChecksum = 15, "the program image has changed since it was compiled";
    WorkspaceTooSmall = 20, "the arena or the state has fewer elements than the policy needs";
    UnknownInstruction = 30, "the policy knows no instruction of this number";
    WordsLength = 31, "the words are none, too many, or no whole number of word embeddings";
    WordsNotFinite = 32, "a word element is not finite";
    InstructFailed = 33, "the instruct program failed; there is no instruction now";
    NoInstruction = 40, "no instruction has been set";
    ObservationLength = 41, "the observation has another length than the contract's";
    ActionLength = 42, "the action has another length than the contract's";
    NotFinite = 43, "an element that was given is not finite";
    OutOfLimits = 44, "an element of the observation is outside the contract's limits";
    ContextFull = 45, "the context is full: reset or set an instruction";
    NothingExecuted = 46, "no step has been taken yet";
    ResultNotFinite = 47, "the policy computed a value that is not finite";
    StepFailed = 48, "a program of the step failed";
    NoGolden = 50, "the policy holds no recorded episode to test itself with";
    SelfTestRefused = 51, "the self-test's recorded instruction or one of its observations was refused";
    SelfTestPlan = 52, "the self-test chose another plan than recorded";
    SelfTestAction = 53, "the self-test computed another action than recorded";
}

impl From<PolicyError> for Status {
    fn from(error: PolicyError) -> Self {
        match error {
            PolicyError::BigEndian => Self::BigEndian,
            PolicyError::Alignment => Self::Misaligned,
            PolicyError::Truncated { .. } => Self::ImageTruncated,
            PolicyError::Magic => Self::NotAnImage,
            PolicyError::Version(_) => Self::ImageVersion,
            PolicyError::Length
            | PolicyError::Section(_)
            | PolicyError::Strings
            | PolicyError::Contract(_)
            | PolicyError::Missing(_)
            | PolicyError::Program { .. } => Self::ImageMalformed,
        }
    }
}

impl From<InstructionError> for Status {
    fn from(error: InstructionError) -> Self {
        match error {
            InstructionError::Unknown { .. } => Self::UnknownInstruction,
            InstructionError::Length { .. } | InstructionError::Words { .. } => Self::WordsLength,
            InstructionError::NotFinite { .. } => Self::WordsNotFinite,
            InstructionError::Program(_) => Self::InstructFailed,
        }
    }
}

impl From<StepError> for Status {
    fn from(error: StepError) -> Self {
        match error {
            StepError::NoInstruction => Self::NoInstruction,
            StepError::ObservationLength { .. } => Self::ObservationLength,
            StepError::ActionLength { .. } => Self::ActionLength,
            StepError::NotFinite { .. } => Self::NotFinite,
            StepError::OutOfLimits { .. } => Self::OutOfLimits,
            StepError::ContextFull { .. } => Self::ContextFull,
            StepError::NothingExecuted => Self::NothingExecuted,
            StepError::NotFiniteResult => Self::ResultNotFinite,
            StepError::Program(_) => Self::StepFailed,
        }
    }
}

impl From<SelfTestError> for Status {
    fn from(error: SelfTestError) -> Self {
        match error {
            SelfTestError::NoGolden => Self::NoGolden,
            SelfTestError::Instruction(_) | SelfTestError::Step { .. } => Self::SelfTestRefused,
            SelfTestError::Plan { .. } => Self::SelfTestPlan,
            SelfTestError::Action { .. } => Self::SelfTestAction,
        }
    }
}
