//! A controller behind a guard.

use super::limiter::{Changed, Limiter};
use super::{
    ActionLength, Counters, Fallback, GuardConfig, GuardError, GuardReport, Intervention, Tick,
};
use core::error::Error;
use core::fmt;

use crate::contract::{ChannelId, Contract, Decision, Noise};
use crate::controller::{Controller, Instruction, StepReport};
use crate::errors::{InstructionError, StepError};
use crate::inputs::Data;
use crate::policy::Policy;
use crate::self_test::{SelfTest, SelfTestError};

/// A [`Controller`] whose inputs are watched and whose output is limited.
///
/// In every control period it writes an action that is finite, inside the limits, and no further
/// from the last one than the rate allows, whatever the observation, the clock or the policy do.
/// When the policy's action cannot be used (an [`Intervention`]) the [`Fallback`] decides what is
/// written instead. Before the self-test has passed and an instruction is set only the safe action
/// is written. What can fail is [`GuardedController::new`], when the configuration contradicts the
/// contract ([`GuardError`]), and a step only when the caller's action has the wrong length, so
/// that nothing can be written.
///
/// The [example](crate#example) of this crate drives one.
#[derive(Debug)]
pub struct GuardedController<'a, 'm> {
    controller: Controller<'a, 'm>,
    limiter: Limiter<'m>,
    fallback: Fallback,
    /// Fraction of the remaining distance that a decay removes per period.
    share: f32,
    late_after: u32,
    coast: u32,
    max_jump: u64,
    stop_after: u32,
    armed: bool,
    stopped: bool,
    /// Number of interventions since the last action of the policy.
    in_a_row: u32,
    /// Number of periods in a row in which the last action was repeated.
    coasted: u32,
    timestamp: Option<u64>,
    /// Whether a second timestamp has followed on that one: before, either of two that do not fit may be the damaged one.
    confirmed: bool,
    /// The last timestamp, if it jumped: the next may follow on it.
    strayed: Option<u64>,
    counters: Counters,
}

impl<'a, 'm> GuardedController<'a, 'm> {
    /// Returns the number of elements of memory that the guard needs besides the controller's
    /// workspace.
    pub fn memory_len(policy: &Policy) -> usize {
        Limiter::memory_len(policy.contract().action_len())
    }

    /// Wraps a controller in a guard. It is not armed.
    pub fn new(
        controller: Controller<'a, 'm>,
        config: &GuardConfig,
        memory: &'m mut [f32],
    ) -> Result<Self, GuardError> {
        let contract = controller.policy().contract();
        let share = config.share(contract)?;
        let limiter = Limiter::new(contract, &config.limits, memory)?;
        Ok(Self {
            limiter,
            controller,
            fallback: config.fallback,
            share,
            late_after: config.late_after,
            coast: config.coast,
            max_jump: config.max_jump,
            stop_after: config.stop_after,
            armed: false,
            stopped: false,
            in_a_row: 0,
            coasted: 0,
            timestamp: None,
            confirmed: false,
            strayed: None,
            counters: Counters::default(),
        })
    }

    /// Returns the guarded controller.
    pub fn controller(&self) -> &Controller<'a, 'm> {
        &self.controller
    }

    /// Replays the recorded episode and arms if it passes, disarms if it does not. Afterwards there is no instruction.
    pub fn self_test(&mut self) -> Result<SelfTest, SelfTestError> {
        let outcome = self.controller.self_test();
        self.armed = outcome.is_ok();
        outcome
    }

    /// Arms without a self-test. Whoever calls this vouches for the policy on this machine.
    pub fn arm_untested(&mut self) {
        self.armed = true;
    }

    /// Returns whether the policy's actions are let through.
    pub fn is_armed(&self) -> bool {
        self.armed
    }

    /// Stops as [`Fallback::Stop`] does, from the next step on.
    pub fn stop(&mut self) {
        self.stopped = true;
    }

    /// Returns whether the guard is stopped.
    pub fn is_stopped(&self) -> bool {
        self.stopped
    }

    /// Ends a stop. The episode continues where it was; [`reset`](Self::reset) starts a new one.
    pub fn resume(&mut self) {
        self.stopped = false;
        self.in_a_row = 0;
    }

    /// Returns the counts since the guard was made.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Sets the instruction, like [`Controller::set_instruction`].
    pub fn set_instruction(&mut self, instruction: Instruction) -> Result<(), InstructionError> {
        self.controller.set_instruction(instruction)
    }

    /// Changes the rule that picks an index, like [`Controller::set_decision`].
    pub fn set_decision(&mut self, decision: Decision) {
        self.controller.set_decision(decision);
    }

    /// Changes the source of noise, like [`Controller::set_noise`].
    pub fn set_noise(&mut self, noise: Noise) {
        self.controller.set_noise(noise);
    }

    /// Starts a new episode, like [`Controller::reset`]; timestamps may start anew. A stop stays a
    /// stop.
    pub fn reset(&mut self) {
        self.controller.reset();
        (self.timestamp, self.confirmed, self.strayed) = (None, false, None);
        self.coasted = 0;
    }

    /// Replaces the policy by another one, between two steps, and returns the old controller. The
    /// other policy has to have the same channels and the same control period. Limits, rates and
    /// the last executed action stay, so the first action of the new policy is no further from it
    /// than the rate allows. The guard stays armed if the new controller has passed its self-test.
    /// If the swap is refused, nothing changes.
    #[expect(
        clippy::result_large_err,
        reason = "nothing is allocated: both controllers are moved"
    )]
    pub fn swap(
        &mut self,
        controller: Controller<'a, 'm>,
    ) -> Result<Controller<'a, 'm>, (SwapError, Controller<'a, 'm>)> {
        if let Err(error) = replaceable(&self.controller, &controller) {
            return Err((error, controller));
        }
        self.armed &= controller.is_tested();
        Ok(core::mem::replace(&mut self.controller, controller))
    }

    /// Takes over from another guarded controller, between two steps, with a policy and memory of
    /// its own; the other is idle afterwards. The other's limits, rates, fallback, counters, clock
    /// and last executed action continue here, so the first action is no further from that one than
    /// the rate allows. It is armed if both were. It is refused for the reasons of
    /// [`swap`](Self::swap); then nothing changes on either side.
    pub fn take_over(&mut self, running: &GuardedController) -> Result<(), SwapError> {
        replaceable(&running.controller, &self.controller)?;
        self.limiter.copy_from(&running.limiter);
        self.fallback = running.fallback;
        self.share = running.share;
        self.late_after = running.late_after;
        self.coast = running.coast;
        self.max_jump = running.max_jump;
        self.stop_after = running.stop_after;
        self.armed &= running.armed;
        self.stopped = running.stopped;
        self.in_a_row = running.in_a_row;
        self.coasted = running.coasted;
        (self.timestamp, self.confirmed) = (running.timestamp, running.confirmed);
        self.strayed = running.strayed;
        self.counters = running.counters;
        Ok(())
    }

    /// Brings code, weights and KV caches into the processor's caches, like [`Controller::warm`].
    pub fn warm(&mut self) {
        self.controller.warm();
    }

    /// Runs one control period of a policy with any observation channels: writes an action that may
    /// be executed, whatever the report says. Without a tick, an observation is neither stale nor
    /// late.
    pub fn step_with(
        &mut self,
        inputs: &[(ChannelId, Data)],
        tick: Option<Tick>,
        action: &mut [f32],
    ) -> Result<GuardReport, ActionLength> {
        self.fits(action)?;
        let outcome = self.watch(tick).and_then(|()| {
            let stepped = self.controller.step_with(inputs, action);
            stepped.map_err(Intervention::Refused)
        });
        Ok(self.conclude(outcome, action))
    }

    /// Tells the controller which action was executed, like [`Controller::executed`]; the rate
    /// limit counts from there. Changes by the guard itself need no such call.
    pub fn executed(&mut self, action: &[f32]) -> Result<(), StepError> {
        self.controller.executed(action)?;
        self.limiter.executed(action);
        Ok(())
    }

    /// Runs one control period: writes an action that may be executed, whatever the report says.
    /// Without a tick, an observation is neither stale nor late.
    pub fn step(
        &mut self,
        observation: &[f32],
        tick: Option<Tick>,
        action: &mut [f32],
    ) -> Result<GuardReport, ActionLength> {
        self.fits(action)?;
        let outcome = self
            .watch(tick)
            .and_then(|()| self.advance(observation, action));
        Ok(self.conclude(outcome, action))
    }

    /// Runs one control period without an observation.
    pub fn step_blind(&mut self, action: &mut [f32]) -> Result<GuardReport, ActionLength> {
        self.step_blind_after(0, action)
    }

    /// Runs one control period without an observation, after periods that have passed without a
    /// step.
    pub fn step_blind_after(
        &mut self,
        missed: u32,
        action: &mut [f32],
    ) -> Result<GuardReport, ActionLength> {
        self.fits(action)?;
        self.counters.missed = self.counters.missed.saturating_add(u64::from(missed));
        let outcome = self.watch(None).and(Err(Intervention::NoObservation));
        Ok(self.conclude(outcome, action))
    }

    fn fits(&self, action: &[f32]) -> Result<(), ActionLength> {
        let (got, needed) = (action.len(), self.limiter.last().len());
        if got == needed {
            Ok(())
        } else {
            Err(ActionLength { got, needed })
        }
    }

    /// Checks everything that can be wrong before the observation is examined.
    fn watch(&mut self, tick: Option<Tick>) -> Result<(), Intervention> {
        let missed = tick.map_or(0, |tick| tick.missed);
        self.counters.missed = self.counters.missed.saturating_add(u64::from(missed));
        let last = self.timestamp;
        let between = tick.zip(last).map(|(tick, last)| {
            if self.confirmed {
                tick.timestamp.saturating_sub(last)
            } else {
                tick.timestamp.abs_diff(last)
            }
        });
        let far = self.max_jump > 0 && between.is_some_and(|between| between > self.max_jump);
        // Two in a row that fit each other: the time has really passed.
        let follows = tick.zip(self.strayed).is_some_and(|(tick, strayed)| {
            let after = tick.timestamp.checked_sub(strayed);
            after.is_some_and(|after| (1..=self.max_jump).contains(&after))
        });
        let jumps = far && !follows;
        if let Some(tick) = tick {
            self.strayed = jumps.then_some(tick.timestamp);
        }
        let stale = tick
            .zip(last)
            .is_some_and(|(tick, last)| tick.timestamp <= last);
        if !jumps {
            self.timestamp = last.max(tick.map(|tick| tick.timestamp));
            self.confirmed |= between.is_some_and(|between| between > 0) && !stale;
        } else if !self.confirmed {
            self.timestamp = tick.map(|tick| tick.timestamp);
        }
        if !self.armed {
            Err(Intervention::NotArmed)
        } else if self.stopped {
            Err(Intervention::Stopped)
        } else if jumps {
            Err(Intervention::Jump)
        } else if stale {
            Err(Intervention::Stale)
        } else if missed > self.late_after {
            Err(Intervention::Late { missed })
        } else {
            Ok(())
        }
    }

    fn advance(
        &mut self,
        observation: &[f32],
        action: &mut [f32],
    ) -> Result<StepReport, Intervention> {
        self.controller
            .step(observation, action)
            .map_err(Intervention::Refused)
    }

    /// Writes the final action, updates the counters, and tells the controller which action is
    /// executed.
    fn conclude(
        &mut self,
        outcome: Result<StepReport, Intervention>,
        action: &mut [f32],
    ) -> GuardReport {
        let coasting = outcome.is_err_and(|intervention| self.coasts(intervention));
        let changed = match outcome {
            Ok(_) => {
                (self.in_a_row, self.coasted) = (0, 0);
                self.limiter.write(action)
            }
            Err(_) if coasting => {
                self.coasted = self.coasted.saturating_add(1);
                self.limiter.write_towards_safe(0.0, action)
            }
            Err(intervention) => self.intervene(intervention, action),
        };
        let report = GuardReport {
            step: outcome.ok(),
            intervention: outcome.err(),
            coasting,
            saturated: changed.saturated,
            rate_limited: changed.rate_limited,
        };
        self.counters.add(&report);
        // Fails before the first step of an episode, when there is no token of an action yet.
        let _ = self.controller.executed(action);
        report
    }

    /// Returns whether the last action is repeated instead of falling back: only the observation is
    /// at fault, and not for too long.
    fn coasts(&self, intervention: Intervention) -> bool {
        let observation = matches!(
            intervention,
            Intervention::NoObservation
                | Intervention::Stale
                | Intervention::Jump
                | Intervention::Refused(StepError::Input(_))
        );
        observation && self.armed && !self.stopped && self.coasted < self.coast
    }

    fn intervene(&mut self, intervention: Intervention, action: &mut [f32]) -> Changed {
        // Nothing is wrong yet, or has already been dealt with.
        let waits = matches!(
            intervention,
            Intervention::NotArmed
                | Intervention::Stopped
                | Intervention::Refused(StepError::NoInstruction)
        );
        if !waits {
            self.in_a_row = self.in_a_row.saturating_add(1);
            let enough = self.stop_after > 0 && self.in_a_row >= self.stop_after;
            self.stopped |= enough || matches!(self.fallback, Fallback::Stop);
        }
        let share = match self.fallback {
            _ if waits || self.stopped => 1.0,
            Fallback::Hold => 0.0,
            Fallback::Stop | Fallback::Decay { .. } => self.share,
        };
        self.limiter.write_towards_safe(share, action)
    }
}

/// Checks whether one controller may take the place of another between two steps.
fn replaceable(old: &Controller, new: &Controller) -> Result<(), SwapError> {
    let (before, after) = (old.policy().contract(), new.policy().contract());
    if before.control_period_s().to_bits() != after.control_period_s().to_bits() {
        return Err(SwapError::ControlPeriod);
    }
    if let Some(channel) = difference(before, after) {
        return Err(SwapError::Channels { channel });
    }
    if old.is_instructed() && !new.is_instructed() {
        return Err(SwapError::NoInstruction);
    }
    Ok(())
}

/// Returns the first channel in which two contracts differ for those who give observations and
/// execute actions.
fn difference(old: &Contract, new: &Contract) -> Option<u32> {
    let count = old.channels().count().max(new.channels().count());
    (0_u32..)
        .take(count)
        .map(|i| (i, old.channel(ChannelId(i)), new.channel(ChannelId(i))))
        .find(|(_, old, new)| match (old, new) {
            (Some(old), Some(new)) => !old.is_like(new),
            _ => true,
        })
        .map(|(i, ..)| i)
}

/// Reason why another policy did not take the place of this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum SwapError {
    /// The control periods differ.
    ControlPeriod,
    /// The channels differ.
    Channels {
        /// Number of the first channel that differs.
        channel: u32,
    },
    /// The new policy has no instruction yet, and the old one has.
    NoInstruction,
}

impl fmt::Display for SwapError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::ControlPeriod => f.write_str("the other policy has another control period"),
            Self::Channels { channel } => {
                write!(f, "channel {channel} of the other policy differs")
            }
            Self::NoInstruction => f.write_str("the other policy has no instruction yet"),
        }
    }
}

impl Error for SwapError {}
