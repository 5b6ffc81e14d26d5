//! Tests of `lads inspect`: a policy's channels, schedule and memory, and the gaps of a foreign
//! file.

mod common;

use std::fs;

use lads_image::Tables;
use serde_json::Value;

use common::{altered, answer, refused, tiny, with_golden};

#[test]
fn inspect_tells_what_the_contract_and_the_image_hold() {
    let model = tiny().to_str().unwrap().to_owned();
    let text = answer(&["inspect", &model], "");
    let json: Value = serde_json::from_str(&answer(&["inspect", &model, "--json"], "")).unwrap();
    with_golden(|policy, golden| {
        let contract = policy.contract();
        let elements = contract.channels().flat_map(|channel| channel.elements());
        let names = elements.map(|element| element.name);
        for name in names.chain(contract.instructions().map(|known| known.text)) {
            assert!(text.contains(name), "{name} is not in: {text}");
        }
        // What an action means: relative to what, times what, in which unit.
        let mut scaled = 0;
        for (channel, told) in contract
            .channels()
            .zip(json["contract"]["channels"].as_array().unwrap())
        {
            assert_eq!(told["reference"], channel.reference());
            assert!(text.contains(channel.reference()), "{text}");
            for (element, told) in channel.elements().zip(told["elements"].as_array().unwrap()) {
                assert_eq!(told["physical_unit"], element.physical_unit);
                if element.scale != 1.0 {
                    let meaning = format!("= {} + {} * value", element.offset, element.scale);
                    assert!(text.contains(&meaning), "{meaning}: {text}");
                    scaled += 1;
                }
            }
        }
        assert!(scaled > 0);
        let sizes = &json["sizes"];
        assert_eq!(sizes["image_bytes"], policy.image_bytes());
        let [arena, state] = [policy.arena_len(), policy.state_len()].map(|len| 4 * len);
        assert_eq!(sizes["arena_bytes"], arena);
        assert_eq!(sizes["state_bytes"], state);
        let workspace = sizes["workspace_bytes"].as_u64().unwrap() as usize;
        assert!((arena + state..arena + state + 4096).contains(&workspace));
        let tables = Tables::new(policy.image()).unwrap();
        assert_eq!(sizes["weights_bytes"], size_of_val(tables.weights()));
        assert_eq!(json["golden_steps"], golden.len());
        // All states, the action in both banks, and nothing else.
        let states = json["states"].as_array().unwrap().iter();
        let states: u64 = states.map(|state| state["bytes"].as_u64().unwrap()).sum();
        assert_eq!(states as usize + 2 * 4 * contract.action_len(), state);
        assert_eq!(json["worst_multiply_adds"], contract.worst_work());
    });
    let contract = &json["contract"];
    assert_eq!(contract["environment"]["id"], "tiny-bench");
    assert_eq!(contract["control_period_s"], 0.05);
    let channels = contract["channels"].as_array().unwrap();
    let channel = |role: &str| {
        let mut found = channels.iter().filter(|channel| channel["role"] == role);
        found.next().unwrap()
    };
    assert_eq!(channel("observation")["elements"][2]["min"], -0.1);
    assert_eq!(
        channel("observation")["elements"][0]["interface"],
        "position"
    );
    assert_eq!(channel("action")["elements"][2]["scale"], 0.4);
    assert_eq!(json["entries"].as_array().unwrap().len(), 7);
    assert_eq!(json["missing"]["operators"], Value::Array(vec![]));
    assert_eq!(json["missing"]["contract"], Value::Array(vec![]));
}

#[test]
fn inspect_shows_what_runs_at_which_step() {
    let model = tiny().to_str().unwrap().to_owned();
    let text = answer(&["inspect", &model], "");
    let json: Value = serde_json::from_str(&answer(&["inspect", &model, "--json"], "")).unwrap();
    let places = json["schedule"].as_array().unwrap();
    let place = |steps: &str| {
        let mut found = places.iter().filter(|place| place["steps"] == steps);
        found
            .next()
            .unwrap_or_else(|| panic!("no {steps}: {places:?}"))
    };
    let entries = |place: &Value| -> Vec<String> {
        let calls = place["calls"].as_array().unwrap().iter();
        calls
            .map(|call| call["entry"].as_str().unwrap().to_owned())
            .collect()
    };
    let first = ["high_level/start", "codebook/lookup", "low_level/act"];
    assert_eq!(entries(place("first")), first);
    let every = ["high_level/step", "codebook/lookup", "low_level/act"];
    assert_eq!(entries(place("every 4")), every);
    assert_eq!(
        entries(place("other")),
        ["high_level/record", "low_level/act"]
    );
    assert_eq!(place("every 4")["calls"][0]["selects_from"], "logits");
    for name in ["multiply_adds", "weight_bytes", "state_bytes"] {
        let cost = |place: &Value| place[name].as_u64().unwrap();
        let calls = place("every 4")["calls"].as_array().unwrap();
        assert_eq!(cost(place("every 4")), calls.iter().map(cost).sum::<u64>());
        assert!(cost(place("every 4")) > cost(place("other")), "{name}");
    }
    for part in [
        "every 4 steps",
        "high_level/step, selects from logits",
        "other steps",
        "multiply-adds",
        "context                  kv",
    ] {
        assert!(text.contains(part), "{part} is not in: {text}");
    }
}

/// Encodes a field of a protocol buffer: its number, and text or a message.
fn field(number: u8, content: &[u8]) -> Vec<u8> {
    let mut len = content.len();
    let mut bytes = vec![number << 3 | 2];
    while len > 127 {
        bytes.push(len as u8 | 128);
        len >>= 7;
    }
    bytes.push(len as u8);
    [bytes, content.to_vec()].concat()
}

/// Encodes a node of an ONNX graph.
fn node(operator: &str, name: &str, input: &str, output: &str) -> Vec<u8> {
    let [input, output] =
        [(1, input), (2, output)].map(|(number, text)| field(number, text.as_bytes()));
    let named = [field(3, name.as_bytes()), field(4, operator.as_bytes())].concat();
    field(1, &[input, output, named].concat())
}

/// Encodes an f32 input or output `[batch, len]` of an ONNX graph, by the number of the graph's
/// field.
fn edge(number: u8, name: &str, len: u8) -> Vec<u8> {
    let dims = [field(1, &field(2, b"batch")), field(1, &[1 << 3, len])].concat();
    let tensor = [vec![1 << 3, 1], field(2, &dims)].concat();
    field(
        number,
        &[field(1, name.as_bytes()), field(2, &field(1, &tensor))].concat(),
    )
}

/// Makes a recurrent policy as a foreign exporter would: no contract, and operators of which three
/// are not known.
fn stranger() -> Vec<u8> {
    let nodes = [
        node("Tanh", "squash", "obs", "a"),
        node("Mystery", "first/Mystery", "a", "b"),
        node("Relu", "", "b", "c"),
        node("Enigma", "second/Enigma", "c", "actions"),
        node("Mystery", "third/Mystery", "h_in", "h_out"),
    ];
    let edges = [
        edge(11, "obs", 5),
        edge(11, "h_in", 8),
        edge(12, "actions", 3),
        edge(12, "h_out", 8),
    ];
    let graph = [nodes.concat(), edges.concat()].concat();
    let opset = field(8, &[2 << 3, 17]);
    [vec![1 << 3, 8], field(7, &graph), opset].concat()
}

#[test]
fn inspect_lists_all_that_a_foreign_file_misses() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder
        .path()
        .join("foreign.onnx")
        .to_str()
        .unwrap()
        .to_owned();
    fs::write(&path, stranger()).unwrap();
    let json: Value = serde_json::from_str(&answer(&["inspect", &path, "--json"], "")).unwrap();
    assert_eq!(
        (&json["form"], &json["opset"]),
        (&"onnx".into(), &17.into())
    );
    let missing = &json["missing"];
    let operators = missing["operators"].as_array().unwrap();
    let named: Vec<_> = operators
        .iter()
        .map(|node| {
            (
                node["operator"].as_str().unwrap(),
                node["node"].as_str().unwrap(),
            )
        })
        .collect();
    let expected = [
        ("Mystery", "first/Mystery"),
        ("Enigma", "second/Enigma"),
        ("Mystery", "third/Mystery"),
    ];
    assert_eq!(named, expected);
    assert_eq!(operators[0]["inputs"][0]["shape"], "[1, 5]");
    assert_eq!(
        operators[1]["inputs"][0]["shape"], "?",
        "behind what is not known"
    );
    assert_eq!(operators[2]["inputs"][0]["shape"], "[1, 8]");
    let fields: Vec<_> = missing["contract"]
        .as_array()
        .unwrap()
        .iter()
        .map(|field| field["field"].as_str().unwrap())
        .collect();
    for field in [
        "family",
        "environment",
        "control_period_s",
        "channels[obs]",
        "channels[obs].shape[0]",
        "channels[h_in]",
        "channels[actions]",
        "entries",
        "lads.golden",
    ] {
        assert!(fields.contains(&field), "{field} is not in {fields:?}");
    }
    let text = answer(&["inspect", &path], "");
    for part in [
        "not a policy yet",
        "obs: float32 [batch, 5]",
        "operators that are missing (3)",
        "Mystery `first/Mystery` of a [1, 5]",
        "Enigma `second/Enigma`",
        "an output feeds (h_out)",
        "`policy/act/obs`",
    ] {
        assert!(text.contains(part), "'{part}' is not in: {text}");
    }
    // What needs a policy refuses it, in one line.
    refused(
        &["self-test", &path],
        "",
        &["foreign.onnx", "lads.contract"],
    );
}

#[test]
fn inspect_lists_the_fields_that_a_contract_misses() {
    let folder = tempfile::tempdir().unwrap();
    let one = altered(
        folder.path(),
        r#""control_period_s""#,
        r#""control_perioD_s""#,
    );
    let json: Value = serde_json::from_str(&answer(&["inspect", &one, "--json"], "")).unwrap();
    assert_eq!(json["missing"]["operators"], Value::Array(vec![]));
    assert_eq!(json["missing"]["contract"].as_array().unwrap().len(), 1);
    assert_eq!(json["missing"]["contract"][0]["field"], "control_period_s");
}
