//! Is a policy whose numbers have fewer bits still the one with 32?
//!
//! Both answer the same questions, so that they differ by rounding alone: another checkpoint, other words or another normaliser of the bundle are in both,
//! and it is the answers with 32 bits that a reference bounds ([`Answers`], logits by their values). Rounding is judged by what it decides. A logit
//! that only helps to select the largest reaches the action through the index: every decision must select the same one, and nearly all must be clear by
//! more than the logits are off, because the questions are a sample, and a decision that was a close call elsewhere may fall out otherwise. What is
//! in the action must stay inside its tolerance, and a trajectory encoder must see the same plan in every segment: how near it was to another
//! does not count. `tune` chooses formats by this rule, and a certificate judges an image by it. Nothing here can fail.

use std::fmt;

use serde::{Serialize, Serializer};
use statrs::distribution::{Binomial, DiscreteCDF as _};

use crate::answers::{Answers, Replay, largest_up_to_a_constant};
use crate::numbering::Numbering;
use crate::reference::Reference;

/// A decision is clear if its margin is more than so many times the largest difference of a logit: two logits may be off.
pub const MARGIN_FACTOR: f64 = 2.0;

/// Share of decisions that have to be clear: at worst, one of a hundred may depend on the rounding.
pub const CLEAR_SHARE: f64 = 0.99;

/// Probability of finding too many unclear decisions when their share is as large as allowed.
const UNCLEAR: f64 = 0.01;

/// Reason why an image with fewer bits is another policy than with 32.
#[derive(Debug, Clone, PartialEq)]
pub enum Loss {
    /// The image does not compile, fails the golden episode or refuses a question.
    Refused(String),
    /// Decisions selected another index.
    Selected {
        /// Number of decisions that changed.
        changed: usize,
        /// Largest margin, with 32 bits, of a decision that changed.
        margin: f64,
    },
    /// A logit differs by more than its tolerance.
    Logit {
        /// Largest difference of a logit.
        difference: f64,
        /// Largest difference that is allowed.
        tolerance: f64,
    },
    /// Every decision is the same, and too many are close calls.
    Unclear {
        /// Share of the decisions that are clear.
        share: f64,
        /// Largest difference of a logit.
        logit: f64,
        /// Whether the decisions are enough to say so, and not a few with one close call by chance.
        shown: bool,
    },
    /// An action element differs by more than its tolerance.
    Action {
        /// Largest difference of an action element.
        difference: f64,
        /// Largest difference that is allowed.
        tolerance: f64,
    },
    /// The trajectory encoder sees other plans.
    Encoded {
        /// Number of segments that are encoded as another plan.
        changed: usize,
    },
}

impl fmt::Display for Loss {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Refused(why) => f.write_str(why),
            Self::Selected { changed, margin } => write!(
                f,
                "{changed} decisions fall out otherwise, one with a margin of {margin:.1e}"
            ),
            Self::Logit {
                difference,
                tolerance,
            } => write!(
                f,
                "a logit is off by {difference:.1e}, allowed {tolerance:.1e}"
            ),
            Self::Unclear { share, logit, .. } => write!(
                f,
                "only {:.1} % of the decisions are clear by {MARGIN_FACTOR} times the logits' {logit:.1e}",
                100.0 * share
            ),
            Self::Action {
                difference,
                tolerance,
            } => write!(
                f,
                "an action is off by {difference:.1e}, allowed {tolerance:.1e}"
            ),
            Self::Encoded { changed } => {
                write!(
                    f,
                    "the trajectory encoder sees {changed} segments otherwise"
                )
            }
        }
    }
}

impl Loss {
    /// Returns whether the questions are enough to call the image another policy.
    fn is_shown(&self) -> bool {
        !matches!(self, Self::Unclear { shown: false, .. })
    }
}

impl Serialize for Loss {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// Comparison of a policy's answers with fewer bits and with 32.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Rounding {
    /// Number of episodes that were replayed.
    pub episodes: usize,
    /// Number of control steps of the replayed episodes.
    pub steps: usize,
    /// Number of decisions in the replayed episodes.
    pub decisions: usize,
    /// The smallest lead of a selected index over the second best, with 32 bits; `None` where no decision has two logits.
    pub smallest_margin: Option<f64>,
    /// Largest difference of a logit, up to a constant added to all of a decision's.
    pub largest_logit_difference: f64,
    /// Share of the decisions with two logits or more whose margin is more than `margin_factor` times the largest difference of a logit; 1 without such
    /// decisions.
    pub clear_share: f64,
    /// Factor on the largest difference of a logit beyond which a margin is clear.
    pub margin_factor: f64,
    /// Number of segments that the trajectory encoder saw.
    pub segments: usize,
    /// Largest difference of an action's element.
    pub largest_action_difference: f64,
    /// Largest difference of an action element that is allowed.
    pub action_tolerance: f64,
    /// Reason why fewer bits make another policy, in words; `None` if it is the same.
    pub loss: Option<Loss>,
}

/// Differences that are allowed between fewer bits and 32.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Allowed {
    /// Largest difference of an action element.
    pub action: f64,
    /// Largest difference of a logit, where its value matters, as for a draw; `None` where the largest logit is selected.
    pub logit: Option<f64>,
}

impl Rounding {
    /// Compares the answers with fewer bits to those of the same policy with 32.
    pub fn judge(exact: &[Replay], rounded: &[Replay], allowed: Allowed) -> Self {
        let mut seen = Self {
            episodes: exact.len(),
            margin_factor: MARGIN_FACTOR,
            action_tolerance: allowed.action,
            clear_share: 1.0,
            ..Self::default()
        };
        let mut margins = vec![];
        let (mut changed, mut largest_changed) = (0, 0.0_f64);
        let (mut refused, mut encoded) = (None, 0);
        for (wanted, got) in exact.iter().zip(rounded) {
            if let Some(why) = &got.refused {
                refused.get_or_insert_with(|| why.clone());
            }
            let segments = wanted.encoded.as_deref().unwrap_or_default();
            seen.segments += segments.len();
            encoded += match &got.encoded {
                Some(got) if got.len() == segments.len() => segments
                    .iter()
                    .zip(got)
                    .filter(|(wanted, got)| wanted != got)
                    .count(),
                // An encoder that refuses a segment stops there.
                _ => segments.len(),
            };
            for (wanted, got) in wanted.replies.iter().zip(&got.replies) {
                seen.steps += 1;
                let action = largest(&wanted.action, &got.action);
                seen.largest_action_difference = seen.largest_action_difference.max(action);
                if !wanted.decided && !got.decided {
                    continue;
                }
                seen.decisions += 1;
                let margin = wanted.margin.map(f64::from);
                margins.extend(margin);
                let logits = wanted.logits.iter().zip(&got.logits);
                let logit = largest_up_to_a_constant(
                    logits.map(|(&wanted, &got)| f64::from(got) - f64::from(wanted)),
                );
                seen.largest_logit_difference = seen.largest_logit_difference.max(logit);
                if (wanted.plan, wanted.decided) != (got.plan, got.decided) {
                    changed += 1;
                    largest_changed = largest_changed.max(margin.unwrap_or(f64::INFINITY));
                }
            }
        }
        let clear = MARGIN_FACTOR * seen.largest_logit_difference;
        let clear = margins.iter().filter(|&&margin| margin > clear).count();
        if !margins.is_empty() {
            seen.clear_share = clear as f64 / margins.len() as f64;
        }
        seen.smallest_margin = margins.iter().copied().reduce(f64::min);
        let too_far = allowed
            .logit
            .filter(|&tolerance| seen.largest_logit_difference > tolerance);
        seen.loss = if let Some(why) = refused {
            Some(Loss::Refused(why))
        } else if changed > 0 {
            Some(Loss::Selected {
                changed,
                margin: largest_changed,
            })
        } else if let Some(tolerance) = too_far {
            Some(Loss::Logit {
                difference: seen.largest_logit_difference,
                tolerance,
            })
        } else if encoded > 0 {
            Some(Loss::Encoded { changed: encoded })
        } else if seen.largest_action_difference > allowed.action {
            Some(Loss::Action {
                difference: seen.largest_action_difference,
                tolerance: allowed.action,
            })
        } else if !margins.is_empty() && seen.clear_share < CLEAR_SHARE {
            Some(Loss::Unclear {
                share: seen.clear_share,
                logit: seen.largest_logit_difference,
                shown: too_many(margins.len() - clear, margins.len()),
            })
        } else {
            None
        };
        seen
    }

    /// A policy that was not asked at all.
    pub fn refused(why: String) -> Self {
        Self {
            largest_logit_difference: f64::INFINITY,
            largest_action_difference: f64::INFINITY,
            loss: Some(Loss::Refused(why)),
            ..Self::default()
        }
    }

    /// Whether it is the same policy.
    pub fn is_same(&self) -> bool {
        self.loss.is_none()
    }
}

/// Whether so many unclear decisions are more than chance makes of the share that may be.
fn too_many(unclear: usize, decisions: usize) -> bool {
    let by_chance = Binomial::new(1.0 - CLEAR_SHARE, decisions as u64);
    by_chance.is_ok_and(|by_chance| by_chance.sf((unclear as u64).saturating_sub(1)) < UNCLEAR)
}

/// The largest difference of an element; infinite where one is no number.
fn largest(wanted: &[f32], got: &[f32]) -> f64 {
    wanted.iter().zip(got).fold(0.0, |largest, (a, b)| {
        let difference = f64::from((a - b).abs());
        if difference.is_nan() {
            f64::INFINITY
        } else {
            largest.max(difference)
        }
    })
}

/// Answers of the policy alone to a reference's questions: those of the image and, if it has fewer bits than 32, those with 32.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Asked {
    /// Answers of the image that runs, compared with the reference.
    pub policy: Answers,
    /// Answers of the bundle with 32 bits, compared with the reference; `None` if the image that runs has 32 bits.
    pub exact: Option<Answers>,
    /// Comparison of the image with the bundle with 32 bits; `None` if the image has 32 bits.
    pub rounding: Option<Rounding>,
}

impl Asked {
    /// Judges the replays of an image and, if its numbers have fewer bits and it selects the largest logit, those of the same bundle with 32;
    /// `stated_tolerance` is the bundle's own for an action element. Without the latter the logits' values are bounded, whatever the image.
    pub fn judge(
        reference: &Reference,
        replays: &[Replay],
        exact: Option<&[Replay]>,
        stated_tolerance: Option<f64>,
    ) -> (Self, Numbering) {
        let Some(exact) = exact else {
            let (policy, numbering) = Answers::judge(reference, replays, stated_tolerance);
            let asked = Self {
                policy,
                ..Self::default()
            };
            return (asked, numbering);
        };
        let (answers, numbering) = Answers::judge(reference, exact, stated_tolerance);
        let policy = Answers::judge_rounded(reference, replays, stated_tolerance, &numbering);
        let allowed = Allowed {
            action: answers.action_tolerance,
            logit: None,
        };
        let asked = Self {
            policy,
            exact: Some(answers),
            rounding: Some(Rounding::judge(exact, replays, allowed)),
        };
        (asked, numbering)
    }

    fn loss(&self) -> Option<&Loss> {
        self.rounding.as_ref()?.loss.as_ref()
    }

    /// Returns what the decisions are too few to tell, if there is such a thing.
    pub fn undecided(&self) -> Option<String> {
        let loss = self.loss().filter(|loss| !loss.is_shown())?;
        Some(format!(
            "whether fewer bits make another policy of it: {loss}, which is not shown to be too few; all instructions and traced episodes of the reference, or a reference with more of them, would"
        ))
    }

    /// Lists why the image is another policy than the reference's, a sentence for each reason.
    pub fn differences(&self) -> Vec<String> {
        let beside = |answers: &Answers, which: &str| {
            let answer = answers.first_difference.as_ref()?;
            Some(format!(
                "the policy{which} answers otherwise in {} of {} replayed episodes, first in {answer}",
                answers.differing_episodes, answers.episodes
            ))
        };
        let exact = self.exact.as_ref();
        let loss = self.loss().filter(|loss| loss.is_shown());
        let found = [
            beside(&self.policy, ""),
            exact.and_then(|answers| beside(answers, " with 32 bits")),
            loss.map(|why| format!("with fewer bits it is not the same policy as with 32: {why}")),
        ];
        found.into_iter().flatten().collect()
    }
}

#[cfg(test)]
mod tests;
