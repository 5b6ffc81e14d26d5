//! The numbers that calls return. They are stable: a number never changes its meaning.

use core::ffi::CStr;

use lads_core::{
    GuardError, InstructionError, Intervention, PolicyError, SelfTestError, StepError,
};

/// What came of a call; 0 is good. The numbers are stable: none ever changes its meaning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(i32)]
pub enum Status {
    /// Ok.
    Ok = 0,
    /// A pointer is null.
    Null = 1,
    /// A pointer is not aligned as its type or the documentation asks.
    Misaligned = 2,
    /// A length is larger than memory can be.
    TooLong = 3,
    /// Two of the memory areas overlap.
    Overlap = 5,
    /// The policy was not opened or the controller was not set up, or it was moved since.
    NotSetUp = 6,
    /// Not a program image.
    NotAnImage = 10,
    /// Program image of another version: compile the bundle again.
    ImageVersion = 11,
    /// The program image is truncated.
    ImageTruncated = 12,
    /// The program image is malformed.
    ImageMalformed = 13,
    /// This processor stores the most significant byte first; program images do not.
    BigEndian = 14,
    /// The program image has changed since it was compiled.
    ImageChecksum = 15,
    /// The workspace is smaller than the policy needs.
    WorkspaceTooSmall = 20,
    /// The policy does not know this instruction.
    UnknownInstruction = 30,
    /// The words are none, too many, or no whole number of word embeddings.
    WordsLength = 31,
    /// A word element is not finite.
    WordsNotFinite = 32,
    /// The instruct program failed; there is no instruction now.
    InstructFailed = 33,
    /// The contract has no element of this number.
    NoElement = 34,
    /// No instruction has been set.
    NoInstruction = 40,
    /// The observation has another length than the contract's.
    ObservationLength = 41,
    /// The action has another length than the contract's.
    ActionLength = 42,
    /// An element that was given is not finite.
    NotFinite = 43,
    /// An element of the observation is outside the contract's limits.
    OutOfLimits = 44,
    /// The context is full: reset or set an instruction.
    ContextFull = 45,
    /// No step has been taken yet.
    NothingExecuted = 46,
    /// The policy computed a value that is not finite.
    ResultNotFinite = 47,
    /// A program of the step failed.
    StepFailed = 48,
    /// The policy holds no recorded episode to test itself with.
    NoGolden = 50,
    /// The self-test's recorded instruction or one of its observations was refused.
    SelfTestRefused = 51,
    /// The self-test chose another plan than recorded.
    SelfTestPlan = 52,
    /// The self-test computed another action than recorded.
    SelfTestAction = 53,
    /// Not armed: the self-test has not passed.
    NotArmed = 60,
    /// Stopped, until it is resumed.
    Stopped = 61,
    /// There is no observation in this period.
    NoObservation = 62,
    /// The observation is no later than the last one.
    Stale = 63,
    /// More control periods were missed than tolerated.
    Late = 64,
    /// A flag or a fallback has no meaning.
    UnknownOption = 70,
    /// The limits of an action element leave nothing of the contract's range.
    GuardLimits = 71,
    /// A rate is not a finite number above zero.
    GuardRate = 72,
    /// The safe action is outside the limits.
    GuardSafeAction = 73,
    /// The time constant of the decay is not a finite number above zero.
    GuardTimeConstant = 74,
}

impl Status {
    /// Every status with one line in English, in the order of the numbers.
    pub const ALL: &'static [(Self, &'static CStr)] = &[
        (Self::Ok, c"ok"),
        (Self::Null, c"a pointer is null"),
        (
            Self::Misaligned,
            c"a pointer is not aligned as its type or the documentation asks",
        ),
        (Self::TooLong, c"a length is larger than memory can be"),
        (Self::Overlap, c"two of the memory areas overlap"),
        (
            Self::NotSetUp,
            c"the policy was not opened or the controller was not set up, or it was moved since",
        ),
        (Self::NotAnImage, c"not a program image"),
        (
            Self::ImageVersion,
            c"program image of another version: compile the bundle again",
        ),
        (Self::ImageTruncated, c"the program image is truncated"),
        (Self::ImageMalformed, c"the program image is malformed"),
        (
            Self::BigEndian,
            c"this processor stores the most significant byte first; program images do not",
        ),
        (
            Self::ImageChecksum,
            c"the program image has changed since it was compiled",
        ),
        (
            Self::WorkspaceTooSmall,
            c"the workspace is smaller than the policy needs",
        ),
        (
            Self::UnknownInstruction,
            c"the policy does not know this instruction",
        ),
        (
            Self::WordsLength,
            c"the words are none, too many, or no whole number of word embeddings",
        ),
        (Self::WordsNotFinite, c"a word element is not finite"),
        (
            Self::InstructFailed,
            c"the instruct program failed; there is no instruction now",
        ),
        (
            Self::NoElement,
            c"the contract has no element of this number",
        ),
        (Self::NoInstruction, c"no instruction has been set"),
        (
            Self::ObservationLength,
            c"the observation has another length than the contract's",
        ),
        (
            Self::ActionLength,
            c"the action has another length than the contract's",
        ),
        (Self::NotFinite, c"an element that was given is not finite"),
        (
            Self::OutOfLimits,
            c"an element of the observation is outside the contract's limits",
        ),
        (
            Self::ContextFull,
            c"the context is full: reset or set an instruction",
        ),
        (Self::NothingExecuted, c"no step has been taken yet"),
        (
            Self::ResultNotFinite,
            c"the policy computed a value that is not finite",
        ),
        (Self::StepFailed, c"a program of the step failed"),
        (
            Self::NoGolden,
            c"the policy holds no recorded episode to test itself with",
        ),
        (
            Self::SelfTestRefused,
            c"the self-test's recorded instruction or one of its observations was refused",
        ),
        (
            Self::SelfTestPlan,
            c"the self-test chose another plan than recorded",
        ),
        (
            Self::SelfTestAction,
            c"the self-test computed another action than recorded",
        ),
        (Self::NotArmed, c"not armed: the self-test has not passed"),
        (Self::Stopped, c"stopped, until it is resumed"),
        (
            Self::NoObservation,
            c"there is no observation in this period",
        ),
        (
            Self::Stale,
            c"the observation is no later than the last one",
        ),
        (
            Self::Late,
            c"more control periods were missed than tolerated",
        ),
        (Self::UnknownOption, c"a flag or a fallback has no meaning"),
        (
            Self::GuardLimits,
            c"the limits of an action element leave nothing of the contract's range",
        ),
        (Self::GuardRate, c"a rate is not a finite number above zero"),
        (
            Self::GuardSafeAction,
            c"the safe action is outside the limits",
        ),
        (
            Self::GuardTimeConstant,
            c"the time constant of the decay is not a finite number above zero",
        ),
    ];
}

impl From<Intervention> for Status {
    fn from(intervention: Intervention) -> Self {
        match intervention {
            Intervention::NotArmed => Self::NotArmed,
            Intervention::Stopped => Self::Stopped,
            Intervention::NoObservation => Self::NoObservation,
            Intervention::Stale => Self::Stale,
            Intervention::Late { .. } => Self::Late,
            Intervention::Refused(error) => error.into(),
        }
    }
}

impl From<GuardError> for Status {
    fn from(error: GuardError) -> Self {
        match error {
            GuardError::Memory { .. } => Self::WorkspaceTooSmall,
            GuardError::Length { .. } => Self::ActionLength,
            GuardError::Limits { .. } => Self::GuardLimits,
            GuardError::Rate { .. } => Self::GuardRate,
            GuardError::SafeAction { .. } => Self::GuardSafeAction,
            GuardError::TimeConstant => Self::GuardTimeConstant,
        }
    }
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
            | PolicyError::Cache
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
