//! Asks the compiled policy what the reference policy was asked; [`lads_proof::answers`] and [`lads_proof::rounding`] judge.
//!
//! Open loop: at each control step of a traced episode the controller gets the observation that the reference saw, and its history holds
//! the actions that the reference executed. A policy with cameras gets frames drawn of the reference's states, with the recorded observation where
//! it observes a vector too, and is asked up to the first frame that is not the reference's. What can fail: a workspace that is too small for the
//! policy, a bundle that does not compile with 32 bits; it can be told to stop.

use std::sync::atomic::{AtomicBool, Ordering};

use lads_compiler::{Bundle, Options};
use lads_core::{Controller, DType, Data, Decision, Instruction, Isa, Noise, Policy};
use lads_host::Memory;
use lads_proof::answers::{Replay, Reply};
use lads_proof::numbering::Numbering;
use lads_proof::reference::{Reference, Trace};
use lads_proof::rounding::Asked;

use crate::evaluate::{Assignment, EvaluationError};
use crate::plans::{self, Segment};
use crate::verify::shown::Shown;

/// Questions to a policy: the first traced episodes of each assigned instruction.
#[derive(Debug, Clone, Copy)]
pub struct Questions<'q> {
    /// Reference that recorded the episodes.
    pub reference: &'q Reference,
    /// Instructions whose episodes are asked.
    pub assignments: &'q [Assignment],
    /// Largest number of episodes of each instruction.
    pub episodes: u32,
    /// What the cameras show in them; `None` for a policy without.
    pub shown: Option<&'q Shown>,
}

/// Returns how many times [`judge`] asks the questions: a second time with 32 bits if the image has fewer and selects the largest logit.
pub fn rounds(policy: &Policy<'_>) -> usize {
    let selects = policy.index_count() > 0 && policy.contract().decision() == Decision::Argmax;
    1 + usize::from(selects && !lads_host::is_exact(policy))
}

/// Puts the questions to an image and, if it has fewer bits than 32, to its bundle with 32, and judges the answers.
pub fn judge(
    (policy, isa): (&Policy<'_>, Isa),
    bundle: &Bundle,
    questions: Questions<'_>,
    stop: &AtomicBool,
    finished: &dyn Fn(),
) -> Result<(Asked, Numbering), EvaluationError> {
    let how = (isa, policy.contract().decision());
    let replays = ask(policy, how, questions, stop, finished)?;
    let stated = policy.golden().map(|golden| f64::from(golden.tolerance()));
    let reference = questions.reference;
    if rounds(policy) == 1 {
        return Ok(Asked::judge(reference, &replays, None, stated));
    }
    let exact = lads_compiler::compile_with(bundle, &Options::exact());
    let exact = exact.map_err(EvaluationError::Exact)?;
    let exact = Policy::new_checked(exact.as_bytes())
        .unwrap_or_else(|error| unreachable!("the compiler checked it: {error}"));
    let exact = ask(&exact, how, questions, stop, finished)?;
    Ok(Asked::judge(reference, &replays, Some(&exact), stated))
}

/// Asks `policy`, on the instruction set `isa` and by the rule `decision`. `finished` is called after each episode, `stop` ends the work
/// early.
pub fn ask(
    policy: &Policy<'_>,
    (isa, decision): (Isa, Decision),
    questions: Questions<'_>,
    stop: &AtomicBool,
    finished: &dyn Fn(),
) -> Result<Vec<Replay>, EvaluationError> {
    let Questions {
        reference,
        assignments,
        episodes,
        shown,
    } = questions;
    let mut memory = Memory::of(policy).map_err(EvaluationError::Memory)?;
    let mut controller = memory
        .controller_with(policy, isa)
        .map_err(EvaluationError::Memory)?;
    controller.set_decision(decision);
    let encoder = Segment::of(policy).filter(|encoder| Some(encoder.steps) == reference.period);
    let mut replays = Vec::new();
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
            if let Some(trace) = &recorded.trace {
                let seen = Seen {
                    trace,
                    shown,
                    place: [index as usize, episode],
                };
                if let Some(seed) = recorded.noise_seed {
                    controller.set_noise(Noise::Seeded { seed });
                }
                replays.push(Replay {
                    episode,
                    encoded: encoder.map(|encoder| encode(&mut controller, trace, encoder)),
                    ..replay(&mut controller, index, seen)?
                });
            }
            finished();
        }
    }
    Ok(replays)
}

/// What a policy sees in a traced episode.
#[derive(Clone, Copy)]
struct Seen<'q> {
    trace: &'q Trace,
    shown: Option<&'q Shown>,
    /// Index of the instruction and number of the episode.
    place: [usize; 2],
}

impl Seen<'_> {
    /// Number of steps that can be asked about.
    fn steps(&self, action_len: usize) -> usize {
        let [instruction, episode] = self.place;
        let all = self.trace.actions.len() / action_len.max(1);
        self.shown
            .map_or(all, |shown| shown.same(instruction, episode))
    }
}

/// Replays one episode; a refusal ends it.
fn replay(
    controller: &mut Controller<'_, '_>,
    instruction: u32,
    seen: Seen<'_>,
) -> Result<Replay, EvaluationError> {
    let mut replay = Replay {
        instruction: instruction as usize,
        ..Replay::default()
    };
    if let Err(error) = controller.set_instruction(Instruction::Id(instruction)) {
        replay.refused = Some(format!("the instruction is refused: {error}"));
        return Ok(replay);
    }
    let contract = controller.policy().contract();
    let vector = contract
        .observations()
        .find(|channel| channel.dtype() == DType::F32);
    let mut action = vec![0.0; contract.action_len()];
    let mut images = Vec::new();
    let actions = seen.trace.actions.chunks_exact(action.len());
    let asked = actions.take(seen.steps(action.len()));
    for (step, done) in asked.enumerate() {
        let rows = vector.and_then(|channel| {
            let mut rows = seen.trace.observations.chunks_exact(channel.len());
            Some((channel.id(), Data::F32(rows.nth(step)?)))
        });
        let mut given: Vec<_> = rows.into_iter().collect();
        if let Some(shown) = seen.shown {
            let [instruction, episode] = seen.place;
            let read = shown.read((instruction, episode, step), &mut images);
            read.map_err(EvaluationError::Frames)?;
            given.extend(shown.channels(&images));
        }
        let report = match controller.step_with(&given, &mut action) {
            Ok(report) => report,
            Err(error) => {
                replay.refused = Some(format!("the observation is refused: {error}"));
                break;
            }
        };
        let decided = report.selected.is_some_and(|selected| selected.fresh);
        let scores = if decided { controller.scores() } else { &[] };
        replay.replies.push(Reply {
            decided,
            plan: report.selected.map(|selected| selected.index),
            logits: scores.to_vec(),
            plan_vector: controller.state(plans::VECTOR).unwrap_or_default().to_vec(),
            margin: report
                .selected
                .map(|selected| selected.margin)
                .filter(|margin| decided && margin.is_finite()),
            action: action.clone(),
        });
        // The next question has the reference's history. An executed action is finite, as the trace's length and origin say.
        if let Err(error) = controller.executed(done) {
            replay.refused = Some(format!("the reference's action is refused: {error}"));
            break;
        }
    }
    Ok(replay)
}

/// Plans that the policy's trajectory encoder sees in each full segment of a trace, up to the first that it refuses.
fn encode(controller: &mut Controller<'_, '_>, trace: &Trace, encoder: Segment) -> Vec<u32> {
    let contract = controller.policy().contract();
    let [observations, actions] =
        [contract.observation_len(), contract.action_len()].map(|len| len * encoder.steps);
    let segments = trace.observations.chunks_exact(observations);
    segments
        .zip(trace.actions.chunks_exact(actions))
        .map_while(|(seen, done)| encoder.encode(controller, seen, done).ok())
        .collect()
}
