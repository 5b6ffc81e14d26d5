//! What stands between a policy and the motors: a [`GuardedController`] is a [`Controller`](crate::Controller) whose inputs are
//! watched and whose output is limited.
//!
//! In every control period it writes an action that is finite, inside the limits, and no further from the last one than the rate
//! allows, whatever the observation, the clock or the policy do. When the policy's action cannot be used (an [`Intervention`]) the
//! [`Fallback`] decides what is written instead. Before the self-test has passed and an instruction is set there is nothing but the
//! safe action.
//!
//! What can fail: [`GuardedController::new`], when the configuration contradicts the contract ([`GuardError`]); a step only when
//! the caller's action has the wrong length, so that nothing can be written.

mod controller;
mod limiter;

use core::error::Error;
use core::fmt;

use crate::contract::Contract;
use crate::controller::StepReport;
use crate::errors::{InputError, StepError};

pub use controller::{GuardedController, SwapError};
pub use limiter::Limits;

/// What is written when the policy's action cannot be used. All of them keep the limits and the rate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Fallback {
    /// To the safe action, and stay there until [`GuardedController::resume`].
    #[default]
    Stop,
    /// The last action again.
    Hold,
    /// Towards the safe action: each period takes away `period / (period + time_constant)` of what is left.
    Decay {
        /// In seconds, above zero.
        time_constant_s: f32,
    },
}

/// How a guard works; the default takes the contract's limits, knows no rate, and stops at the first intervention.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GuardConfig<'c> {
    /// What to do when the policy's action cannot be used.
    pub fallback: Fallback,
    /// Missed control periods that are still tolerated between two steps.
    pub late_after: u32,
    /// Periods in a row without an observation that can be used, in which the last action is repeated and the policy's state is
    /// kept before the fallback takes over; 0 for none.
    pub coast: u32,
    /// The farthest that a timestamp may lie behind the last one, in its unit; 0 for any distance. One beyond it is refused, and
    /// does not count as the last one.
    pub max_jump: u64,
    /// Stops after so many interventions in a row; 0 for never.
    pub stop_after: u32,
    /// Limits, rates and the safe action.
    pub limits: Limits<'c>,
}

impl GuardConfig<'_> {
    /// Says what of it contradicts a contract, before a controller with its memory is made.
    pub fn check(&self, contract: &Contract) -> Result<(), GuardError> {
        self.share(contract)?;
        limiter::check(contract, &self.limits)
    }

    /// The part of what is left to the safe action that a decay takes away in a period.
    fn share(&self, contract: &Contract) -> Result<f32, GuardError> {
        match self.fallback {
            Fallback::Decay { time_constant_s } => {
                if !time_constant_s.is_finite() || time_constant_s <= 0.0 {
                    return Err(GuardError::TimeConstant);
                }
                let period = contract.control_period_s();
                Ok(period / (period + time_constant_s))
            }
            Fallback::Stop | Fallback::Hold => Ok(1.0),
        }
    }
}

/// The clock of one control period.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tick {
    /// When the observation was taken, in any unit. One that is not later than the last one is stale.
    pub timestamp: u64,
    /// Control periods that have passed without a step since the last one.
    pub missed: u32,
}

/// Why the policy's action was not used.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Intervention {
    /// The self-test has not passed, and nobody has declined it.
    NotArmed,
    /// Stopped, by the fallback or by the caller.
    Stopped,
    /// There is no observation in this period.
    NoObservation,
    /// The observation is no later than the last one.
    Stale,
    /// The timestamp lies farther ahead of the last one than the configuration allows: it is taken for damaged.
    Jump,
    /// More control periods were missed than tolerated.
    Late {
        /// How many.
        missed: u32,
    },
    /// The controller refused the observation, or could not compute an action.
    Refused(StepError),
}

/// What happened in a guarded control period.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[non_exhaustive]
pub struct GuardReport {
    /// What the controller says; `None` when it took no step.
    pub step: Option<StepReport>,
    /// Why the action is the fallback's; `None` when it is the policy's.
    pub intervention: Option<Intervention>,
    /// The action is the last one again, because the configuration lets so many observations be missed.
    pub coasting: bool,
    /// An element was at a limit or beyond and is now at the limit.
    pub saturated: bool,
    /// An element moves as fast as it may, less far than it should.
    pub rate_limited: bool,
}

/// What a guard has done since it was made. Counters stay at their largest value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Control periods.
    pub periods: u64,
    /// Periods with the policy's action.
    pub policy: u64,
    /// Periods before arming.
    pub not_armed: u64,
    /// Periods while stopped.
    pub stopped: u64,
    /// Periods without an observation.
    pub no_observation: u64,
    /// Stale observations, and those whose timestamp jumps.
    pub stale: u64,
    /// Periods in which the last action was repeated.
    pub coasted: u64,
    /// Interventions because too many periods were missed.
    pub late: u64,
    /// All missed periods.
    pub missed: u64,
    /// Observations with an element that is not finite.
    pub not_finite: u64,
    /// Observations outside the contract's limits.
    pub out_of_limits: u64,
    /// Steps that the controller refused for another reason, such as a full context or no instruction.
    pub refused: u64,
    /// Periods with an action at a limit.
    pub saturated: u64,
    /// Periods with an action that the rate held back.
    pub rate_limited: u64,
}

impl Counters {
    fn add(&mut self, report: &GuardReport) {
        let reason = match report.intervention {
            None => &mut self.policy,
            Some(Intervention::NotArmed) => &mut self.not_armed,
            Some(Intervention::Stopped) => &mut self.stopped,
            Some(Intervention::NoObservation) => &mut self.no_observation,
            Some(Intervention::Stale | Intervention::Jump) => &mut self.stale,
            Some(Intervention::Late { .. }) => &mut self.late,
            Some(Intervention::Refused(StepError::Input(InputError::NotFinite { .. }))) => {
                &mut self.not_finite
            }
            Some(Intervention::Refused(StepError::Input(InputError::OutOfLimits { .. }))) => {
                &mut self.out_of_limits
            }
            Some(Intervention::Refused(_)) => &mut self.refused,
        };
        *reason = reason.saturating_add(1);
        self.periods = self.periods.saturating_add(1);
        self.coasted = self.coasted.saturating_add(u64::from(report.coasting));
        self.saturated = self.saturated.saturating_add(u64::from(report.saturated));
        self.rate_limited = self
            .rate_limited
            .saturating_add(u64::from(report.rate_limited));
    }
}

/// Why a guard's configuration was refused.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum GuardError {
    /// The memory has too few elements.
    Memory {
        /// Elements that there are.
        got: usize,
        /// Elements that are needed.
        needed: usize,
    },
    /// Limits, rates or the safe action are not as long as an action.
    Length {
        /// Elements given.
        got: usize,
        /// Elements in the contract.
        needed: usize,
    },
    /// A limit is not finite, below the other one, or leaves nothing of the contract's range.
    Limits {
        /// The first such element.
        index: usize,
    },
    /// A rate is not a finite number above zero.
    Rate {
        /// The first such element.
        index: usize,
    },
    /// The safe action is not finite or outside the limits.
    SafeAction {
        /// The first such element.
        index: usize,
    },
    /// The time constant of the decay is not a finite number above zero.
    TimeConstant,
}

impl fmt::Display for GuardError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Memory { got, needed } => write!(
                f,
                "the guard's memory has {got} elements, {needed} are needed"
            ),
            Self::Length { got, needed } => {
                write!(f, "{got} elements, an action has {needed}")
            }
            Self::Limits { index } => write!(
                f,
                "the limits of action element {index} leave nothing of the contract's range"
            ),
            Self::Rate { index } => write!(
                f,
                "the rate of action element {index} is not a finite number above zero"
            ),
            Self::SafeAction { index } => {
                write!(f, "the safe action's element {index} is outside the limits")
            }
            Self::TimeConstant => {
                f.write_str("the time constant is not a finite number above zero")
            }
        }
    }
}

impl Error for GuardError {}

/// The caller's action has another length than the contract's: nothing was written, and no step was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ActionLength {
    /// Elements given.
    pub got: usize,
    /// Elements in the contract.
    pub needed: usize,
}

impl fmt::Display for ActionLength {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { got, needed } = self;
        write!(f, "an action of {got} elements, the contract says {needed}")
    }
}

impl Error for ActionLength {}
