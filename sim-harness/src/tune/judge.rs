//! Judges whether a policy stored with fewer bits still answers as with 32.
//!
//! What only helps to select an index must select the same one in every decision, its logits must be twice as near as a certificate wants them,
//! and nearly all decisions must be clear by more than the logits are off: the questions are a sample, and a decision that was a close call
//! elsewhere may fall out otherwise. What is in the
//! action must stay inside the contract's tolerance, and a trajectory encoder must see the same plan in every segment: how near it was to
//! another is not known. Nothing here can fail.

use std::fmt;

use lads_compiler::Evidence;
use lads_proof::answers::{LOGIT_TOLERANCE, Replay, largest_up_to_a_constant};

/// Factor of a clear decision: its margin is more than this many times the largest difference of a logit, as two logits may be off.
pub const MARGIN_FACTOR: f64 = 2.0;

/// Largest allowed difference of a logit: half of what a certificate allows, as its episodes are others.
pub const LOGIT_BOUND: f64 = LOGIT_TOLERANCE / 2.0;

/// Smallest share of decisions that have to be clear: of a hundred, at most one may depend on the rounding.
pub const CLEAR_SHARE: f64 = 0.99;

/// Why a candidate is not the same policy.
#[derive(Debug, Clone, PartialEq)]
pub enum Loss {
    /// The candidate does not compile, fails the golden episode or refuses a question.
    Refused(String),
    /// Some decisions selected another index.
    Selected {
        /// Number of decisions that selected another index.
        changed: usize,
        /// Largest margin, with 32 bits, among the decisions that selected another index.
        margin: f64,
    },
    /// A logit differs by more than [`LOGIT_BOUND`].
    Logit {
        /// Largest difference of a logit.
        difference: f64,
    },
    /// Every decision is the same, but too many are close calls.
    Unclear {
        /// Share of decisions that are clear.
        share: f64,
        /// Largest difference of a logit.
        logit: f64,
    },
    /// An action differs by more than its tolerance.
    Action {
        /// Largest difference of an action's element.
        difference: f64,
        /// Allowed difference of an action's element.
        tolerance: f64,
    },
    /// The trajectory encoder sees other plans.
    Encoded {
        /// Number of segments with another plan.
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
            Self::Logit { difference } => write!(
                f,
                "a logit is off by {difference:.1e}, allowed {LOGIT_BOUND:.1e}"
            ),
            Self::Unclear { share, logit } => write!(
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

/// Comparison of a candidate's answers with those of 32 bits.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Judged {
    /// Measured differences; the caller adds which file they are of.
    pub evidence: Evidence,
    /// Why the candidate is not the same policy; `None` if it is.
    pub loss: Option<Loss>,
}

impl Judged {
    /// Result of a candidate that could not be asked.
    pub fn refused(why: String) -> Self {
        Self {
            evidence: Evidence {
                largest_logit_error: f64::INFINITY,
                largest_action_error: f64::INFINITY,
                ..Evidence::default()
            },
            loss: Some(Loss::Refused(why)),
        }
    }

    /// Whether the candidate is the same policy.
    pub fn is_same(&self) -> bool {
        self.loss.is_none()
    }
}

/// Compares the answers of a candidate with those of the same policy with 32 bits; `tolerance` is the allowed difference of an action's
/// element.
pub fn judge(exact: &[Replay], candidate: &[Replay], tolerance: f64) -> Judged {
    let mut seen = Evidence {
        episodes: exact.len(),
        margin_factor: MARGIN_FACTOR,
        action_tolerance: tolerance,
        ..Evidence::default()
    };
    let mut margins = vec![];
    let (mut changed, mut largest_changed) = (0, 0.0_f64);
    let (mut refused, mut encoded) = (None, 0);
    for (wanted, got) in exact.iter().zip(candidate) {
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
            seen.largest_action_error = seen.largest_action_error.max(action);
            if !wanted.decided {
                continue;
            }
            seen.decisions += 1;
            let margin = wanted.margin.map(f64::from);
            margins.extend(margin);
            let logits = wanted.logits.iter().zip(&got.logits);
            let logit = largest_up_to_a_constant(
                logits.map(|(&wanted, &got)| f64::from(got) - f64::from(wanted)),
            );
            seen.largest_logit_error = seen.largest_logit_error.max(logit);
            if (wanted.plan, true) != (got.plan, got.decided) {
                changed += 1;
                largest_changed = largest_changed.max(margin.unwrap_or(f64::INFINITY));
            }
        }
    }
    let clear = MARGIN_FACTOR * seen.largest_logit_error;
    let clear = margins.iter().filter(|&&margin| margin > clear).count();
    seen.clear_share = clear as f64 / margins.len().max(1) as f64;
    seen.smallest_margin = margins.iter().copied().reduce(f64::min);
    let loss = if let Some(why) = refused {
        Some(Loss::Refused(why))
    } else if changed > 0 {
        Some(Loss::Selected {
            changed,
            margin: largest_changed,
        })
    } else if seen.largest_logit_error > LOGIT_BOUND {
        Some(Loss::Logit {
            difference: seen.largest_logit_error,
        })
    } else if !margins.is_empty() && seen.clear_share < CLEAR_SHARE {
        Some(Loss::Unclear {
            share: seen.clear_share,
            logit: seen.largest_logit_error,
        })
    } else if encoded > 0 {
        Some(Loss::Encoded { changed: encoded })
    } else if seen.largest_action_error > tolerance {
        Some(Loss::Action {
            difference: seen.largest_action_error,
            tolerance,
        })
    } else {
        None
    };
    Judged {
        evidence: seen,
        loss,
    }
}

/// Largest difference of an element; infinite if one is NaN.
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

#[cfg(test)]
mod tests {
    use lads_proof::answers::Reply;

    use super::*;

    fn reply(plan: u32, logits: &[f32], margin: Option<f32>, action: f32) -> Reply {
        Reply {
            decided: !logits.is_empty(),
            plan: Some(plan),
            logits: logits.to_vec(),
            margin,
            action: vec![action],
        }
    }

    fn replay(replies: Vec<Reply>) -> Vec<Replay> {
        vec![Replay {
            replies,
            ..Replay::default()
        }]
    }

    fn exact() -> Vec<Replay> {
        replay(vec![
            reply(1, &[0.0, 2.0, 1.0], Some(1.0), 0.5),
            reply(1, &[], None, 0.5),
            reply(2, &[0.0, 0.0, 0.5], Some(0.5), 0.25),
        ])
    }

    fn altered(change: impl Fn(&mut Vec<Reply>)) -> Judged {
        let mut other = exact();
        change(&mut other[0].replies);
        judge(&exact(), &other, 1e-3)
    }

    #[test]
    fn itself_is_the_same() {
        let judged = altered(|_| {});
        assert!(judged.is_same());
        let seen = judged.evidence;
        assert_eq!((seen.episodes, seen.steps, seen.decisions), (1, 3, 2));
        assert_eq!(seen.smallest_margin, Some(0.5));
        assert_eq!((seen.clear_share, seen.largest_logit_error), (1.0, 0.0));
    }

    #[test]
    fn a_constant_on_all_logits_is_no_difference() {
        let judged = altered(|replies| replies[0].logits = vec![3.0, 5.0, 4.0]);
        assert!(judged.is_same());
        assert!(judged.evidence.largest_logit_error < 1e-12);
    }

    #[test]
    fn another_index_is_a_loss_with_its_margin() {
        let judged = altered(|replies| replies[2].plan = Some(0));
        let wanted = Loss::Selected {
            changed: 1,
            margin: 0.5,
        };
        assert_eq!(judged.loss, Some(wanted));
    }

    #[test]
    fn close_calls_are_a_loss() {
        // Off by 0.004: a margin of 0.007 is within twice that, one of 0.5 is not.
        let mut close = exact();
        close[0].replies[0].margin = Some(0.007);
        let mut other = close.clone();
        other[0].replies[0].logits = vec![-0.004, 2.004, 1.0];
        let judged = judge(&close, &other, 1e-3);
        let Some(Loss::Unclear { share, logit }) = judged.loss else {
            panic!("{judged:?}");
        };
        assert!((share - 0.5).abs() < 1e-9 && (logit - 0.004).abs() < 1e-6);
    }

    #[test]
    fn logits_are_nearer_than_a_certificate_wants_them() {
        let judged = altered(|replies| replies[0].logits = vec![-0.3, 2.3, 1.0]);
        let Some(Loss::Logit { difference }) = judged.loss else {
            panic!("{judged:?}");
        };
        assert!((difference - 0.3).abs() < 1e-6);
    }

    #[test]
    fn actions_keep_the_tolerance() {
        assert!(altered(|replies| replies[1].action = vec![0.5005]).is_same());
        for off in [0.502, f32::NAN] {
            let judged = altered(|replies| replies[1].action = vec![off]);
            assert!(matches!(judged.loss, Some(Loss::Action { .. })), "{off}");
        }
    }

    #[test]
    fn what_the_trajectory_encoder_sees_counts() {
        let with = |plans: &[u32]| {
            let mut replays = exact();
            replays[0].encoded = Some(plans.to_vec());
            replays
        };
        assert!(judge(&with(&[1, 2]), &with(&[1, 2]), 1e-3).is_same());
        let judged = judge(&with(&[1, 2]), &with(&[1, 3]), 1e-3);
        assert_eq!(judged.loss, Some(Loss::Encoded { changed: 1 }));
        assert_eq!(judged.evidence.segments, 2);
        // One that refuses a segment has seen none of them.
        let judged = judge(&with(&[1, 2]), &exact(), 1e-3);
        assert_eq!(judged.loss, Some(Loss::Encoded { changed: 2 }));
    }
}
