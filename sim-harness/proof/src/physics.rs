//! Checks that the environment is the reference's: its actions must lead through its states. The reference's actions must lead through the
//! reference's states.
//!
//! One machine and one version of MuJoCo give the same bits; another CPU's libm moves them by less than the tolerance. Nothing here can fail.

use serde::Serialize;

use crate::answers::Answer;

/// Largest difference of a state element (rad or m) that counts as the same: a thousand times the 2e-9 that another libm makes of the first
/// two seconds, far below what a policy could notice.
pub const STATE_TOLERANCE: f64 = 1e-6;

/// Comparison of the states that the recorded actions lead to.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Physics {
    /// Number of episodes replayed.
    pub episodes: usize,
    /// Number of states compared.
    pub states: usize,
    /// Whether all states had the same bits.
    pub identical_bits: bool,
    /// Largest difference of a state's element.
    pub largest_state_difference: f64,
    /// Allowed difference of a state's element.
    pub state_tolerance: f64,
    /// First state beyond the tolerance.
    pub first_difference: Option<Answer>,
}

impl Physics {
    /// Starts a comparison without states.
    pub fn new() -> Self {
        Self {
            identical_bits: true,
            state_tolerance: STATE_TOLERANCE,
            ..Self::default()
        }
    }

    /// Compares one state; `place` names its origin.
    pub fn compare(&mut self, state: &[f64], expected: &[f64], place: impl Fn() -> Answer) {
        self.states += 1;
        for (index, (&ours, &theirs)) in state.iter().zip(expected).enumerate() {
            self.identical_bits &= ours.to_bits() == theirs.to_bits();
            let difference = (ours - theirs).abs();
            self.largest_state_difference = self.largest_state_difference.max(difference);
            if difference > STATE_TOLERANCE || difference.is_nan() {
                let what = format!("state element {index} is {ours}, the reference's is {theirs}");
                self.first_difference
                    .get_or_insert_with(|| Answer { what, ..place() });
            }
        }
    }
}
