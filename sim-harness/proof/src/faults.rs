//! Faults between policy and environment in a run: late, lost and noisier observations, sluggish actuators.
//!
//! What can fail: settings that mean nothing.

use serde::Serialize;
use thiserror::Error;

/// Largest delay of an observation in control steps: ten seconds or more on any robot that has such a policy.
pub const LONGEST_DELAY: usize = 1_000;

/// Faults between policy and environment; the default has none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Faults {
    /// Control steps by which observations come late; the first one is seen until then.
    pub delay_steps: usize,
    /// Share of observations that are lost, from 0 to 1; the last one that came stays in use. The first of an episode always comes.
    pub drop_rate: f64,
    /// Factor on the noise that the environment adds to what the policy sees.
    pub noise_scale: f64,
    /// Time constant, in control steps, of a first-order lag between action and actuator; the policy is not told what was executed.
    pub action_lag: f64,
}

impl Default for Faults {
    fn default() -> Self {
        Self {
            delay_steps: 0,
            drop_rate: 0.0,
            noise_scale: 1.0,
            action_lag: 0.0,
        }
    }
}

/// Why a fault setting is meaningless.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[non_exhaustive]
pub enum FaultError {
    /// The delay is longer than any episode.
    #[error("a delay of {0} control steps: give at most {LONGEST_DELAY}")]
    Delay(usize),
    /// The drop rate is not a share from 0 to 1.
    #[error("a drop rate of {0}: give a share from 0 to 1")]
    Drop(f64),
    /// The noise scale is not a finite factor from 0.
    #[error("a noise scale of {0}: give a finite factor that is not negative")]
    Noise(f64),
    /// The action lag is not a finite time from 0.
    #[error("an action lag of {0}: give a finite number of control steps that is not negative")]
    Lag(f64),
}

impl Faults {
    /// Refuses meaningless settings.
    pub fn check(&self) -> Result<(), FaultError> {
        let not_negative = |x: f64| x.is_finite() && x >= 0.0;
        if self.delay_steps > LONGEST_DELAY {
            return Err(FaultError::Delay(self.delay_steps));
        }
        if !(0.0..=1.0).contains(&self.drop_rate) {
            return Err(FaultError::Drop(self.drop_rate));
        }
        if !not_negative(self.noise_scale) {
            return Err(FaultError::Noise(self.noise_scale));
        }
        if !not_negative(self.action_lag) {
            return Err(FaultError::Lag(self.action_lag));
        }
        Ok(())
    }
}
