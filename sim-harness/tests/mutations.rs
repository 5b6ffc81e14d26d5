//! Tests the certificate against changed policies, a few of each kind; `make mutate` has all of them.

#[path = "common/mutate.rs"]
mod mutate;

use std::path::{Path, PathBuf};

use lads_compiler::Options;
use lads_proof::reference::Reference;
use mutate::{Judged, Model, Outcome};

/// Distance of the instructions whose first traced episode is asked about: each seventh.
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
    match mutate::verify(model.bytes(), &Options::exact(), reference, EVERY) {
        Outcome::Judged(judged) => judged,
        Outcome::Refused(why) => panic!("{why}"),
    }
}

#[test]
fn what_is_harmless_is_not_different() {
    let (model, reference) = shipped();
    let own = judged(&model, &reference);
    assert!(!own.different(), "{}", own.reason());
    assert!(own.answers.largest_logit_difference < 1e-4 && own.answers.compared_segments > 10);
    for seed in 0..2 {
        let noisy = judged(&mutate::noisy(&model, 1e-6, seed), &reference);
        assert!(
            !noisy.different() && noisy.answers.largest_logit_difference > 0.0,
            "{}",
            noisy.reason()
        );
    }
    let renumbered = judged(&mutate::renumbered(&model, 7), &reference);
    assert!(
        !renumbered.different() && renumbered.answers.renumbered,
        "{}",
        renumbered.reason()
    );
}

/// Tests changes that keep every plan: the head times ten chooses the same plans; so does the encoder, which chooses none.
#[test]
fn what_chooses_the_same_plans_is_different_all_the_same() {
    let (model, reference) = shipped();
    let mut hot = model.clone();
    for name in ["high_level.head.weight", "high_level.head.bias"] {
        hot.edit(name, |values| mutate::scale(values, 10.0));
    }
    let found = judged(&hot, &reference);
    assert!(
        found.answers.largest_logit_difference > 10.0 && found.reason().contains("logit"),
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
    assert!(found.answers.differing_segments > 0 && found.answers.largest_action_difference < 1e-4);
}

#[test]
fn damaged_weights_are_different() {
    let (model, reference) = shipped();
    for (name, damage) in [
        (
            "high_level.block.2.qkv.weight",
            (|values| values.fill(0.0)) as fn(&mut [f32]),
        ),
        ("low_level.layer.3.weight", |values| {
            mutate::scale(values, 1.01);
        }),
        ("observation_mean", |values| values.swap(0, 1)),
        ("codebook", |values| values.rotate_left(1)),
    ] {
        let mut damaged = model.clone();
        damaged.edit(name, damage);
        let found = judged(&damaged, &reference);
        assert!(found.different(), "{name}: {:?}", found.answers);
    }
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

/// Tests the attack that made EQUIVALENT of a policy that fails: it samples at temperature 5.
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
        .answers
        .first_difference
        .as_ref()
        .expect("plans are sampled, not argmax");
    assert!(answer.what.contains("plan"), "{answer}");
}
