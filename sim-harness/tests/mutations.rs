//! The certificate against changed policies, a few of each kind; `make mutate` has all of them.

#[path = "common/mutate.rs"]
mod mutate;

use std::path::{Path, PathBuf};

use lads_compiler::Options;
use lads_proof::reference::Reference;
use mutate::{Judged, Model, Said};

/// The first traced episode of each seventh instruction.
const EVERY: usize = 7;

fn project_file(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

fn shipped() -> (Model, Reference) {
    let model = Model::open(&project_file("models/kitchen.onnx"));
    let reference = Reference::open(&project_file("models/kitchen.reference.json")).unwrap();
    (model, reference)
}

fn judged(model: &Model, reference: &Reference) -> Box<Judged> {
    judged_with(model, &Options::exact(), reference)
}

/// With the formats that the bundle was tuned to.
fn judged_tuned(model: &Model, reference: &Reference) -> Box<Judged> {
    let options = Options {
        // The reference is to find what the golden episode would.
        force: true,
        ..Options::default()
    };
    judged_with(model, &options, reference)
}

fn judged_with(model: &Model, options: &Options, reference: &Reference) -> Box<Judged> {
    match mutate::verify(model.bytes(), options, reference, EVERY) {
        Said::Judged(judged) => judged,
        Said::Refused(why) => panic!("{why}"),
    }
}

/// A change of some weights.
type Damage = (&'static str, fn(&mut [f32]));

/// A layer, a scale, another normaliser, other plans, other words: little that nobody sees in rates.
const DAMAGES: [Damage; 7] = [
    ("high_level.block.2.qkv.weight", |values| values.fill(0.0)),
    ("high_level.block.2.qkv.weight", |values| {
        mutate::scale(values, 1.01);
    }),
    ("high_level.head.weight", |values| {
        mutate::scale(values, 1.01);
    }),
    ("low_level.layer.3.weight", |values| {
        mutate::scale(values, 1.01);
    }),
    ("observation_mean", |values| values.swap(0, 1)),
    ("codebook", |values| values.rotate_left(1)),
    ("instruction.words", |values| {
        // The words of the first two instructions change places.
        let (first, rest) = values.split_at_mut(24 * 384);
        first.swap_with_slice(&mut rest[..24 * 384]);
    }),
];

#[test]
fn what_is_harmless_is_not_different() {
    let (model, reference) = shipped();
    let own = judged(&model, &reference);
    assert!(!own.different(), "{}", own.reason());
    assert!(
        own.asked.policy.largest_logit_difference < 1e-4 && own.asked.policy.compared_segments > 10
    );
    for seed in 0..2 {
        let noisy = judged(&mutate::noisy(&model, 1e-6, seed), &reference);
        assert!(
            !noisy.different() && noisy.asked.policy.largest_logit_difference > 0.0,
            "{}",
            noisy.reason()
        );
    }
    let renumbered = judged(&mutate::renumbered(&model, 7), &reference);
    assert!(
        !renumbered.different() && renumbered.asked.policy.renumbered,
        "{}",
        renumbered.reason()
    );
}

/// The head times ten chooses the same plans; so does the encoder, which chooses none.
#[test]
fn what_chooses_the_same_plans_is_different_all_the_same() {
    let (model, reference) = shipped();
    let mut hot = model.clone();
    for name in ["high_level.head.weight", "high_level.head.bias"] {
        hot.edit(name, |values| mutate::scale(values, 10.0));
    }
    let found = judged(&hot, &reference);
    assert!(
        found.asked.policy.largest_logit_difference > 10.0 && found.reason().contains("logit"),
        "{}",
        found.reason()
    );
    let mut blind = model.clone();
    blind.edit("encoder.lstm.recurrent", |values| values.fill(0.0));
    let found = judged(&blind, &reference);
    assert!(
        found.reason().contains("trajectory encoder"),
        "{}",
        found.reason()
    );
    assert!(
        found.asked.policy.differing_segments > 0
            && found.asked.policy.largest_action_difference < 1e-4
    );
}

#[test]
fn damaged_weights_are_different() {
    let (model, reference) = shipped();
    for (name, damage) in DAMAGES {
        let mut damaged = model.clone();
        damaged.edit(name, damage);
        let found = judged(&damaged, &reference);
        assert!(found.different(), "{name}: {:?}", found.asked.policy);
    }
}

/// Logits of the image that ships are off by more than a mutant's: that excuses no mutant, because the same bundle is asked with 32 bits.
#[test]
fn fewer_bits_hide_no_damage() {
    let (model, reference) = shipped();
    let own = judged_tuned(&model, &reference);
    assert!(!own.different(), "{}", own.reason());
    let seen = own.asked.rounding.as_ref().expect("it is tuned");
    // One close call of 76 decisions is not shown to be too many.
    assert!(seen.largest_logit_difference > 1e-2 && seen.decisions > 50);
    assert!(own.asked.policy.logit_tolerance.is_none());
    let exact = own.asked.exact.as_ref().unwrap();
    assert!(exact.largest_logit_difference < 1e-4 && exact.compared_decisions > 50);
    for (name, damage) in DAMAGES {
        let mut damaged = model.clone();
        damaged.edit(name, damage);
        let found = judged_tuned(&damaged, &reference);
        assert!(found.different(), "{name}: {:?}", found.asked);
    }
    // Another checkpoint of the same training is further off than this.
    let found = judged_tuned(&mutate::noisy(&model, 1e-3, 0), &reference);
    assert!(found.different(), "{:?}", found.asked);
    let renumbered = judged_tuned(&mutate::renumbered(&model, 7), &reference);
    assert!(!renumbered.different(), "{}", renumbered.reason());
    assert!(renumbered.asked.policy.renumbered);
}

#[test]
fn every_field_of_the_contract_is_compared_or_refused() {
    let (model, reference) = shipped();
    let mut places = std::collections::BTreeSet::new();
    let contract = model.contract();
    let (mut compared, mut refused) = (0, 0);
    for (pointer, changed) in mutate::contracts(&contract) {
        // One of each kind: elements of a list are alike.
        let kind: String = pointer
            .split('/')
            .filter(|part| part.parse::<usize>().is_err())
            .collect();
        if !places.insert(kind) {
            continue;
        }
        let found = lads_proof::contract::Compared::new(
            &changed,
            reference.contract.as_ref(),
            &serde_json::json!({}),
        );
        let history = ["/version", "/provenance"]
            .iter()
            .any(|start| pointer.starts_with(start));
        assert_eq!(found.differing.len(), usize::from(!history), "{pointer}");
        assert_eq!(found.history.len(), usize::from(history), "{pointer}");
        match lads_compiler::Bundle::from_bytes(model.with_contract(&changed).bytes()) {
            Ok(_) => compared += 1,
            Err(_) => refused += 1,
        }
    }
    assert!(
        compared > 10 && compared + refused == places.len(),
        "{compared} {refused}"
    );
}

/// The attack that made EQUIVALENT of a policy that fails: it samples at temperature 5.
#[test]
fn another_rule_is_different_and_runs() {
    let (model, reference) = shipped();
    let mut contract = model.contract();
    contract["family"]["decision"] =
        serde_json::json!({"rule": "sample", "temperature": 5.0, "seed": 0});
    let found = judged(&model.with_contract(&contract), &reference);
    let fields: Vec<_> = found
        .contract
        .differing
        .iter()
        .map(|it| it.field.as_str())
        .collect();
    assert_eq!(
        fields,
        ["family.decision.rule", "family.decision.temperature"]
    );
    assert!(found.contract.image_differing.is_empty());
    let answer = found
        .asked
        .policy
        .first_difference
        .as_ref()
        .expect("plans are sampled, not argmax");
    assert!(answer.what.contains("plan"), "{answer}");
}
