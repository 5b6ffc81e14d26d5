//! Is it the same policy? The compiled one is asked what the reference policy was asked, and must answer alike.
//!
//! Open loop over the traced episodes: at each control step the controller gets the observation that the reference saw, and its history
//! holds the actions that the reference executed. So a difference is the policy's own, however chaotic the physics. Where two plans are
//! equally likely, rounding may pick either: a decision whose margin in the reference is at most [`CLOSE_CALL`] may fall out otherwise,
//! and actions are compared while the same plan is in force. A refused
//! observation is a difference too. What can fail: a workspace that is too small for the policy; it can be told to stop.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};

use lads_compiler::Memory;
use lads_core::{Controller, Decision, Instruction, Isa, Policy};
use serde::Serialize;

use super::reference::{Episode, Reference};
use crate::evaluate::{Assignment, EvaluationError};

/// Difference of two logits that rounding may reverse. Logits of the shipped policies agree with PyTorch's to 1e-4.
pub const CLOSE_CALL: f64 = 1e-3;

/// Largest difference of an action element that is ever allowed, whatever tolerance a bundle states: what is judged does not set the bar.
pub const ACTION_TOLERANCE: f64 = 1e-4;

/// Where a policy first answered otherwise.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Answer {
    /// Id of the instruction.
    pub instruction: String,
    /// Number of the episode.
    pub episode: usize,
    /// Control step, from 0.
    pub step: usize,
    /// What was different.
    pub what: String,
}

impl fmt::Display for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            instruction,
            episode,
            step,
            what,
        } = self;
        write!(
            f,
            "instruction {instruction}, episode {episode}, step {step}: {what}"
        )
    }
}

/// What came of asking.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Answers {
    /// Episodes replayed.
    pub episodes: usize,
    /// Control steps in them.
    pub steps: usize,
    /// Steps with the same plan in force, whose actions were compared.
    pub compared_steps: usize,
    /// Largest absolute difference of an action element in these.
    pub largest_action_difference: f64,
    /// What it may be: the bundle's own tolerance, and at most [`ACTION_TOLERANCE`].
    pub action_tolerance: f64,
    /// Largest difference between the margins of two equal decisions.
    pub largest_margin_difference: f64,
    /// Decisions that fell out otherwise within [`CLOSE_CALL`].
    pub close_calls: usize,
    /// Episodes with any difference beyond these bounds.
    pub differing_episodes: usize,
    /// The first difference.
    pub first_difference: Option<Answer>,
}

/// Asks `policy`, on the instruction set `isa`, about the first `episodes` traced episodes of each assigned instruction.
/// `finished` is called after each episode, `stop` ends the work early.
pub fn ask(
    policy: &Policy<'_>,
    isa: Isa,
    reference: &Reference,
    assignments: &[Assignment],
    episodes: u32,
    stop: &AtomicBool,
    finished: &dyn Fn(),
) -> Result<Answers, EvaluationError> {
    let mut answers = Answers {
        action_tolerance: policy
            .golden()
            .map_or(ACTION_TOLERANCE, |golden| f64::from(golden.tolerance()))
            .min(ACTION_TOLERANCE),
        ..Answers::default()
    };
    let mut memory = Memory::of(policy).map_err(EvaluationError::Memory)?;
    let mut controller = memory
        .controller_with(policy, isa)
        .map_err(EvaluationError::Memory)?;
    controller.set_decision(Decision::Argmax);
    for &Assignment {
        instruction: index, ..
    } in assignments
    {
        let Some(instruction) = reference.instructions.get(index as usize) else {
            continue;
        };
        let asked = instruction.episodes.iter().take(episodes as usize);
        for (episode, recorded) in asked.enumerate() {
            if stop.load(Ordering::Relaxed) {
                return Err(EvaluationError::Interrupted);
            }
            let difference = replay(
                &mut controller,
                index,
                recorded,
                reference.horizon,
                &mut answers,
            );
            finished();
            let Some((step, what)) = difference else {
                continue;
            };
            answers.differing_episodes += 1;
            let found = Answer {
                instruction: instruction.id.clone(),
                episode,
                step,
                what,
            };
            answers.first_difference.get_or_insert(found);
        }
    }
    Ok(answers)
}

/// Replays one episode; the first difference ends it.
fn replay(
    controller: &mut Controller<'_, '_>,
    instruction: u32,
    episode: &Episode,
    horizon: usize,
    answers: &mut Answers,
) -> Option<(usize, String)> {
    let trace = episode.trace.as_ref()?;
    answers.episodes += 1;
    if let Err(error) = controller.set_instruction(Instruction::Id(instruction)) {
        return Some((0, format!("the instruction is refused: {error}")));
    }
    let contract = controller.policy().contract();
    let (observation_len, action_len) = (contract.observation_len(), contract.action_len());
    let mut action = vec![0.0; action_len];
    let observations = trace.observations.chunks_exact(observation_len);
    let mut same_plan = true;
    for (step, (seen, done)) in observations
        .zip(trace.actions.chunks_exact(action_len))
        .enumerate()
    {
        answers.steps += 1;
        let report = match controller.step(seen, &mut action) {
            Ok(report) => report,
            Err(error) => return Some((step, format!("the observation is refused: {error}"))),
        };
        let decides = step.is_multiple_of(horizon);
        if report.decided != decides {
            let did = if decides {
                "keeps its plan where the reference decides"
            } else {
                "decides where the reference keeps its plan"
            };
            return Some((step, format!("the policy {did}")));
        }
        if decides {
            let (plan, margin) = (
                episode.plans[step / horizon],
                episode.margins[step / horizon],
            );
            same_plan = report.plan.0 == plan;
            if same_plan {
                let difference = (f64::from(report.margin) - margin).abs();
                answers.largest_margin_difference =
                    answers.largest_margin_difference.max(difference);
            } else if margin <= CLOSE_CALL {
                answers.close_calls += 1;
            } else {
                return Some((
                    step,
                    format!(
                        "plan {}, the reference's is {plan} by a margin of {margin:.4}",
                        report.plan.0
                    ),
                ));
            }
        }
        if same_plan {
            answers.compared_steps += 1;
            for (index, (&ours, &theirs)) in action.iter().zip(done).enumerate() {
                let difference = f64::from((ours - theirs).abs());
                answers.largest_action_difference =
                    answers.largest_action_difference.max(difference);
                if difference > answers.action_tolerance {
                    return Some((
                        step,
                        format!("action element {index} is {ours}, the reference's is {theirs}"),
                    ));
                }
            }
        }
        // The next question has the reference's history. An executed action is finite, as the trace's length and origin say.
        if let Err(error) = controller.executed(done) {
            return Some((step, format!("the reference's action is refused: {error}")));
        }
    }
    None
}
