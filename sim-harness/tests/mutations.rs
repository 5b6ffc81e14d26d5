//! Tests the certificate against changed policies, a few of each kind; `make mutate` has all of them.

#[path = "common/drive.rs"]
mod drive;
#[path = "common/mutate.rs"]
mod mutate;

use std::path::{Path, PathBuf};

use drive::Rollouts;
use lads_compiler::{CacheFormat, Options, Storage, WeightFormat};
use lads_proof::reference::Reference;
use mutate::{ACTION, Judged, LOGIT, Model};
use serde_json::{Value, json};

/// Bias that is added at the end of the low level.
const LAST_BIAS: &str = "low_level.layer.6.bias";

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

fn judged(model: &Model, reference: &Reference) -> Judged {
    judged_with(model, &Options::exact(), reference)
}

/// Judges a policy with the formats that the bundle was tuned to.
fn judged_tuned(model: &Model, reference: &Reference) -> Judged {
    let options = Options {
        // The reference is to find what the golden episode would.
        force: true,
        ..Options::default()
    };
    judged_with(model, &options, reference)
}

fn judged_with(model: &Model, options: &Options, reference: &Reference) -> Judged {
    match mutate::open(model.bytes(), options) {
        Ok(opened) => mutate::judge(&opened, reference, EVERY),
        Err(why) => panic!("{why}"),
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

/// Tests what a row of `make mutate` says: how far a change moves the answers, with 32 bits and with fewer, and what it leaves of the success.
#[test]
fn a_change_is_measured_by_what_it_moves() {
    let (model, reference) = shipped();
    let moved = |model: &Model| judged(model, &reference).moved();
    assert!(moved(&model).is_little());
    let scaled = |name: &str, factor: f32| {
        let mut changed = model.clone();
        changed.edit(name, |values| mutate::scale(values, factor));
        changed
    };
    let logits = moved(&scaled("high_level.head.weight", 1.1));
    assert!(logits.is_much() && logits.logit > LOGIT && logits.action < ACTION);
    let actions = moved(&scaled("low_level.layer.3.weight", 1.1));
    assert!(actions.is_much() && actions.action > ACTION && actions.logit < LOGIT);
    // With fewer bits a logit counts by what it decides.
    let rounded = |weights: WeightFormat, cache: CacheFormat| {
        let storage = Storage::of_weights(weights)
            .with_part("low_level/act", WeightFormat::F32)
            .with_cache(cache);
        let options = Options {
            storage: Some(storage),
            force: true,
            ..Options::default()
        };
        judged_with(&model, &options, &reference).moved()
    };
    let cache = rounded(WeightFormat::F32, CacheFormat::Int8);
    assert!(cache.logit > 1e-3 && !cache.is_much(), "{cache:?}");
    let weights = rounded(WeightFormat::Int8, CacheFormat::F32);
    assert!(weights.logit > LOGIT && weights.decisions == 0);
    assert!(!weights.is_much() && !weights.is_little(), "{weights:?}");

    let opened = |model: &Model| mutate::open(model.bytes(), &Options::exact()).unwrap();
    let own = opened(&model);
    let rollouts = Rollouts::new(&own, &reference, 12, 2);
    assert_eq!(rollouts.commanded(), 4 * rollouts.instructions().count());
    let recorded = rollouts.instructions().map(|index| {
        let episode = &reference.instructions[index].episodes[0];
        let four = episode.success.then_some(4);
        (episode.success, four.unwrap_or(episode.completions.len()))
    });
    let outcomes = rollouts.run(&own).unwrap();
    for (outcome, (success, at_most)) in outcomes.iter().zip(recorded) {
        let done = outcome.sub_tasks.len();
        assert_eq!((outcome.success, done == 4), (success, success));
        assert!(done <= at_most, "{done} of {at_most}");
    }
    assert!(outcomes.iter().any(|it| it.success));
    // Who does not move does nothing.
    let mut still = model.clone();
    for name in ["low_level.layer.6.weight", LAST_BIAS] {
        still.edit(name, |values| values.fill(0.0));
    }
    let outcomes = rollouts.run(&opened(&still)).unwrap();
    assert!(outcomes.iter().all(|it| !it.success), "{outcomes:?}");
    // What the environment does not have is refused before an episode runs.
    let mut contract = model.contract();
    contract["control_period_s"] = json!(0.05);
    let refused = rollouts.run(&opened(&model.with_contract(&contract)));
    assert!(refused.is_err(), "{refused:?}");
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

/// Tests that the bounds of a certificate are where it states them: a change a little smaller is allowed, a little larger is DIFFERENT.
#[test]
fn changes_are_different_from_the_bounds_on() {
    use lads_proof::answers::{ACTION_TOLERANCE, LOGIT_TOLERANCE, NOISE_FACTOR};
    type Moved = fn(&Judged) -> f64;
    let (model, reference) = shipped();
    let noise = reference.float_noise.unwrap();
    assert!(NOISE_FACTOR * noise.logit < LOGIT_TOLERANCE);
    // Adds to one logit, or to one element of the action, so much.
    let cases: [(&str, f64, Moved); 2] = [
        ("high_level.head.bias", LOGIT_TOLERANCE, |found| {
            found.asked.policy.largest_logit_difference
        }),
        (
            LAST_BIAS,
            ACTION_TOLERANCE.max(NOISE_FACTOR * noise.action),
            |found| found.asked.policy.largest_action_difference,
        ),
    ];
    for (name, bound, moved) in cases {
        let with = |added: f64| {
            let mut changed = model.clone();
            changed.edit(name, |values| values[0] += added as f32);
            judged(&changed, &reference)
        };
        // How much moves is not how much was added: a logit counts up to a constant, an action passes its limits.
        let gain = moved(&with(0.5 * bound)) / (0.5 * bound);
        for (share, different) in [(0.9, false), (1.1, true), (2.0, true), (20.0, true)] {
            let found = with(share * bound / gain);
            let moved = moved(&found);
            assert!(
                (moved / (share * bound) - 1.0).abs() < 0.08,
                "{name}: {moved:.2e} instead of {share} times {bound:.2e}"
            );
            assert_eq!(
                found.different(),
                different,
                "{name}, {share} times the bound: {}",
                found.reason()
            );
        }
    }
}

/// Tests that fewer bits, whose logits differ by more than a mutant's, excuse no mutant: the same bundle is asked with 32 bits.
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
            [&Value::Null; 2],
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

/// Returns one change of each kind of field: where, the new value, and the field that the comparison names.
fn one_change_each(contract: &Value) -> Vec<(String, Value, String)> {
    let channels = contract["channels"].as_array().unwrap();
    let acting = channels
        .iter()
        .position(|channel| channel["role"] == "action")
        .unwrap();
    let observed = |field: &str, value: Value| {
        let pointer = format!("/channels/0/elements/0/{field}");
        let named = format!("channels[observation].elements[panda_joint1].{field}");
        (pointer, value, named)
    };
    let acted = |field: &str, value: Value| {
        let pointer = format!("/channels/{acting}/elements/0/{field}");
        let named = format!("channels[action].elements[panda_joint1_velocity].{field}");
        (pointer, value, named)
    };
    let other = |pointer: &str, value: Value, named: &str| {
        let (pointer, named) = (pointer.to_owned(), named.to_owned());
        (pointer, value, named)
    };
    let instruction = contract["instructions"][3]["id"].as_str().unwrap();
    let text = format!("instructions[{instruction}].text");
    let reference = format!("/channels/{acting}/reference");
    let quaternions = "channels[observation].quaternion_order";
    let threshold = "/language/acceptance/threshold";
    vec![
        observed("joint", json!("other")),
        observed("joint", json!(null)),
        observed("interface", json!("effort")),
        observed("unit", json!("deg")),
        observed("max", json!(9.5)),
        acted("scale", json!(0.5)),
        acted("offset", json!(0.5)),
        acted("physical_unit", json!("deg/s")),
        other(&reference, json!("nothing"), "channels[action].reference"),
        other("/channels/0/quaternion_order", json!("xyzw"), quaternions),
        other("/environment/version", json!("2"), "environment[1]"),
        other("/control_period_s", json!(0.05), "control_period_s"),
        other("/context/steps", json!(40), "context.steps"),
        other("/context/beyond", json!("refuse"), "context.beyond"),
        other("/family/decision/rule", json!("sample"), "decision.rule"),
        other("/language/encoder", json!("other"), "language[0]"),
        other(threshold, json!(0.5), "acceptance"),
        other("/instructions/3/text", json!("sit down"), &text),
    ]
}

/// Tests that an image is compared with its bundle in every contract field that it holds: one change of each kind is found and named.
#[test]
fn an_image_of_another_bundle_is_told_apart_by_every_kind_of_field() {
    let model = Model::open(&project_file("models/kitchen-small.onnx"));
    let bundle = lads_compiler::Bundle::from_bytes(model.bytes()).unwrap();
    let said = lads_sim::verify::contract::of_bundle(&bundle).unwrap();
    let fields = |other: &Model| -> Vec<String> {
        let opened = lads_host::from_bytes_with(other.bytes(), &Options::exact()).unwrap();
        let image = lads_sim::verify::contract::of_image(&opened.policy());
        let found = lads_proof::contract::Compared::new(&json!({}), None, [&image, &said]);
        let named = found.image_differing.into_iter().map(|it| it.field);
        named.filter(|field| field != "bundle_sha256").collect()
    };
    assert_eq!(fields(&model), [""; 0]);
    let contract = model.contract();
    let cases = one_change_each(&contract);
    for (pointer, value, wanted) in cases {
        let mut changed = contract.clone();
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        changed.pointer_mut(parent).unwrap()[key] = value;
        let found = fields(&model.with_contract(&changed));
        assert!(found.contains(&wanted), "{pointer}: {found:?}");
        // The rule of sampling brings its numbers along.
        assert!(
            found
                .iter()
                .all(|field| field == &wanted || field.starts_with("decision."))
        );
    }
    // Other words under the same texts.
    let mut misheard = model.clone();
    misheard.edit("instruction.words", |values| values[0] += 0.25);
    let first = contract["instructions"][0]["id"].as_str().unwrap();
    assert_eq!(
        fields(&misheard),
        [format!("instructions[{first}].words_sha256")]
    );
}

/// Tests the attack that made EQUIVALENT of a policy that fails: it samples at temperature 5.
#[test]
fn another_rule_is_different_and_runs() {
    let (model, reference) = shipped();
    let mut contract = model.contract();
    contract["family"]["decision"] = json!({"rule": "sample", "temperature": 5.0, "seed": 0});
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
