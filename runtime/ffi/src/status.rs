//! Status numbers that calls return, each with its one line of English, and how errors of lads-core
//! become statuses. A number and its text stand in one place, the table `statuses!`: the enum, its
//! documentation, the texts and the C header come out of it.

use core::ffi::CStr;

use lads_core::{
    GuardError, InputError, InstructionError, Intervention, PolicyError, RunError, ScheduleError,
    SelfTestError, StepError, SwapError,
};
use lads_image::Fault;
use lads_image::format::FormatError;
use lads_image::tables::TablesError;

/// Converts a text to C's form; the table's texts hold no zero but the last.
const fn zero_ended(text: &'static str) -> &'static CStr {
    match CStr::from_bytes_with_nul(text.as_bytes()) {
        Ok(text) => text,
        Err(_) => c"",
    }
}

macro_rules! statuses {
    ($($name:ident = $number:literal, $text:literal;)*) => {
        /// Result of a call; 0 means success. The numbers are stable: no number ever changes its
        /// meaning.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[repr(i32)]
        pub enum Status { $(#[doc = concat!("In words: ", $text, ".")] $name = $number,)* }

        impl Status {
            /// Every status with one line in English, in the order of the numbers.
            pub const ALL: &'static [(Self, &'static CStr)] =
                &[$((Self::$name, zero_ended(concat!($text, "\0"))),)*];
        }
    };
}

statuses! {
    Ok = 0, "ok";
    Null = 1, "a pointer is null";
    Misaligned = 2, "a pointer does not have the alignment that its type or the documentation requires";
    TooLong = 3, "a length exceeds the address space";
    Overlap = 5, "two of the memory areas overlap";
    NotSetUp = 6, "the policy was not opened or the controller was not set up, or it was moved or replaced since";
    StructBytes = 7, "a struct's struct_bytes is not set, or not a valid size";
    NotAnImage = 10, "not a program image";
    ImageVersion = 11, "program image of another version: compile the bundle again";
    ImageTruncated = 12, "the program image is truncated";
    ImageMalformed = 13, "the program image is malformed";
    BigEndian = 14, "this processor stores the most significant byte first; program images do not";
    ImageChecksum = 15, "the program image has changed since it was compiled";
    ImageWork = 16, "a control step of the program image takes more work than is allowed";
    ImageOperation = 17, "the program image needs an operation that this library was built without";
    WorkspaceTooSmall = 20, "the workspace is smaller than the policy needs";
    UnknownInstruction = 30, "the policy does not know this instruction";
    WordsLength = 31, "there are no words, too many, or not a whole number of word embeddings";
    WordsNotFinite = 32, "a word element is not finite";
    InstructFailed = 33, "the instruction could not be processed; no instruction is set now";
    NoElement = 34, "the channel has no element with this number";
    NoChannel = 35, "the policy has no channel with this number or name";
    NoInstructionTaken = 36, "the policy takes no instruction";
    NoInstruction = 40, "no instruction has been set";
    ObservationLength = 41, "a channel of the observation has another length than the contract's";
    ActionLength = 42, "the action has another length than the contract's";
    NotFinite = 43, "an element that was given is not finite";
    OutOfLimits = 44, "an element of the observation is outside the contract's limits";
    ContextFull = 45, "the context is full: reset or set an instruction";
    NothingExecuted = 46, "no step has been taken yet";
    ResultNotFinite = 47, "the policy computed a value that is not finite";
    StepFailed = 48, "a program of the step failed";
    NoGolden = 50, "the policy holds no recorded episode to test itself with";
    SelfTestRefused = 51, "the self-test's recorded instruction or one of its observations was refused";
    SelfTestSelected = 52, "the self-test selected another index than recorded";
    SelfTestAction = 53, "the self-test computed another action than recorded";
    NotArmed = 60, "not armed: the self-test has not passed";
    Stopped = 61, "stopped, until it is resumed";
    NoObservation = 62, "there is no observation in this period";
    Stale = 63, "the observation is no later than the last one";
    Late = 64, "more control periods were missed than tolerated";
    Jump = 65, "the timestamp is further ahead of the last one than max_jump allows";
    UnknownOption = 70, "a flag, a rule or a fallback is unknown to this library";
    GuardLimits = 71, "the limits of an action element do not overlap the contract's range";
    GuardRate = 72, "a rate is not a finite number above zero";
    GuardSafeAction = 73, "the safe action is outside the limits";
    GuardTimeConstant = 74, "the time constant of the decay is not a finite number above zero";
    ChannelMissing = 80, "a channel of the observation is missing, or the policy has more than one";
    ChannelUnknown = 81, "a channel is given that is not an observation channel, or is given twice";
    ChannelType = 82, "a channel is given with elements of another type";
    ChannelRows = 83, "the rows of a channel are not contiguous";
    SwapControlPeriod = 90, "the other policy has another control period";
    SwapChannels = 91, "a channel of the other policy differs";
    SwapInstruction = 92, "the other policy has no instruction yet";
}

impl From<Intervention> for Status {
    fn from(intervention: Intervention) -> Self {
        match intervention {
            Intervention::NotArmed => Self::NotArmed,
            Intervention::Stopped => Self::Stopped,
            Intervention::NoObservation => Self::NoObservation,
            Intervention::Stale => Self::Stale,
            Intervention::Jump => Self::Jump,
            Intervention::Late { .. } => Self::Late,
            Intervention::Refused(error) => error.into(),
            // What core knows and this table does not yet.
            _ => Self::StepFailed,
        }
    }
}

impl From<GuardError> for Status {
    fn from(error: GuardError) -> Self {
        match error {
            GuardError::Memory { .. } => Self::WorkspaceTooSmall,
            GuardError::Limits { .. } => Self::GuardLimits,
            GuardError::Rate { .. } => Self::GuardRate,
            GuardError::SafeAction { .. } => Self::GuardSafeAction,
            GuardError::TimeConstant => Self::GuardTimeConstant,
            _ => Self::ActionLength,
        }
    }
}

impl From<SwapError> for Status {
    fn from(error: SwapError) -> Self {
        match error {
            SwapError::ControlPeriod => Self::SwapControlPeriod,
            SwapError::NoInstruction => Self::SwapInstruction,
            _ => Self::SwapChannels,
        }
    }
}

impl From<PolicyError> for Status {
    fn from(error: PolicyError) -> Self {
        match error {
            PolicyError::Tables(TablesError::BigEndian) => Self::BigEndian,
            PolicyError::Tables(TablesError::Alignment) => Self::Misaligned,
            PolicyError::Tables(TablesError::Format(error)) => match error {
                FormatError::Truncated { .. } => Self::ImageTruncated,
                FormatError::Magic => Self::NotAnImage,
                FormatError::Version(_) => Self::ImageVersion,
                _ => Self::ImageMalformed,
            },
            PolicyError::Work { .. } => Self::ImageWork,
            PolicyError::Schedule(ScheduleError::Program { error, .. })
                if error.fault == Fault::LeftOut =>
            {
                Self::ImageOperation
            }
            _ => Self::ImageMalformed,
        }
    }
}

impl From<InstructionError> for Status {
    fn from(error: InstructionError) -> Self {
        match error {
            InstructionError::NotTaken => Self::NoInstructionTaken,
            InstructionError::Unknown { .. } => Self::UnknownInstruction,
            InstructionError::Length { .. } | InstructionError::Words { .. } => Self::WordsLength,
            InstructionError::NotFinite { .. } => Self::WordsNotFinite,
            _ => Self::InstructFailed,
        }
    }
}

impl From<InputError> for Status {
    fn from(error: InputError) -> Self {
        match error {
            InputError::Missing { .. } => Self::ChannelMissing,
            InputError::Type { .. } => Self::ChannelType,
            InputError::Length { .. } => Self::ObservationLength,
            InputError::NotFinite { .. } => Self::NotFinite,
            InputError::OutOfLimits { .. } => Self::OutOfLimits,
            _ => Self::ChannelUnknown,
        }
    }
}

impl From<StepError> for Status {
    fn from(error: StepError) -> Self {
        match error {
            StepError::NoInstruction => Self::NoInstruction,
            StepError::Input(error) => error.into(),
            StepError::ActionLength { .. } => Self::ActionLength,
            StepError::ContextFull { .. } => Self::ContextFull,
            StepError::NothingExecuted => Self::NothingExecuted,
            StepError::Run(RunError::NotFinite) => Self::ResultNotFinite,
            _ => Self::StepFailed,
        }
    }
}

impl From<SelfTestError> for Status {
    fn from(error: SelfTestError) -> Self {
        match error {
            SelfTestError::NoGolden => Self::NoGolden,
            SelfTestError::Selected { .. } => Self::SelfTestSelected,
            SelfTestError::Action { .. } => Self::SelfTestAction,
            _ => Self::SelfTestRefused,
        }
    }
}
