//! Is it the same environment? The reference's actions must lead through the reference's states.
//!
//! Open loop over the traced episodes: reset, then the recorded actions, whatever a policy would do. One machine and one version of MuJoCo
//! give the same bits; another CPU's libm moves them by less than the tolerance. What can fail: an action that the environment refuses; it can
//! be told to stop.

use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;

use super::policy::Answer;
use super::reference::Reference;
use crate::environment::{Environment, EpisodeSeed};
use crate::evaluate::{Assignment, EvaluationError};

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

/// Replays the first `episodes` traced episodes of each instruction. `finished` is called after each, `stop` ends the work early.
pub fn replay(
    environment: &mut dyn Environment,
    reference: &Reference,
    assignments: &[Assignment],
    episodes: u32,
    stop: &AtomicBool,
    finished: &dyn Fn(),
) -> Result<Physics, EvaluationError> {
    let mut physics = Physics {
        identical_bits: true,
        state_tolerance: STATE_TOLERANCE,
        ..Physics::default()
    };
    for assignment in assignments {
        let index = assignment.instruction as usize;
        let Some(instruction) = reference.instructions.get(index) else {
            continue;
        };
        for (number, episode) in instruction
            .episodes
            .iter()
            .take(episodes as usize)
            .enumerate()
        {
            if stop.load(Ordering::Relaxed) {
                return Err(EvaluationError::Interrupted);
            }
            let Some(trace) = &episode.trace else {
                continue;
            };
            physics.episodes += 1;
            let seed = EpisodeSeed {
                seed: reference.seed,
                instruction: index as u64,
                episode: number as u64,
            };
            environment.reset(seed, &assignment.commanded);
            let states = trace.states.chunks_exact(environment.observation_len());
            let actions = trace.actions.chunks_exact(environment.action_len());
            for (step, (expected, action)) in states.zip(actions).enumerate() {
                physics.compare(environment.state(), expected, || Answer {
                    instruction: instruction.id.clone(),
                    episode: number,
                    step,
                    what: String::new(),
                });
                let command: Vec<f64> = action.iter().map(|&x| f64::from(x)).collect();
                if let Err(error) = environment.step(&command) {
                    let what = format!("the environment refuses the reference's action: {error}");
                    let place = Answer {
                        instruction: instruction.id.clone(),
                        episode: number,
                        step,
                        what,
                    };
                    physics.first_difference.get_or_insert(place);
                    break;
                }
            }
            finished();
        }
    }
    Ok(physics)
}

impl Physics {
    fn compare(&mut self, state: &[f64], expected: &[f64], place: impl Fn() -> Answer) {
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
