//! Judges whether a policy is the reference's by its answers to the reference's questions. What it answered to the reference's questions,
//! judged.
//!
//! Open loop: at each control step of a traced episode the policy got the observation that the reference saw, and its history held the
//! actions that the reference executed. So a difference is the policy's own, however chaotic the physics. Judged are the steps that decide, the
//! logits up to a constant (adding one to all of them changes no probability), the plans, as vectors where they are none of a codebook's, the actions
//! while the same plan is in force, and what the trajectory encoder sees. Where two plans are equally likely, rounding may pick either: a decision whose margin in the reference is
//! at most twice the logits' tolerance may fall out otherwise. Plans that are numbered otherwise throughout are the same plans: that is said and no
//! difference. Nothing here can fail.

use std::fmt;

use serde::Serialize;

use crate::numbering::Numbering;
use crate::reference::{Episode, Reference, Trace};

/// Allowed difference of a logit: one percent of a probability at most. Logits of the shipped policies agree with PyTorch's to 1e-5, and to
/// 1e-2 with weights of 16 bits.
pub const LOGIT_TOLERANCE: f64 = 1e-2;

/// Margin up to which a decision may differ where the reference recorded no logits to judge instead.
pub const CLOSE_CALL: f64 = 1e-3;

/// Largest allowed difference of an action element, whatever tolerance a bundle states: what is judged does not set the bar.
pub const ACTION_TOLERANCE: f64 = 1e-4;

/// Factor on the reference's own float noise that is allowed too: noise of one size does not always have the same effect. A reference measures three
/// draws; of ten others on each shipped policy one moved an action by 2.1 times as much as the largest of the three, in both kitchens.
pub const NOISE_FACTOR: f64 = 3.0;

/// Allowed difference of an element of a plan that is a vector, whose elements deviate by about 1.
pub const PLAN_TOLERANCE: f64 = 1e-3;

/// Relative gap of squared distances up to which a segment's two nearest codes are a close call, so that either may be its encoding.
pub const ENCODER_CLOSE_CALL: f64 = 1e-3;

/// Place of a policy's first different answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Answer {
    /// Id of the instruction.
    pub instruction: String,
    /// Number of the episode.
    pub episode: usize,
    /// Control step, from 0.
    pub step: usize,
    /// Description of the difference.
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

/// Answer of a policy at one control step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reply {
    /// Whether the policy decided a plan at this step.
    pub decided: bool,
    /// Plan in force; `None` if the policy selects none.
    pub plan: Option<u32>,
    /// Logits of a step that decided.
    pub logits: Vec<f32>,
    /// Lead of the best logit over the second; `None` where there are not two.
    pub margin: Option<f32>,
    /// Plan in force of a policy whose plans are vectors; empty of others.
    pub plan_vector: Vec<f32>,
    /// Action of the step.
    pub action: Vec<f32>,
}

/// Answers of a policy to one traced episode.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Replay {
    /// Index of the instruction.
    pub instruction: usize,
    /// Number of the episode.
    pub episode: usize,
    /// Replies in order; fewer than the trace's steps where the policy refused.
    pub replies: Vec<Reply>,
    /// Reason for which the policy refused the next step, if it did.
    pub refused: Option<String>,
    /// Plan that the trajectory encoder sees in each segment of the reference's trace, fewer where it refused one; `None` without an
    /// encoder.
    pub encoded: Option<Vec<u32>>,
}

/// Summary of the policy's answers beside the reference's.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Answers {
    /// Number of episodes replayed.
    pub episodes: usize,
    /// Number of control steps of the longest episode.
    pub longest_episode: usize,
    /// Number of control steps in all episodes.
    pub steps: usize,
    /// Number of steps with the same plan in force, whose actions were compared.
    pub compared_steps: usize,
    /// Largest absolute difference of an action element in the compared steps.
    pub largest_action_difference: f64,
    /// Allowed difference of an action element.
    pub action_tolerance: f64,
    /// Number of the reference's decisions in the compared episodes; none where it selects nothing, or says nothing about what it selects.
    pub decisions: usize,
    /// Number of decisions whose logits were compared.
    pub compared_decisions: usize,
    /// Largest difference of a logit in the compared decisions, up to a constant added to all of a decision's.
    pub largest_logit_difference: f64,
    /// Allowed difference of a logit; `None` where what the logits decide is judged instead ([`Rounding`](crate::rounding::Rounding)).
    pub logit_tolerance: Option<f64>,
    /// Number of decisions that differ within rounding.
    pub close_calls: usize,
    /// Number of steps whose plan was compared as a vector.
    pub compared_plan_vectors: usize,
    /// Largest difference of an element of a plan in these steps.
    pub largest_plan_difference: f64,
    /// Allowed difference of an element of a plan.
    pub plan_tolerance: f64,
    /// Number of segments whose encoding by the trajectory encoder was compared.
    pub compared_segments: usize,
    /// Number of compared segments that were encoded as another plan.
    pub differing_segments: usize,
    /// Whether the plans are the reference's in another order.
    pub renumbered: bool,
    /// Number of episodes with any difference beyond the tolerances.
    pub differing_episodes: usize,
    /// First difference beyond the tolerances.
    pub first_difference: Option<Answer>,
    /// Whether plans are vectors that the reference does not record.
    #[serde(skip)]
    pub(crate) unrecorded_plan_vectors: bool,
    /// Largest reference margin at which a decision whose logits are known may differ: two logits may be off.
    #[serde(skip)]
    pub(crate) close_call: f64,
}

impl Answers {
    /// Judges replays; `stated_tolerance` is the bundle's own for an action element.
    pub fn judge(
        reference: &Reference,
        replays: &[Replay],
        stated_tolerance: Option<f64>,
    ) -> (Self, Numbering) {
        let mut answers = Self::bounded(reference, stated_tolerance);
        let tolerance = logit_tolerance(reference);
        answers.logit_tolerance = Some(tolerance);
        let traced = traced(reference, replays);
        let numbering = Numbering::of(
            traced.iter().flat_map(Traced::decisions),
            tolerance,
            answers.close_call,
        );
        (answers.all(&traced, &numbering), numbering)
    }

    /// Judges the replays of an image with fewer bits than 32, given the numbering of plans that its answers with 32 bits have shown. Logits are
    /// measured, not bounded; what they decide is judged.
    pub fn judge_rounded(
        reference: &Reference,
        replays: &[Replay],
        stated_tolerance: Option<f64>,
        numbering: &Numbering,
    ) -> Self {
        let answers = Self::bounded(reference, stated_tolerance);
        answers.all(&traced(reference, replays), numbering)
    }

    /// Nothing yet, and what may be off.
    fn bounded(reference: &Reference, stated_tolerance: Option<f64>) -> Self {
        let noise = reference.float_noise.unwrap_or_default();
        let stated = stated_tolerance
            .unwrap_or(ACTION_TOLERANCE)
            .min(ACTION_TOLERANCE);
        Self {
            action_tolerance: stated.max(NOISE_FACTOR * noise.action),
            plan_tolerance: PLAN_TOLERANCE.max(NOISE_FACTOR * noise.plan_vector),
            close_call: 2.0 * logit_tolerance(reference),
            ..Self::default()
        }
    }

    fn all(mut self, traced: &[Traced<'_>], numbering: &Numbering) -> Self {
        self.renumbered = numbering.is_another();
        for episode in traced {
            self.episodes += 1;
            self.decisions += episode.decided_at.len();
            self.longest_episode = self.longest_episode.max(episode.replay.replies.len());
            let Some((step, what)) = episode.judge(numbering, &mut self) else {
                continue;
            };
            self.differing_episodes += 1;
            self.first_difference.get_or_insert(Answer {
                instruction: episode.instruction.to_owned(),
                episode: episode.replay.episode,
                step,
                what,
            });
        }
        self
    }

    /// Largest reference margin at which a decision may differ.
    fn close_call(&self, decision: &Decision<'_>) -> f64 {
        if decision.reference_logits.is_empty() {
            CLOSE_CALL
        } else {
            self.close_call
        }
    }
}

/// Allowed difference of a logit.
fn logit_tolerance(reference: &Reference) -> f64 {
    let noise = reference.float_noise.unwrap_or_default();
    LOGIT_TOLERANCE.max(NOISE_FACTOR * noise.logit)
}

/// Lists the replays of which the reference has a trace.
fn traced<'t>(reference: &'t Reference, replays: &'t [Replay]) -> Vec<Traced<'t>> {
    let replays = replays.iter();
    replays
        .filter_map(|replay| Traced::of(reference, replay))
        .collect()
}

/// One decision of both policies.
#[derive(Debug, Clone, Copy)]
pub struct Decision<'d> {
    /// Plan that the policy decided.
    pub plan: u32,
    /// Plan that the reference decided.
    pub reference: u32,
    /// Margin of the reference's decision.
    pub margin: f64,
    /// Logits of the policy.
    pub logits: &'d [f32],
    /// Logits of the reference; empty where it recorded none.
    pub reference_logits: &'d [f32],
}

/// A replay with its trace.
struct Traced<'t> {
    instruction: &'t str,
    episode: &'t Episode,
    trace: &'t Trace,
    replay: &'t Replay,
    /// Control steps at which the reference decided.
    decided_at: Vec<usize>,
}

impl<'t> Traced<'t> {
    fn of(reference: &'t Reference, replay: &'t Replay) -> Option<Self> {
        let instruction = reference.instructions.get(replay.instruction)?;
        let episode = instruction.episodes.get(replay.episode)?;
        Some(Self {
            instruction: &instruction.id,
            episode,
            trace: episode.trace.as_ref()?,
            replay,
            decided_at: reference.decided_at(episode),
        })
    }

    fn decision(&self, number: usize, reply: &'t Reply) -> Option<Decision<'t>> {
        Some(Decision {
            plan: reply.plan?,
            reference: *self.episode.plans.get(number)?,
            margin: *self.episode.margins.get(number)?,
            logits: &reply.logits,
            reference_logits: self.trace.logits_of(number, self.decided_at.len()),
        })
    }

    /// Pairs the decisions of the same steps.
    fn decisions(&self) -> impl Iterator<Item = Decision<'t>> {
        self.decided_at
            .iter()
            .enumerate()
            .filter_map(|(number, &step)| {
                let reply = self
                    .replay
                    .replies
                    .get(step)
                    .filter(|reply| reply.decided)?;
                self.decision(number, reply)
            })
    }

    /// Returns the first difference; measures everything all the same.
    fn judge(&self, numbering: &Numbering, answers: &mut Answers) -> Option<(usize, String)> {
        let mut first = None;
        let mut found = |step: usize, what: Option<String>| {
            if let Some(what) = what {
                first.get_or_insert((step, what));
            }
        };
        let steps = self.episode.steps.max(1);
        let done = self
            .trace
            .actions
            .chunks_exact((self.trace.actions.len() / steps).max(1));
        let len = (self.trace.plan_vectors.len() / steps).max(1);
        let mut vectors = self.trace.plan_vectors.chunks_exact(len);
        let mut numbers = self.decided_at.iter().copied().enumerate().peekable();
        let mut same_plan = true;
        for (step, (reply, done)) in self.replay.replies.iter().zip(done).enumerate() {
            answers.steps += 1;
            let number = numbers
                .next_if(|&(_, at)| at == step)
                .map(|(number, _)| number);
            match number
                .filter(|_| reply.decided)
                .and_then(|number| self.decision(number, reply))
            {
                Some(decision) => {
                    same_plan = decision.plan == numbering.of_run(decision.reference);
                    found(step, answers.logits(&decision, numbering));
                    found(step, answers.plan(&decision, same_plan));
                }
                None if number.is_some() => {
                    found(
                        step,
                        Some("the policy keeps its plan where the reference decides".to_owned()),
                    );
                }
                None if reply.decided => {
                    found(
                        step,
                        Some("the policy decides where the reference keeps its plan".to_owned()),
                    );
                }
                None => {}
            }
            match vectors.next() {
                Some(reference) => found(step, answers.plan_vector(&reply.plan_vector, reference)),
                None if reply.plan.is_none() && !reply.plan_vector.is_empty() => {
                    answers.unrecorded_plan_vectors = true;
                }
                None => {}
            }
            if same_plan {
                found(step, answers.action(&reply.action, done));
            }
        }
        if let Some(why) = &self.replay.refused {
            found(self.replay.replies.len(), Some(why.clone()));
        }
        found(0, self.encoded(numbering, answers));
        first
    }

    fn encoded(&self, numbering: &Numbering, answers: &mut Answers) -> Option<String> {
        let (ours, theirs) = (self.replay.encoded.as_ref()?, self.trace.encoded.as_ref()?);
        let missing = theirs.len().saturating_sub(ours.len());
        answers.compared_segments += missing;
        answers.differing_segments += missing;
        let mut first = (ours.len() != theirs.len()).then(|| {
            let (ours, theirs) = (ours.len(), theirs.len());
            format!("the trajectory encoder sees a plan in {ours} of {theirs} segments")
        });
        let margins = self
            .trace
            .encoded_margins
            .iter()
            .flatten()
            .copied()
            .chain(std::iter::repeat(f64::INFINITY));
        for (segment, ((&plan, &reference), margin)) in
            ours.iter().zip(theirs).zip(margins).enumerate()
        {
            answers.compared_segments += 1;
            if plan != numbering.of_run(reference) && margin > ENCODER_CLOSE_CALL {
                answers.differing_segments += 1;
                first.get_or_insert_with(|| {
                    format!("the trajectory encoder sees plan {plan} in segment {segment}, the reference's {reference}")
                });
            }
        }
        first
    }
}

impl Answers {
    fn logits(&mut self, decision: &Decision<'_>, numbering: &Numbering) -> Option<String> {
        let Decision {
            logits,
            reference_logits,
            ..
        } = *decision;
        if reference_logits.is_empty() {
            return None;
        }
        if logits.len() != reference_logits.len() {
            let (ours, theirs) = (logits.len(), reference_logits.len());
            return Some(format!(
                "the policy has {ours} logits, the reference {theirs}"
            ));
        }
        self.compared_decisions += 1;
        let difference =
            largest_up_to_a_constant((0..).zip(reference_logits).map(|(plan, &theirs)| {
                let ours = logits
                    .get(numbering.of_run(plan) as usize)
                    .copied()
                    .unwrap_or(f32::NAN);
                f64::from(ours) - f64::from(theirs)
            }));
        self.largest_logit_difference = self.largest_logit_difference.max(difference);
        let tolerance = self.logit_tolerance?;
        (difference > tolerance)
            .then(|| format!("a logit is off by {difference:.1e}, allowed {tolerance:.1e}"))
    }

    fn plan(&mut self, decision: &Decision<'_>, same: bool) -> Option<String> {
        let Decision {
            plan,
            reference,
            margin,
            ..
        } = *decision;
        if same {
            return None;
        }
        if margin <= self.close_call(decision) {
            self.close_calls += 1;
            return None;
        }
        Some(format!(
            "plan {plan}, the reference's is {reference} by a margin of {margin:.4}"
        ))
    }

    fn plan_vector(&mut self, plan: &[f32], reference: &[f32]) -> Option<String> {
        self.compared_plan_vectors += 1;
        if plan.len() != reference.len() {
            let (ours, theirs) = (plan.len(), reference.len());
            return Some(format!(
                "the policy's plan has {ours} elements, the reference's {theirs}"
            ));
        }
        let differences = plan.iter().zip(reference);
        let differences = differences.map(|(ours, theirs)| f64::from((ours - theirs).abs()));
        // No difference is NaN below: what is no number counts as infinitely far.
        let finite = differences.map(|it| if it.is_nan() { f64::INFINITY } else { it });
        let difference = finite.fold(0.0, f64::max);
        self.largest_plan_difference = self.largest_plan_difference.max(difference);
        let tolerance = self.plan_tolerance;
        (difference > tolerance).then(|| {
            format!("an element of the plan is off by {difference:.1e}, allowed {tolerance:.1e}")
        })
    }

    fn action(&mut self, action: &[f32], done: &[f32]) -> Option<String> {
        self.compared_steps += 1;
        let mut first = None;
        for (index, (&ours, &theirs)) in action.iter().zip(done).enumerate() {
            let difference = f64::from((ours - theirs).abs());
            self.largest_action_difference = self.largest_action_difference.max(difference);
            if difference > self.action_tolerance || difference.is_nan() {
                first.get_or_insert_with(|| {
                    format!("action element {index} is {ours}, the reference's is {theirs}")
                });
            }
        }
        first
    }
}

/// Largest of differences, once the constant is subtracted that makes it smallest; infinite if one is NaN.
pub fn largest_up_to_a_constant(differences: impl Iterator<Item = f64>) -> f64 {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for difference in differences {
        if !difference.is_finite() {
            return f64::INFINITY;
        }
        low = low.min(difference);
        high = high.max(difference);
    }
    ((high - low) / 2.0).max(0.0)
}
