//! Is it the same environment? The reference's actions must lead through the reference's states.
//!
//! One machine and one version of MuJoCo give the same bits; another CPU's libm moves them by less than the tolerance. Nothing here can fail.

use serde::Serialize;

use crate::answers::Answer;

/// Largest difference of a state element (rad or m) that counts as the same: thousand times the 2e-9 that another libm makes of
/// the first two seconds, far below what a policy could notice.
pub const STATE_TOLERANCE: f64 = 1e-6;

/// What came of the recorded actions.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Physics {
    /// Episodes replayed.
    pub episodes: usize,
    /// States compared.
    pub states: usize,
    /// Whether all had the same bits.
    pub identical_bits: bool,
    /// Largest difference of an element.
    pub largest_state_difference: f64,
    /// What it may be.
    pub state_tolerance: f64,
    /// The first state beyond it.
    pub first_difference: Option<Answer>,
}

impl Physics {
    /// Nothing seen yet.
    pub fn new() -> Self {
        Self {
            identical_bits: true,
            state_tolerance: STATE_TOLERANCE,
            ..Self::default()
        }
    }

    /// Compares one state; `place` says where it is from.
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
