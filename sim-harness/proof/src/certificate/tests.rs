//! Tests of the verdict's rules, one by one.

use super::super::answers::Answer;
use super::super::pairs::{N_RATE_MARGIN, NRatePair, RATE_MARGIN, RatePair};
use super::super::rounding::Loss;
use super::super::statistics::{Counts, Pairs};
use super::*;

/// Makes a verification of `n` episodes in which one sub-task was done in `both`, in the run only, and in the reference only.
fn certificate(n: usize, both: usize, run_only: usize, reference_only: usize) -> Certificate {
    let policy = Answers {
        episodes: 2,
        compared_steps: 9,
        decisions: 3,
        compared_decisions: 3,
        ..Answers::default()
    };
    let environment = Physics {
        states: 9,
        identical_bits: true,
        ..Physics::default()
    };
    judged(
        alone(policy),
        environment,
        [n, both, run_only, reference_only],
    )
}

/// An image with 32 bits.
fn alone(policy: Answers) -> Asked {
    Asked {
        policy,
        ..Asked::default()
    }
}

fn judged(asked: Asked, environment: Physics, outcome: [usize; 4]) -> Certificate {
    seeing(asked, (environment, None), outcome)
}

/// Makes the same of a policy with cameras.
fn seeing(asked: Asked, seen: (Physics, Option<Frames>), outcome: [usize; 4]) -> Certificate {
    let [n, both, run_only, reference_only] = outcome;
    let mut pairs = Pairs::default();
    let mut counts = Counts::default();
    for episode in 0..n {
        let run = episode < both + run_only;
        let reference = episode < both
            || (both + run_only..both + run_only + reference_only).contains(&episode);
        pairs.add(run, reference);
        counts.add(usize::from(run), usize::from(reference), 1);
    }
    let [run, reference] = counts.means();
    let rollouts = Paired {
        episodes: n,
        identical_completions: 1.0 - (run_only + reference_only) as f64 / n as f64,
        identical_steps: 1.0,
        identical_plans: 1.0,
        same_final_state: 1.0,
        median_first_plan_difference: None,
        earliest_plan_difference: None,
        largest_action_difference: 0.0,
        agreeing_steps: [9, 9],
        n_rate: NRatePair {
            run,
            reference,
            paired: counts.paired(N_RATE_MARGIN),
            unpaired: counts.unpaired(N_RATE_MARGIN),
        },
        rates: vec![RatePair {
            name: "kettle".to_owned(),
            pairs,
            mcnemar_p: pairs.mcnemar(),
            paired: pairs.paired(RATE_MARGIN),
            unpaired: pairs.unpaired(RATE_MARGIN),
        }],
    };
    let setting = Setting {
        environment: "tiny-bench".to_owned(),
        bundle_sha256: String::new(),
        image_sha256: String::new(),
        image_stored: String::new(),
        decision: "argmax".to_owned(),
        isa: "portable".to_owned(),
        seed: 0,
        noise: "none".to_owned(),
        episodes_per_instruction: n as u32,
        instructions: 1,
        versions: BTreeMap::new(),
    };
    let used = ReferenceUsed {
        bundle_sha256: String::new(),
        same_bundle: true,
        weights_from: "the run's checkpoint".to_owned(),
        words_from: String::new(),
        logits_from: None,
        versions: BTreeMap::new(),
    };
    let contract = Compared {
        fields: vec!["decision".to_owned()],
        ..Compared::default()
    };
    Certificate::new(setting, used, contract, asked, seen, rollouts, Vec::new())
}

fn reason(certificate: &Certificate, part: &str) {
    let found = certificate
        .reasons
        .iter()
        .any(|reason| reason.contains(part));
    assert!(found, "'{part}' is not in {:?}", certificate.reasons);
}

#[test]
fn enough_equal_episodes_are_equivalent() {
    let found = certificate(500, 400, 0, 0);
    assert_eq!(found.verdict, Verdict::Equivalent);
    assert_eq!(found.more_episodes_per_instruction, None);
    reason(&found, "100.0 % of 500 episodes");
    // A few that fell out otherwise, either way, do not matter.
    assert_eq!(certificate(500, 397, 2, 1).verdict, Verdict::Equivalent);
}

/// Tests that frames of other bytes decide nothing, however much agrees, and that a difference which is shown stands beside them.
#[test]
fn other_frames_decide_nothing() {
    let found = |theirs: u8, reference_only: usize| {
        let mut frames = Frames::default();
        frames.compare(("kbls", 0), &[[7; 16]], &[[theirs; 16]]);
        let policy = certificate(500, 400, 0, 0).policy;
        let environment = certificate(500, 400, 0, 0).environment;
        let outcome = [500, 400 - reference_only, 0, reference_only];
        seeing(alone(policy), (environment, Some(frames)), outcome)
    };
    let same = found(7, 0);
    assert_eq!(same.verdict, Verdict::Equivalent);
    reason(&same, "the same bytes in 1 frames");
    let other = found(8, 0);
    assert_eq!(other.verdict, Verdict::Inconclusive);
    assert_eq!(other.more_episodes_per_instruction, None);
    reason(&other, "draws 1 of 1 frames otherwise");
    let lost = found(8, 200);
    assert_eq!(lost.verdict, Verdict::Different);
    assert!(lost.notes.iter().any(|note| note.contains("1 of 1 frames")));
}

#[test]
fn few_equal_episodes_decide_nothing_and_the_asked_number_does() {
    let found = certificate(20, 16, 0, 0);
    assert_eq!(found.verdict, Verdict::Inconclusive);
    reason(&found, "not shown to be inside");
    let more = found.more_episodes_per_instruction.unwrap() as usize;
    let enough = 20 + more;
    assert_eq!(
        certificate(enough, enough * 4 / 5, 0, 0).verdict,
        Verdict::Equivalent
    );
    assert!(more < 500, "{more}");
}

/// Case of 10 of 8,080 episodes that differ, all one way: McNemar's p is 0.002, and the loss of 0.12 % is nothing beside 5 %.
#[test]
fn what_is_significant_and_negligible_is_called_so() {
    let found = certificate(8080, 4000, 0, 10);
    assert_eq!(found.verdict, Verdict::Equivalent);
    assert!(found.rollouts.rates[0].mcnemar_p < 0.0038);
    let noted = found
        .notes
        .iter()
        .any(|note| note.contains("significant") && note.contains("negligible"));
    assert!(noted, "{:?}", found.notes);
}

#[test]
fn outcomes_that_change_one_way_a_little_are_undecided() {
    // 6 % of 500 lost: more than the margin by too little to tell.
    let found = certificate(500, 370, 0, 30);
    assert_eq!(found.verdict, Verdict::Inconclusive);
    let found = certificate(5000, 3600, 0, 400);
    assert_eq!(found.verdict, Verdict::Different);
}

#[test]
fn a_difference_beyond_the_margin_is_different() {
    let found = certificate(500, 200, 0, 200);
    assert_eq!(found.verdict, Verdict::Different);
    reason(&found, "N-rate: 0.400 against 0.800, beyond the margin");
}

#[test]
fn equal_rates_do_not_excuse_a_policy_or_an_environment_that_differs() {
    let place = |what: &str| Answer {
        instruction: "a".to_owned(),
        episode: 0,
        step: 3,
        what: what.to_owned(),
    };
    let sound = certificate(500, 400, 0, 0);
    let policy = Answers {
        differing_episodes: 1,
        first_difference: Some(place("another plan")),
        ..sound.policy.clone()
    };
    let found = judged(alone(policy), sound.environment.clone(), [500, 400, 0, 0]);
    assert_eq!(found.verdict, Verdict::Different);
    reason(&found, "instruction a, episode 0, step 3: another plan");
    let environment = Physics {
        first_difference: Some(place("another state")),
        ..sound.environment
    };
    let found = judged(alone(sound.policy), environment, [500, 400, 0, 0]);
    assert_eq!(found.verdict, Verdict::Different);
    reason(&found, "another state");
}

/// Tests that all three comparisons of an image with fewer bits count: image and 32 bits each with the reference, and with each other.
#[test]
fn fewer_bits_excuse_nothing_that_is_different_with_all_of_them() {
    let sound = certificate(500, 400, 0, 0);
    let rounding = Rounding {
        decisions: 3,
        smallest_margin: Some(0.5),
        largest_logit_difference: 0.02,
        clear_share: 1.0,
        ..Rounding::default()
    };
    let small = || Asked {
        policy: sound.policy.clone(),
        exact: Some(sound.policy.clone()),
        rounding: Some(rounding.clone()),
    };
    let verdict = |asked| judged(asked, sound.environment.clone(), [500, 400, 0, 0]);
    let found = verdict(small());
    assert_eq!(found.verdict, Verdict::Equivalent);
    reason(&found, "100.0 % of them clear");
    let named = found.not_covered.iter().any(|it| it.contains("2.0e-2"));
    assert!(named, "{:?}", found.not_covered);
    let mut other = small();
    let exact = other.exact.as_mut().unwrap();
    exact.differing_episodes = 1;
    exact.first_difference = Some(Answer {
        instruction: "a".to_owned(),
        episode: 0,
        step: 3,
        what: "a logit is off".to_owned(),
    });
    let found = verdict(other);
    assert_eq!(found.verdict, Verdict::Different);
    reason(&found, "with 32 bits answers otherwise");
    let unclear = |shown| {
        let mut asked = small();
        asked.rounding.as_mut().unwrap().loss = Some(Loss::Unclear {
            share: 0.5,
            logit: 0.02,
            shown,
        });
        verdict(asked)
    };
    let found = unclear(true);
    assert_eq!(found.verdict, Verdict::Different);
    reason(&found, "only 50.0 % of the decisions are clear");
    let found = unclear(false);
    assert_eq!(found.verdict, Verdict::Inconclusive);
    assert_eq!(found.more_episodes_per_instruction, None);
    reason(&found, "only 50.0 % of the decisions are clear");
}

#[test]
fn nothing_compared_is_not_agreement() {
    let found = judged(Asked::default(), Physics::default(), [500, 400, 0, 0]);
    assert_eq!(found.verdict, Verdict::Inconclusive);
    assert_eq!(
        found.more_episodes_per_instruction, None,
        "more would not help"
    );
    reason(&found, "no action was compared");
    reason(&found, "no state was compared");
}
