//! Checks that the environment is the reference's: the reference's actions must lead through the reference's states. The reference's
//! actions must lead through the reference's states.
//!
//! Open loop over the traced episodes: reset, then the recorded actions, whatever a policy would do. One machine and one version of MuJoCo
//! give the same bits; another CPU's libm moves them by less than the tolerance. What can fail: an action that the environment refuses; it can
//! be told to stop.

use std::sync::atomic::{AtomicBool, Ordering};

use lads_proof::answers::Answer;
use lads_proof::physics::Physics;
use lads_proof::reference::Reference;

use crate::environment::{Environment, EpisodeSeed};
use crate::evaluate::{Assignment, EvaluationError};

/// Replays the first `episodes` traced episodes of each instruction. `finished` is called after each, `stop` ends the work early.
pub fn replay(
    environment: &mut dyn Environment,
    reference: &Reference,
    assignments: &[Assignment],
    episodes: u32,
    stop: &AtomicBool,
    finished: &dyn Fn(),
) -> Result<Physics, EvaluationError> {
    let mut physics = Physics::new();
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
            let states = trace.states.chunks_exact(environment.state().len());
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
