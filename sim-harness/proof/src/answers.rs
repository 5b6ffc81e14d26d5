//! Is it the same policy? What it answered to the reference's questions, judged.
//!
//! Open loop: at each control step of a traced episode the policy got the observation that the reference saw, and its history held the
//! actions that the reference executed. So a difference is the policy's own, however chaotic the physics. Judged are the steps that decide, the
//! logits up to a constant (adding one to all of them changes no probability), the plans, the actions while the same plan is in force, and what the
//! trajectory encoder sees. Where two plans are equally likely, rounding may pick either: a decision whose margin in the reference is
//! at most twice the logits' tolerance may fall out otherwise. Plans that are numbered otherwise throughout are the same plans: that is said and no
//! difference. Nothing here can fail.

use std::fmt;

use serde::Serialize;

use crate::numbering::Numbering;
use crate::reference::{Episode, Reference, Trace};

/// Difference of a logit that is allowed: one percent of a probability at most. Logits of the shipped policies agree with PyTorch's to 1e-5, and to
/// 1e-2 with weights of 16 bits.
pub const LOGIT_TOLERANCE: f64 = 1e-2;

/// Margin of a decision that may fall out otherwise where the reference recorded no logits to judge instead.
pub const CLOSE_CALL: f64 = 1e-3;

/// Largest difference of an action element that is allowed, whatever tolerance a bundle states: what is judged does not set the bar.
pub const ACTION_TOLERANCE: f64 = 1e-4;

/// So many times the reference's own float noise is allowed too: what noise of a size does is not the same each time.
pub const NOISE_FACTOR: f64 = 2.0;

/// A segment whose nearest two codes are as near as this, in squared distance relative to the nearer, may be encoded as either.
pub const ENCODER_CLOSE_CALL: f64 = 1e-3;

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

/// What a policy answered at one control step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reply {
    /// Whether it decided a plan.
    pub decided: bool,
    /// The plan in force; `None` of a policy that selects none.
    pub plan: Option<u32>,
    /// The logits of a step that decided.
    pub logits: Vec<f32>,
    /// By how much the best of them leads the second one; `None` where there are not two.
    pub margin: Option<f32>,
    /// Its action.
    pub action: Vec<f32>,
}

/// The replay of one traced episode.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Replay {
    /// Index of the instruction.
    pub instruction: usize,
    /// Number of the episode.
    pub episode: usize,
    /// The replies in order; fewer than the trace's steps where the policy refused.
    pub replies: Vec<Reply>,
    /// Why it refused the next step, if it did.
    pub refused: Option<String>,
    /// The plan that its trajectory encoder sees in each segment of the reference's, fewer where it refused one; `None` if it has no encoder.
    pub encoded: Option<Vec<u32>>,
}

/// What came of asking.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Answers {
    /// Episodes replayed.
    pub episodes: usize,
    /// Control steps of the longest.
    pub longest_episode: usize,
    /// Control steps in them.
    pub steps: usize,
    /// Steps with the same plan in force, whose actions were compared.
    pub compared_steps: usize,
    /// Largest absolute difference of an action element in these.
    pub largest_action_difference: f64,
    /// What it may be.
    pub action_tolerance: f64,
    /// Decisions of the reference in them; none where it selects nothing, or says nothing about what it selects.
    pub decisions: usize,
    /// Decisions whose logits were compared.
    pub compared_decisions: usize,
    /// Largest difference of a logit in these, up to a constant added to all of a decision's.
    pub largest_logit_difference: f64,
    /// What it may be; `None` where what the logits decide is judged instead ([`Rounding`](crate::rounding::Rounding)).
    pub logit_tolerance: Option<f64>,
    /// Decisions that fell out otherwise within rounding.
    pub close_calls: usize,
    /// Segments whose encoding by the trajectory encoder was compared.
    pub compared_segments: usize,
    /// How many of these were encoded as another plan.
    pub differing_segments: usize,
    /// Whether the plans are the reference's in another order.
    pub renumbered: bool,
    /// Episodes with any difference beyond these bounds.
    pub differing_episodes: usize,
    /// The first difference.
    pub first_difference: Option<Answer>,
    /// The margin of a decision up to which it may fall out otherwise, if its logits are known: two logits may be off.
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

    /// The same of an image with fewer bits than 32, whose answers with 32 have shown how plans are numbered: its logits are measured, and what
    /// they decide is judged.
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

    /// The margin of a decision in the reference up to which it may fall out otherwise.
    fn close_call(&self, decision: &Decision<'_>) -> f64 {
        if decision.reference_logits.is_empty() {
            CLOSE_CALL
        } else {
            self.close_call
        }
    }
}

/// What a logit may be off by.
fn logit_tolerance(reference: &Reference) -> f64 {
    let noise = reference.float_noise.unwrap_or_default();
    LOGIT_TOLERANCE.max(NOISE_FACTOR * noise.logit)
}

/// The replays that the reference has a trace of.
fn traced<'t>(reference: &'t Reference, replays: &'t [Replay]) -> Vec<Traced<'t>> {
    let replays = replays.iter();
    replays
        .filter_map(|replay| Traced::of(reference, replay))
        .collect()
}

/// One decision in both.
#[derive(Debug, Clone, Copy)]
pub struct Decision<'d> {
    /// What the policy decided.
    pub plan: u32,
    /// What the reference did.
    pub reference: u32,
    /// By which margin.
    pub margin: f64,
    /// The policy's logits.
    pub logits: &'d [f32],
    /// The reference's; empty where it recorded none.
    pub reference_logits: &'d [f32],
}

/// A replay beside its trace.
struct Traced<'t> {
    instruction: &'t str,
    episode: &'t Episode,
    trace: &'t Trace,
    replay: &'t Replay,
    /// The control steps at which the reference decided.
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

    /// The decisions of the same steps.
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

    /// The first difference; everything is measured all the same.
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

/// The largest of differences once the constant is taken off that makes it smallest; infinite where one is no number.
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
