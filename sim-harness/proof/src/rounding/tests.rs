//! What rounding may do, and what makes another policy of it.

use super::*;
use crate::answers::Reply;

/// The largest logit is selected.
const SELECTS: Allowed = Allowed {
    action: 1e-3,
    logit: None,
};

fn reply(plan: u32, logits: &[f32], margin: Option<f32>, action: f32) -> Reply {
    Reply {
        decided: !logits.is_empty(),
        plan: Some(plan),
        logits: logits.to_vec(),
        plan_vector: Vec::new(),
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

fn altered(change: impl Fn(&mut Vec<Reply>)) -> Rounding {
    let mut other = exact();
    change(&mut other[0].replies);
    Rounding::judge(&exact(), &other, SELECTS)
}

#[test]
fn itself_is_the_same() {
    let seen = altered(|_| {});
    assert!(seen.is_same());
    assert_eq!((seen.episodes, seen.steps, seen.decisions), (1, 3, 2));
    assert_eq!(seen.smallest_margin, Some(0.5));
    assert_eq!(
        (seen.clear_share, seen.largest_logit_difference),
        (1.0, 0.0)
    );
}

#[test]
fn a_constant_on_all_logits_is_no_difference() {
    let judged = altered(|replies| replies[0].logits = vec![3.0, 5.0, 4.0]);
    assert!(judged.is_same());
    assert!(judged.largest_logit_difference < 1e-12);
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
    let judged = Rounding::judge(&close, &other, SELECTS);
    let Some(Loss::Unclear {
        share,
        logit,
        shown: false,
    }) = judged.loss
    else {
        panic!("{judged:?}");
    };
    assert!((share - 0.5).abs() < 1e-9 && (logit - 0.004).abs() < 1e-6);
}

/// A loss that is shown is not hidden by a share that is not.
#[test]
fn an_action_counts_beside_an_unclear_decision() {
    let mut close = exact();
    close[0].replies[0].margin = Some(0.007);
    let mut other = close.clone();
    other[0].replies[0].logits = vec![-0.004, 2.004, 1.0];
    other[0].replies[1].action = vec![0.6];
    let judged = Rounding::judge(&close, &other, SELECTS);
    assert!(
        matches!(judged.loss, Some(Loss::Action { .. })),
        "{judged:?}"
    );
}

/// Tests that logits which differ by 0.2, with a margin of 0.5, keep the index selected, but would change a draw.
#[test]
fn values_of_logits_matter_where_they_do_more_than_select() {
    let mut other = exact();
    other[0].replies[0].logits = vec![-0.2, 2.2, 1.0];
    let judged = Rounding::judge(&exact(), &other, SELECTS);
    assert!(judged.is_same() && (judged.largest_logit_difference - 0.2).abs() < 1e-6);
    let draws = Allowed {
        logit: Some(1e-2),
        ..SELECTS
    };
    let judged = Rounding::judge(&exact(), &other, draws);
    assert!(matches!(judged.loss, Some(Loss::Logit { tolerance, .. }) if tolerance == 1e-2));
}

/// All logits times ten select the same index: they are off by more than any margin.
#[test]
fn logits_of_another_scale_are_not_clear() {
    let judged = altered(|replies| {
        let logits = replies.iter_mut().flat_map(|reply| &mut reply.logits);
        logits.for_each(|logit| *logit *= 10.0);
    });
    assert!(matches!(
        judged.loss,
        Some(Loss::Unclear {
            share: 0.0,
            shown: true,
            ..
        })
    ));
    let judged = altered(|replies| replies[0].logits[2] = f32::NAN);
    assert!(matches!(judged.loss, Some(Loss::Unclear { .. })));
}

/// One of a hundred may be a close call: two of two hundred are no more, and of few decisions one says little.
#[test]
fn a_few_close_calls_are_not_shown_to_be_too_many() {
    assert!(!too_many(2, 200) && !too_many(1, 17) && !too_many(1, 2));
    assert!(!too_many(11, 854) && too_many(18, 854) && too_many(2, 2));
    let unclear = |shown| Asked {
        rounding: Some(Rounding {
            loss: Some(Loss::Unclear {
                share: 0.98,
                logit: 0.1,
                shown,
            }),
            ..Rounding::default()
        }),
        ..Asked::default()
    };
    let (few, enough) = (unclear(false), unclear(true));
    assert!(few.differences().is_empty() && few.undecided().is_some());
    assert!(enough.differences().len() == 1 && enough.undecided().is_none());
}

#[test]
fn a_decision_at_another_step_is_a_loss() {
    let judged = altered(|replies| replies[1].decided = true);
    assert!(matches!(
        judged.loss,
        Some(Loss::Selected { changed: 1, .. })
    ));
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
    assert!(Rounding::judge(&with(&[1, 2]), &with(&[1, 2]), SELECTS).is_same());
    let judged = Rounding::judge(&with(&[1, 2]), &with(&[1, 3]), SELECTS);
    assert_eq!(judged.loss, Some(Loss::Encoded { changed: 1 }));
    assert_eq!(judged.segments, 2);
    // One that refuses a segment has seen none of them.
    let judged = Rounding::judge(&with(&[1, 2]), &exact(), SELECTS);
    assert_eq!(judged.loss, Some(Loss::Encoded { changed: 2 }));
}
