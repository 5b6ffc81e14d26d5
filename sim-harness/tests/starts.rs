//! Tests plans drawn at the start of episodes: the policy's own distribution, after what the episodes' first control steps saw.

#[path = "common/bench.rs"]
mod bench;

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

use bench::{Bench, DESCRIPTION, tiny_contract, tiny_policy};
use lads_core::{Decision, Isa};
use lads_sim::environment::Environment;
use lads_sim::evaluate::{Assignment, Evaluation, Setup};
use lads_sim::rollout::Actor;
use lads_sim::starts::{self, DRAWS};

fn open() -> Box<dyn Environment> {
    Box::new(Bench::new(DESCRIPTION))
}

#[test]
fn drawn_plans_follow_the_scores_whatever_rule_the_episodes_had() {
    let policy = tiny_policy();
    let assignments = [0, 1].map(|instruction| Assignment {
        instruction,
        commanded: vec![0],
        max_steps: 3,
    });
    let evaluation = Evaluation {
        policy,
        contract: tiny_contract(),
        assignments: &assignments,
        // One, so that all draws are from one distribution.
        episodes: 1,
        seed: 3,
        decision: Decision::Argmax,
        actor: Actor::Policy,
        isa: Isa::detect(),
        threads: 1,
        setup: Setup {
            traced: u32::MAX,
            ..Setup::default()
        },
    };
    let evaluated = evaluation
        .run(&open, &AtomicBool::new(false), &|| {})
        .unwrap();
    let traces = &evaluated.traces;
    let drawn = starts::draw(&evaluation, traces, &[1]).unwrap();
    assert_eq!(drawn.keys().copied().collect::<Vec<_>>(), [1]);
    let draws = &drawn[&1];
    assert_eq!(draws.len(), DRAWS as usize);
    assert_eq!(
        starts::draw(&evaluation, traces, &[0, 1]).unwrap()[&1],
        *draws
    );

    // A plan has one vector, other plans have others.
    let mut vectors: BTreeMap<u32, &[f32]> = BTreeMap::new();
    let mut counts: BTreeMap<u32, f64> = BTreeMap::new();
    for draw in draws {
        let plan = draw.plan.unwrap();
        let known = vectors.entry(plan).or_insert(&draw.vector);
        assert_eq!(*known, draw.vector);
        *counts.entry(plan).or_default() += 1.0 / f64::from(DRAWS);
    }
    let mut others: Vec<_> = vectors.values().collect();
    others.sort_by(|a, b| a.partial_cmp(b).unwrap());
    others.dedup();
    assert!(others.len() == vectors.len() && others.len() > 1);

    // Shares beside the softmax of the scores that the episode recorded; 0.25 is more than three deviations of a share of 50 draws.
    let first = &traces[1].steps[0];
    let most = first.scores.iter().copied().fold(f32::MIN, f32::max);
    let weights = first
        .scores
        .iter()
        .map(|score| f64::from(score - most).exp());
    let total: f64 = weights.clone().sum();
    for (plan, weight) in (0..).zip(weights) {
        let share = counts.get(&plan).copied().unwrap_or(0.0);
        assert!(
            (share - weight / total).abs() < 0.25,
            "{plan}: {share} against {}",
            weight / total
        );
    }
}
