//! Reports that calls write.

use lads_core::{
    Counters, GuardError, GuardReport, InputError, InstructionError, Intervention, SelfTest,
    SelfTestError, StepError, SwapError,
};

use super::LADS_NONE;
use crate::status::Status;
use crate::versioned::versioned;

/// Report of a call: the result of a control period, or the cause of a refusal.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C)]
pub struct LadsReport {
    /// Size of the struct: set it to `sizeof(lads_report)` before the call.
    pub struct_bytes: u32,
    /// Status that the call returned.
    pub status: i32,
    /// 1 if the policy took a step; the next five fields are 0 otherwise.
    pub stepped: u32,
    /// Number of control steps since the context began.
    pub timestep: u32,
    /// 1 if an index is in force; the next three fields are 0 otherwise, as for a policy that
    /// selects none.
    pub has_selected: u32,
    /// The index in force, such as that of a latent plan.
    pub selected: u32,
    /// The largest score of the last selection minus the second largest; infinite with a single one.
    pub margin: f32,
    /// 1 if this step selected the index, else 0.
    pub fresh: u32,
    /// 1 if the last action is repeated because the options tolerate this many missed observations.
    pub coasting: u32,
    /// 1 if an element of the action was at a limit or beyond and is now at the limit.
    pub saturated: u32,
    /// 1 if an element of the action moves as fast as it may, less far than it should.
    pub rate_limited: u32,
    /// Number of the channel that was refused; `LADS_NONE` if none was.
    pub channel: u32,
    /// Index of the first element of the channel that was refused, or of the word element;
    /// `LADS_NONE` if none was.
    pub element: u32,
    /// Value of the refused element, for `LADS_STATUS_OUT_OF_LIMITS`; 0 otherwise.
    pub value: f32,
    /// Smallest value allowed, for `LADS_STATUS_OUT_OF_LIMITS`; 0 otherwise.
    pub min: f32,
    /// Largest value allowed, for `LADS_STATUS_OUT_OF_LIMITS`; 0 otherwise.
    pub max: f32,
}

impl Default for LadsReport {
    fn default() -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            status: 0,
            stepped: 0,
            timestep: 0,
            has_selected: 0,
            selected: 0,
            margin: 0.0,
            fresh: 0,
            coasting: 0,
            saturated: 0,
            rate_limited: 0,
            channel: LADS_NONE,
            element: LADS_NONE,
            value: 0.0,
            min: 0.0,
            max: 0.0,
        }
    }
}

impl LadsReport {
    pub(crate) fn of(status: Status, report: &GuardReport, refusal: &Refusal) -> Self {
        let step = report.step;
        let selected = step.and_then(|step| step.selected);
        Self {
            status: status as i32,
            stepped: u32::from(step.is_some()),
            timestep: step.map_or(0, |step| step.timestep),
            has_selected: u32::from(selected.is_some()),
            selected: selected.map_or(0, |selected| selected.index),
            margin: selected.map_or(0.0, |selected| selected.margin),
            fresh: u32::from(selected.is_some_and(|selected| selected.fresh)),
            coasting: u32::from(report.coasting),
            saturated: u32::from(report.saturated),
            rate_limited: u32::from(report.rate_limited),
            ..Self::from(refusal)
        }
    }
}

impl From<&Refusal> for LadsReport {
    fn from(refusal: &Refusal) -> Self {
        let Refusal {
            status,
            channel,
            element,
            value,
            min,
            max,
        } = *refusal;
        Self {
            status: status as i32,
            channel,
            element,
            value,
            min,
            max,
            ..Self::default()
        }
    }
}

/// A status and the channel and element that it concerns.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Refusal {
    pub status: Status,
    pub channel: u32,
    pub element: u32,
    pub value: f32,
    pub min: f32,
    pub max: f32,
}

impl Refusal {
    pub fn in_channel(status: Status, channel: u32) -> Self {
        Self {
            channel,
            ..Self::from(status)
        }
    }

    fn at(status: Status, channel: u32, element: usize) -> Self {
        Self {
            element: u32::try_from(element).unwrap_or(LADS_NONE),
            ..Self::in_channel(status, channel)
        }
    }

    /// Makes the refusal of a guard's configuration for this action channel.
    pub fn of_guard(error: GuardError, action: u32) -> Self {
        let status = error.into();
        match error {
            GuardError::Limits { index }
            | GuardError::Rate { index }
            | GuardError::SafeAction { index } => Self::at(status, action, index),
            _ => status.into(),
        }
    }
}

impl From<Status> for Refusal {
    fn from(status: Status) -> Self {
        Self {
            status,
            channel: LADS_NONE,
            element: LADS_NONE,
            value: 0.0,
            min: 0.0,
            max: 0.0,
        }
    }
}

impl From<InputError> for Refusal {
    fn from(error: InputError) -> Self {
        let (status, channel) = (error.into(), error.channel());
        match error {
            InputError::NotFinite { index, .. } => Self::at(status, channel, index),
            InputError::OutOfLimits {
                index,
                value,
                min,
                max,
                ..
            } => Self {
                value,
                min,
                max,
                ..Self::at(status, channel, index)
            },
            _ => Self::in_channel(status, channel),
        }
    }
}

impl From<StepError> for Refusal {
    fn from(error: StepError) -> Self {
        match error {
            StepError::Input(error) => error.into(),
            _ => Status::from(error).into(),
        }
    }
}

impl From<Intervention> for Refusal {
    fn from(intervention: Intervention) -> Self {
        match intervention {
            Intervention::Refused(error) => error.into(),
            _ => Status::from(intervention).into(),
        }
    }
}

impl From<InstructionError> for Refusal {
    fn from(error: InstructionError) -> Self {
        let status = error.into();
        match error {
            InstructionError::NotFinite { index } => Self::at(status, LADS_NONE, index),
            _ => status.into(),
        }
    }
}

impl From<SwapError> for Refusal {
    fn from(error: SwapError) -> Self {
        let status = error.into();
        match error {
            SwapError::Channels { channel } => Self::in_channel(status, channel),
            _ => status.into(),
        }
    }
}

/// Measurements of a self-test, or the place of its failure.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C)]
pub struct LadsSelfTest {
    /// Size of the struct: set it to `sizeof(lads_self_test_t)` before the call.
    pub struct_bytes: u32,
    /// Number of control steps replayed; this and the next two fields are 0 if the test failed.
    pub steps: u32,
    /// FNV-1a, of 32 bits, over the bits of all actions, as little-endian bytes: two targets with the same digest computed the same
    /// bits.
    pub digest: u32,
    /// Largest absolute difference of an action element from the recorded one.
    pub largest_error: f32,
    /// Number of the first step that failed, counted from 0; `LADS_NONE` if none did.
    pub failed_step: u32,
    /// Index of the action's element that differed, for `LADS_STATUS_SELF_TEST_ACTION`; `LADS_NONE`
    /// otherwise.
    pub element: u32,
    /// Recorded value at the failure: the element's value, or the index for
    /// `LADS_STATUS_SELF_TEST_SELECTED`.
    pub expected: f32,
    /// Value that this target computed at the failure.
    pub got: f32,
}

impl Default for LadsSelfTest {
    fn default() -> Self {
        Self {
            struct_bytes: size_of::<Self>() as u32,
            steps: 0,
            digest: 0,
            largest_error: 0.0,
            failed_step: LADS_NONE,
            element: LADS_NONE,
            expected: 0.0,
            got: 0.0,
        }
    }
}

impl From<SelfTest> for LadsSelfTest {
    fn from(passed: SelfTest) -> Self {
        let SelfTest {
            steps,
            largest_error,
            digest,
        } = passed;
        Self {
            steps,
            digest,
            largest_error,
            ..Self::default()
        }
    }
}

impl From<SelfTestError> for LadsSelfTest {
    fn from(failed: SelfTestError) -> Self {
        let none = Self::default();
        match failed {
            SelfTestError::Step { step, .. } => Self {
                failed_step: step,
                ..none
            },
            SelfTestError::Selected {
                step,
                expected,
                got,
            } => Self {
                failed_step: step,
                expected: expected as f32,
                got: got as f32,
                ..none
            },
            SelfTestError::Action {
                step,
                index,
                expected,
                got,
            } => Self {
                failed_step: step,
                element: index,
                expected,
                got,
                ..none
            },
            _ => none,
        }
    }
}

/// Counts of the guard since the controller was set up, in control periods. `policy` to `refused`
/// add up to `periods`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C)]
pub struct LadsCounters {
    /// Size of the struct: set it to `sizeof(lads_counters_t)` before the call.
    pub struct_bytes: u32,
    /// Number of control periods.
    pub periods: u64,
    /// Number of periods with the policy's action.
    pub policy: u64,
    /// Number of periods before arming.
    pub not_armed: u64,
    /// Number of periods while stopped.
    pub stopped: u64,
    /// Number of periods without an observation.
    pub no_observation: u64,
    /// Number of periods with a stale observation, or one whose timestamp jumps.
    pub stale: u64,
    /// Number of periods in which too many periods had been missed.
    pub late: u64,
    /// Number of periods with an observation that was not finite.
    pub not_finite: u64,
    /// Number of periods with an observation outside the contract's limits.
    pub out_of_limits: u64,
    /// Number of periods in which the controller refused for another reason: no instruction, a full
    /// context, a wrong length.
    pub refused: u64,
    /// Number of periods in which the last action was repeated; also counted above.
    pub coasted: u64,
    /// Number of missed periods.
    pub missed: u64,
    /// Number of periods with an action at a limit.
    pub saturated: u64,
    /// Number of periods with an action that the rate limit reduced.
    pub rate_limited: u64,
}

impl Default for LadsCounters {
    fn default() -> Self {
        Counters::default().into()
    }
}

impl From<Counters> for LadsCounters {
    fn from(counters: Counters) -> Self {
        let Counters {
            periods,
            policy,
            not_armed,
            stopped,
            no_observation,
            stale,
            coasted,
            late,
            missed,
            not_finite,
            out_of_limits,
            refused,
            saturated,
            rate_limited,
        } = counters;
        Self {
            struct_bytes: size_of::<Self>() as u32,
            periods,
            policy,
            not_armed,
            stopped,
            no_observation,
            stale,
            late,
            not_finite,
            out_of_limits,
            refused,
            coasted,
            missed,
            saturated,
            rate_limited,
        }
    }
}

versioned!(LadsReport, LadsSelfTest, LadsCounters);
