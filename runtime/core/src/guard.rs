//! Guard between a policy and the motors: a [`GuardedController`] is a
//! [`Controller`](crate::Controller) whose inputs are watched and whose output is limited.
//!
//! In every control period it writes an action that is finite, inside the limits, and no further
//! from the last one than the rate allows, whatever the observation, the clock or the policy do.
//! When the policy's action cannot be used (an [`Intervention`]) the [`Fallback`] decides what is
//! written instead. Before the self-test has passed and an instruction is set only the safe action
//! is written.
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

/// Rule for the action to write when the policy's action cannot be used. Every rule keeps the
/// limits and the rate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Fallback {
    /// Moves to the safe action and stays there until [`GuardedController::resume`].
    #[default]
    Stop,
    /// Repeats the last action.
    Hold,
    /// Moves towards the safe action: each period takes away `period / (period + time_constant)` of
    /// the remaining distance.
    Decay {
        /// Time constant in seconds, above zero.
        time_constant_s: f32,
    },
}

/// Configuration of a guard; the default takes the contract's limits, has no rate limit, and stops
/// at the first intervention.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GuardConfig<'c> {
    /// Action to write when the policy's action cannot be used.
    pub fallback: Fallback,
    /// Number of missed control periods between two steps that is still tolerated.
    pub late_after: u32,
    /// Number of periods in a row without a usable observation in which the last action is repeated
    /// and the policy's state is kept before the fallback takes over; 0 for none.
    pub coast: u32,
    /// Largest step from the last timestamp to the next, in its unit; 0 for any, so that one
    /// damaged timestamp makes all later ones stale until a reset. A timestamp further ahead is
    /// refused, and does not become the last one, until the next one follows on it within the bound:
    /// then the time has really passed. Of the first two of an episode either may be the damaged
    /// one: the next timestamp is measured from the second.
    pub max_jump: u64,
    /// Number of interventions in a row after which the guard stops; 0 for never.
    pub stop_after: u32,
    /// Limits, rates and the safe action.
    pub limits: Limits<'c>,
}

impl GuardConfig<'_> {
    /// Checks the configuration against a contract, before a controller with its memory is made.
    pub fn check(&self, contract: &Contract) -> Result<(), GuardError> {
        self.share(contract)?;
        limiter::check(contract, &self.limits)
    }

    /// Returns the fraction of the distance to the safe action that a decay removes in a period.
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
    /// Time at which the observation was taken, in any unit. An observation that is not later than
    /// the last one is stale.
    pub timestamp: u64,
    /// Number of control periods that have passed without a step since the last one.
    pub missed: u32,
}

/// Reason why the policy's action was not used.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Intervention {
    /// The self-test has not passed, and the caller has not declined it with
    /// [`GuardedController::arm_untested`].
    NotArmed,
    /// The guard is stopped, by the fallback or by the caller.
    Stopped,
    /// No observation was given in this period.
    NoObservation,
    /// The observation is no later than the last one.
    Stale,
    /// The timestamp is further ahead of the last one than the configuration allows and is
    /// considered corrupt.
    Jump,
    /// More control periods were missed than tolerated.
    Late {
        /// Number of missed periods.
        missed: u32,
    },
    /// The controller refused the observation, or could not compute an action.
    Refused(StepError),
}

/// Result of a guarded control period.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[non_exhaustive]
pub struct GuardReport {
    /// Report of the controller; `None` when it took no step.
    pub step: Option<StepReport>,
    /// Reason why the action is the fallback's; `None` when it is the policy's.
    pub intervention: Option<Intervention>,
    /// True if the last action is repeated because the configuration tolerates this many missed
    /// observations.
    pub coasting: bool,
    /// True if an element was at a limit or beyond and is now at the limit.
    pub saturated: bool,
    /// True if an element moves as fast as it may, less far than it should.
    pub rate_limited: bool,
}

/// Counts of a guard's actions and interventions since it was made. A counter saturates at its
/// largest value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
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
    /// Number of stale observations, including those whose timestamp jumps.
    pub stale: u64,
    /// Number of periods in which the last action was repeated.
    pub coasted: u64,
    /// Number of interventions because too many periods were missed.
    pub late: u64,
    /// Number of all missed periods.
    pub missed: u64,
    /// Number of observations with an element that is not finite.
    pub not_finite: u64,
    /// Number of observations outside the contract's limits.
    pub out_of_limits: u64,
    /// Number of steps that the controller refused for another reason, such as a full context or no
    /// instruction.
    pub refused: u64,
    /// Number of periods with an action at a limit.
    pub saturated: u64,
    /// Number of periods with an action that the rate limit reduced.
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

/// Reason why a guard's configuration was refused.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum GuardError {
    /// The memory has too few elements.
    Memory {
        /// Number of elements given.
        got: usize,
        /// Number of elements needed.
        needed: usize,
    },
    /// Limits, rates or the safe action have another length than an action.
    Length {
        /// Number of elements given.
        got: usize,
        /// Number of elements in the contract.
        needed: usize,
    },
    /// A limit is not finite, the upper is below the lower, or they do not overlap the contract's
    /// range.
    Limits {
        /// Index of the first such element.
        index: usize,
    },
    /// A rate is not a finite number above zero.
    Rate {
        /// Index of the first such element.
        index: usize,
    },
    /// The safe action is not finite or outside the limits.
    SafeAction {
        /// Index of the first such element.
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
                "the limits of action element {index} do not overlap the contract's range"
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

/// The caller's action has another length than the contract's: nothing was written, and no step was
/// taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ActionLength {
    /// Number of elements given.
    pub got: usize,
    /// Number of elements in the contract.
    pub needed: usize,
}

impl fmt::Display for ActionLength {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { got, needed } = self;
        write!(f, "an action of {got} elements, the contract says {needed}")
    }
}

impl Error for ActionLength {}
