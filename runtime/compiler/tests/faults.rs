//! Tests that a file with several faults is told all of them at once.

mod tiny;

use std::collections::BTreeSet;

use lads_compiler::contract::Fault;
use lads_compiler::{BundleError, Contract, survey};
use serde_json::{Value, json};
use tiny::TINY;

fn contract() -> Value {
    tiny::contract().0
}

fn faults(contract: &Value) -> Vec<Fault> {
    match Contract::parse(&contract.to_string()) {
        Err(BundleError::Contract { faults }) => faults,
        other => panic!("{other:?}"),
    }
}

/// Returns the names of the faulty fields, in their order.
fn fields(contract: &Value) -> Vec<String> {
    let faults = faults(contract);
    faults.iter().map(|fault| fault.field.to_string()).collect()
}

/// Makes something that no field takes of every scalar, and names it.
fn spoil(value: &mut Value, at: &str, spoilt: &mut BTreeSet<String>) {
    match value {
        Value::Object(fields) => {
            for (key, value) in fields {
                let point = if at.is_empty() { "" } else { "." };
                spoil(value, &format!("{at}{point}{key}"), spoilt);
            }
        }
        Value::Array(elements) => {
            for (i, element) in elements.iter_mut().enumerate() {
                spoil(element, &format!("{at}[{i}]"), spoilt);
            }
        }
        scalar => {
            spoilt.insert(at.to_owned());
            *scalar = json!([[{}]]);
        }
    }
}

#[test]
fn every_wrong_type_is_named() {
    let mut broken = contract();
    let mut spoilt = BTreeSet::new();
    for (part, value) in broken.as_object_mut().unwrap() {
        // Anything may stand in the provenance; another version is another program's.
        if part != "provenance" && part != "version" {
            spoil(value, part, &mut spoilt);
        }
    }
    // The family's own fields are known by its kind.
    broken["family"]["kind"] = json!("lads");
    spoilt.remove("family.kind");
    let found: BTreeSet<String> = fields(&broken).into_iter().collect();
    assert!(spoilt.len() > 50, "{spoilt:?}");
    assert_eq!(found, spoilt);
}

#[test]
fn every_missing_field_is_named() {
    let mut broken = contract();
    for field in ["environment", "provenance", "control_period_s"] {
        broken.as_object_mut().unwrap().remove(field);
    }
    for (place, field) in [
        ("/family", "horizon"),
        ("/family/codebook", "dim"),
        ("/channels/0", "role"),
        ("/channels/0/elements/1", "unit"),
        ("/channels/0/elements/1", "min"),
        ("/language", "encoder"),
        ("/language", "sha256"),
        ("/instructions/2", "text"),
    ] {
        let part = broken.pointer_mut(place).unwrap();
        assert!(part.as_object_mut().unwrap().remove(field).is_some());
    }
    let found = fields(&broken);
    let expected = [
        "channels[0].elements[1].min",
        "channels[0].elements[1].unit",
        "channels[0].role",
        "control_period_s",
        "environment",
        "family.codebook.dim",
        "family.horizon",
        "instructions[2].text",
        "language.encoder",
        "language.sha256",
        "provenance",
    ];
    assert_eq!(found, expected);
}

/// A fault hides none of another field, and makes none.
#[test]
fn faults_of_form_and_meaning_are_told_together() {
    let mut broken = contract();
    broken["provenance"] = Value::Null;
    broken.as_object_mut().unwrap().remove("environment");
    broken["control_period_s"] = json!(-1);
    broken["channels"][0]["elements"][2]["min"] = json!(7);
    broken["channels"][4]["elements"][0]["name"] = json!("");
    broken["channels"][4]["elements"][1]["unit"] = json!(3);
    broken["instructions"][1]["text"] = json!(" ");
    broken["instructions"][2]["id"] = broken["instructions"][0]["id"].clone();
    broken["context"]["steps"] = json!(22);
    broken["context"]["words"] = json!(9);
    broken["network"]["layers"] = json!(0);
    broken["language"]["dim"] = json!(13);
    broken["language"]["layer"] = json!("last");
    broken["evaluation"]["instructions"][0]["split"] = json!("");
    let found = fields(&broken);
    let expected = [
        "channels[4].elements[1].unit",
        "environment",
        "language.layer",
        "control_period_s",
        "channels[0].elements[2]",
        "channels[4].elements[0].name",
        "network.layers",
        "context.steps",
        "instructions[1].text",
        "instructions[2].id",
        "language.dim",
        "context.words",
        "evaluation.instructions[0].split",
    ];
    assert_eq!(found, expected);
}

/// Calls with the place of every value in a contract.
fn places(value: &Value, at: &str, see: &mut Vec<String>) {
    match value {
        Value::Object(fields) => {
            for (key, value) in fields {
                places(value, &format!("{at}/{key}"), see);
            }
        }
        Value::Array(elements) => {
            for (i, element) in elements.iter().enumerate() {
                places(element, &format!("{at}/{i}"), see);
            }
        }
        _ => {}
    }
    see.push(at.to_owned());
}

/// Writes a contract over the one in the small bundle, which is at least as long.
fn with_contract(contract: &Value) -> Option<Vec<u8>> {
    let (_, place) = tiny::contract();
    let json = contract.to_string();
    let mut bytes = TINY.to_vec();
    let room = &mut bytes[place];
    room.fill(b' ');
    room.get_mut(..json.len())?.copy_from_slice(json.as_bytes());
    Some(bytes)
}

/// A fault is told once, and nothing that only follows from it.
#[test]
fn what_follows_from_a_fault_is_not_told() {
    let sound = contract();
    for (place, value, told) in [
        ("/control_period_s", json!(0), "control_period_s"),
        ("/channels/1/role", json!("x"), "channels[1].role"),
        ("/channels/1", json!(5), "channels[1]"),
        ("/channels/1/shape", json!([6]), "channels[1].shape"),
        ("/channels/0/name", json!(""), "channels[0].name"),
        ("/channels/0/shape", json!([]), "channels[0].shape"),
        (
            "/channels/0/elements/1/max",
            json!("x"),
            "channels[0].elements[1].max",
        ),
        ("/channels", json!({}), "channels"),
        ("/instructions", json!([]), "instructions"),
        ("/family/codebook/size", json!(0), "family.codebook.size"),
        ("/family/horizon", json!("four"), "family.horizon"),
        ("/network/heads", json!(0), "network.heads"),
        ("/context", json!("long"), "context"),
        ("/language", json!([]), "language"),
    ] {
        let mut broken = sound.clone();
        *broken.pointer_mut(place).unwrap() = value;
        let bytes = with_contract(&broken).expect("it is no longer");
        let found = survey(&bytes).unwrap().missing.contract;
        let fields: Vec<&str> = found.iter().map(|field| field.field.as_str()).collect();
        assert_eq!(fields, [told], "{place}: {found:#?}");
    }
}

/// Whatever stands in one place of a contract, and in two at once, is told and nothing panics.
#[test]
fn whatever_stands_anywhere_is_answered() {
    let sound = contract();
    let mut all = vec![];
    places(&sound, "", &mut all);
    let strange = [
        json!(null),
        json!(0),
        json!(-1),
        json!(1),
        json!(4_294_967_296_u64),
        json!(1.5),
        json!(true),
        json!(""),
        json!("instruction"),
        json!("noise"),
        json!("plain"),
        json!([]),
        json!([6]),
        json!([1_048_576, 1_048_576, 1_048_576, 1_048_576]),
        json!({}),
        json!({"kind": "vae"}),
    ];
    let mut asked = 0;
    for (number, place) in all.iter().enumerate() {
        for (i, value) in strange.iter().enumerate() {
            let mut broken = sound.clone();
            *broken.pointer_mut(place).unwrap() = value.clone();
            let _ = Contract::parse(&broken.to_string());
            // A second one, far away.
            let other = &all[(number * 31 + i * 17) % all.len()];
            if let Some(there) = broken.pointer_mut(other) {
                *there = strange[(number + i) % strange.len()].clone();
            }
            let _ = Contract::parse(&broken.to_string());
            // Every fourth: reading the whole file takes longer.
            if (number + i) % 4 == 0
                && let Some(bytes) = with_contract(&broken)
            {
                let _ = survey(&bytes);
                asked += 1;
            }
        }
    }
    assert!(asked > 300, "{asked}");
}

#[test]
fn a_report_of_very_many_faults_says_how_many() {
    let mut broken = contract();
    let element = json!({"name": 1, "unit": 2});
    broken["channels"][0]["elements"] = Value::Array(vec![element; 2000]);
    let faults = faults(&broken);
    assert!((1000..1010).contains(&faults.len()), "{}", faults.len());
    let error = BundleError::Contract { faults };
    let text = error.to_string();
    assert!(text.len() < 3000 && !text.contains('\n'), "{text}");
    assert!(text.contains("more, which `lads inspect` lists"), "{text}");
}

/// Replaces every such text by another of the same length.
fn edit(bytes: &mut [u8], from: &str, to: &str) {
    assert_eq!(from.len(), to.len());
    let places: Vec<usize> = (0..=bytes.len() - from.len())
        .filter(|&i| bytes[i..].starts_with(from.as_bytes()))
        .collect();
    assert!(!places.is_empty(), "{from} is not there");
    for at in places {
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
    }
}

#[test]
fn contract_graphs_and_episode_are_told_together() {
    let mut bytes = TINY.to_vec();
    assert!(survey(&bytes).unwrap().missing.is_empty());
    edit(&mut bytes, "low_level/act/plan", "low_level/act/palm");
    edit(&mut bytes, "low_level/act/action", "low_level/act/acting");
    edit(&mut bytes, "codebook/lookup/plan", "codebook/lookup/plot");
    edit(&mut bytes, r#""control_period_s""#, r#""control_Period_s""#);
    edit(&mut bytes, r#""provenance""#, r#""Provenance""#);
    edit(&mut bytes, "AAAAAAB7", "AAAAAA!!");
    // The declaration alone, which comes after the nodes.
    let name = b"high_level/step/logits";
    let last = bytes.windows(name.len()).rposition(|part| part == name);
    bytes[last.unwrap()..][..name.len()].copy_from_slice(b"high_level/step/lodges");
    let missing = survey(&bytes).unwrap().missing;
    assert_eq!(missing.operators, []);
    let told: Vec<String> = (missing.contract.iter())
        .map(|field| format!("{}: {}", field.field, field.needed))
        .collect();
    for part in [
        "low_level/act/palm is bound to nothing",
        "low_level/act/action is missing",
        "codebook/lookup/plan is missing",
        "control_period_s: is missing",
        "provenance: is missing",
        "lads.golden: is not base64",
        "outputs[high_level/step/lodges]: a node",
        "high_level/step/logits is missing",
    ] {
        assert!(
            told.iter().any(|line| line.contains(part)),
            "{part}: {told:#?}"
        );
    }
    assert_eq!(told.len(), 8, "{told:#?}");
}
