//! Tests bundles from the outside: opening, refusals, and whole episodes.

use std::path::Path;

use lads_compiler::contract::Similarity;
use lads_compiler::{Bundle, BundleError, Contract, compile};
use lads_core::{Controller, Instruction, Policy, Workspace};

const TINY: &[u8] = include_bytes!("data/tiny.onnx");

/// Returns the tiny bundle with one byte string of its content replaced by another of the same
/// length.
fn edited(from: &str, to: &str) -> Vec<u8> {
    assert_eq!(from.len(), to.len());
    let mut bytes = TINY.to_vec();
    let at = bytes
        .windows(from.len())
        .position(|window| window == from.as_bytes())
        .expect("the text is there");
    bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
    bytes
}

#[track_caller]
fn refused(bytes: &[u8], parts: &[&str]) {
    let Err(error) = Bundle::from_bytes(bytes) else {
        panic!("it opened")
    };
    let message = error.to_string();
    for part in parts {
        assert!(
            message.contains(part),
            "\"{message}\" does not say \"{part}\""
        );
    }
    assert!(!message.contains('\n'), "{message}");
}

fn paths() -> Vec<std::path::PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let shipped = root.join("../../models/kitchen.onnx");
    let mut paths = vec![root.join("tests/data/tiny.onnx")];
    if shipped.exists() {
        paths.push(shipped);
    } else {
        println!("skipped: models/kitchen.onnx is not there yet");
    }
    paths
}

#[test]
fn opens_and_tells_what_it_holds() {
    let bundle = Bundle::from_bytes(TINY).expect("a bundle");
    assert_eq!(bundle.contract().environment.id, "tiny-bench");
    assert_eq!(bundle.len_bytes(), TINY.len());
    assert_eq!(bundle.sha256().len(), 64);
    assert_eq!(
        bundle
            .metadata("joint_names")
            .map(|names| names.contains("joint1")),
        Some(true)
    );
    let entries = bundle.entries();
    assert_eq!(entries.len(), 7, "{entries:?}");
    assert!(entries.contains(&"trajectory_encoder/encode"));
    let first = &bundle.contract().instructions[0];
    assert_eq!(bundle.instruction_indices(&first.id), [0]);
    assert_eq!(
        bundle.instruction_indices(&format!("  {} ", first.text.to_uppercase())),
        [0]
    );
    assert!(bundle.instruction_indices("sing").is_empty());
    let mut typo = first.text.clone();
    typo.pop();
    assert_eq!(bundle.nearest_instructions(&typo)[0], first.text);
}

#[test]
fn golden_episodes_replay() {
    for path in paths() {
        let bundle = Bundle::open(&path).unwrap_or_else(|error| panic!("{error}"));
        let image = compile(&bundle).unwrap_or_else(|error| panic!("{error}"));
        assert!(image.as_bytes().as_ptr().addr().is_multiple_of(64));
        let policy = Policy::new_checked(image.as_bytes()).expect("the image loads");
        assert!(policy.checksum_matches());
        let (mut arena, mut state) = (vec![0.0; policy.arena_len()], vec![0.0; policy.state_len()]);
        let workspace = Workspace::new(&policy, &mut arena, &mut state).expect("enough memory");
        let mut controller = Controller::new(policy, workspace);
        let test = controller
            .self_test()
            .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        assert_eq!(test.steps as usize, bundle.golden().steps());
        assert!(test.largest_error <= bundle.golden().tolerance);
        assert_eq!(image.report().arena_len(), policy.arena_len());
        // The same bundle gives the same image.
        let again = compile(&bundle).expect("it compiled before");
        assert_eq!(again.as_bytes(), image.as_bytes());
    }
}

#[test]
fn image_says_what_the_contract_says() {
    let bundle = Bundle::from_bytes(TINY).expect("a bundle");
    let image = compile(&bundle).expect("it compiles");
    let policy = Policy::new_checked(image.as_bytes()).expect("the image loads");
    let (wanted, got) = (bundle.contract(), policy.contract());
    assert_eq!(got.environment_id(), wanted.environment.id);
    assert_eq!(got.family(), wanted.family.name());
    assert_eq!(policy.index_count(), 5);
    let context = wanted.context.expect("a context");
    assert_eq!(got.context_steps(), Some(context.steps));
    assert_eq!(got.channels().count(), wanted.channels.len());
    for (channel, known) in got.channels().zip(&wanted.channels) {
        assert_eq!(
            (channel.name(), channel.len()),
            (known.name.as_str(), known.len())
        );
        assert_eq!(channel.reference(), known.reference);
        assert_eq!(channel.elements().count(), known.elements.len());
        for (element, known) in channel.elements().zip(&known.elements) {
            assert_eq!(
                (element.name, element.limits.min, element.limits.max),
                (known.name.as_str(), known.min, known.max)
            );
        }
    }
    assert_eq!(got.instruction_count(), wanted.instructions.len());
    for (i, known) in wanted.instructions.iter().enumerate() {
        let found = got.instruction(i).expect("an instruction");
        assert_eq!(
            (found.id, found.text),
            (known.id.as_str(), known.text.as_str())
        );
        assert!(
            !found.words.is_empty()
                && found.words.len() <= wanted.words().expect("words").iter().product()
        );
    }
}

#[test]
fn every_known_instruction_can_be_followed() {
    let bundle = Bundle::from_bytes(TINY).expect("a bundle");
    let image = compile(&bundle).expect("it compiles");
    let policy = Policy::new_checked(image.as_bytes()).expect("the image loads");
    let (mut arena, mut state) = (vec![0.0; policy.arena_len()], vec![0.0; policy.state_len()]);
    let workspace = Workspace::new(&policy, &mut arena, &mut state).expect("enough memory");
    let mut controller = Controller::new(policy, workspace);
    let observation: Vec<f32> = bundle
        .contract()
        .observation()
        .elements
        .iter()
        .map(|element| f32::midpoint(element.min, element.max))
        .collect();
    let mut action = vec![0.0; bundle.contract().action().len()];
    let steps = bundle.contract().context.expect("a context").steps;
    for id in 0..bundle.contract().instructions.len() as u32 {
        controller
            .set_instruction(Instruction::Id(id))
            .expect("a known instruction");
        for _ in 0..2 * steps {
            controller.step(&observation, &mut action).expect("a step");
        }
    }
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let Err(error) = Bundle::open(Path::new("no/such/bundle.onnx")) else {
        panic!("it opened")
    };
    let message = error.to_string();
    assert!(
        message.contains("no/such/bundle.onnx") && message.contains("cannot be read"),
        "{message}"
    );
}

#[test]
fn what_is_no_onnx_is_refused() {
    refused(b"", &["not an ONNX model", "empty"]);
    refused(
        b"hello, I am a text file of some length",
        &["not an ONNX model"],
    );
    refused(
        &[0x89, b'P', b'N', b'G', 13, 10, 26, 10, 0, 0, 0, 13],
        &["not an ONNX model"],
    );
    refused(&[0x08, 0x08], &["not an ONNX model", "no graph"]);
}

#[test]
fn truncated_files_are_refused_wherever_they_end() {
    for len in (20..TINY.len()).step_by(101).chain([TINY.len() - 1]) {
        let Err(error) = Bundle::from_bytes(&TINY[..len]) else {
            panic!("it opened with {len} bytes")
        };
        let message = error.to_string();
        assert!(
            !message.contains('\n') && message.contains("; "),
            "{message}"
        );
    }
    refused(
        &TINY[..TINY.len() / 2],
        &[
            "truncated",
            &(TINY.len() / 2).to_string(),
            "copy or export it again",
        ],
    );
}

#[test]
fn a_model_without_a_contract_is_refused() {
    refused(
        &edited("lads.contract", "lads.kontract"),
        &["lads.contract", "not a policy bundle"],
    );
    refused(
        &edited("lads.golden", "lads.gulden"),
        &["lads.golden", "missing"],
    );
}

#[test]
fn another_version_is_refused() {
    let Err(error) = Bundle::from_bytes(&edited(r#""version": 2,"#, r#""version": 7,"#)) else {
        panic!("it opened")
    };
    assert!(
        matches!(error, BundleError::ContractVersion { .. }),
        "{error}"
    );
    assert!(
        error.to_string().contains("version 7") && error.to_string().contains("version 2"),
        "{error}"
    );
}

#[test]
fn version_1_is_refused_with_the_command_that_upgrades_it() {
    refused(
        &edited(r#""version": 2,"#, r#""version": 1,"#),
        &["version 1", "python -m lads_exporter upgrade"],
    );
}

#[test]
fn contracts_that_miss_or_contradict_something_are_refused() {
    refused(&edited("\"horizon\"", "\"horizont"), &["contract", "JSON"]);
    refused(
        &edited("\"horizon\"", "\"horizom\""),
        &["contract", "horizon"],
    );
    refused(
        &edited("\"horizon\": 4", "\"horizon\": 0"),
        &["`family.horizon` is 0"],
    );
    refused(
        &edited("\"size\": 5", "\"size\": 6"),
        &["logits", "`family.codebook.size`"],
    );
    refused(
        &edited("\"joint2_velocity\"", "\"joint1_velocity\""),
        &["channels[4].elements[1].name", "repeats"],
    );
}

#[test]
fn a_channel_of_another_shape_names_itself_and_the_value() {
    refused(
        &edited("\"shape\": [4, 5]", "\"shape\": [4, 6]"),
        &[
            "trajectory_encoder/encode/observations",
            "[1, 4, 5]",
            "[4, 6]",
        ],
    );
}

/// Returns the tiny bundle's contract as JSON.
fn contract() -> serde_json::Value {
    let start = br#"{"version""#;
    let at = TINY.windows(start.len()).position(|part| part == start);
    let json = &TINY[at.expect("the contract")..];
    let mut values = serde_json::Deserializer::from_slice(json).into_iter();
    values.next().unwrap().unwrap()
}

#[test]
fn a_context_that_is_no_multiple_of_the_horizon_is_refused() {
    refused(
        &edited("\"steps\": 24", "\"steps\": 22"),
        &["`context.steps` is 22", "multiple", "4"],
    );
    refused(
        &edited("\"steps\": 24", "\"steps\": 1 "),
        &["`context.steps` is 1", "multiple", "4"],
    );
}

#[test]
fn a_context_of_one_step_compiles_and_runs() {
    let short = edited("\"steps\": 24", "\"steps\": 1 ");
    let at = short.windows(12).position(|part| part == b"\"horizon\": 4");
    let mut short = short;
    short[at.expect("the horizon") + 11] = b'1';
    let bundle = Bundle::from_bytes(&short).unwrap_or_else(|error| panic!("{error}"));
    let image = compile(&bundle).unwrap_or_else(|error| panic!("{error}"));
    let policy = Policy::new_checked(image.as_bytes()).expect("the image loads");
    let (mut arena, mut state) = (vec![0.0; policy.arena_len()], vec![0.0; policy.state_len()]);
    let workspace = Workspace::new(&policy, &mut arena, &mut state).expect("enough memory");
    let mut controller = Controller::new(policy, workspace);
    controller
        .set_instruction(Instruction::Id(0))
        .expect("a known instruction");
    let mut action = [0.0; 3];
    for _ in 0..3 {
        let report = controller.step(&[0.1; 5], &mut action).expect("a step");
        assert_eq!(report.timestep, 0);
    }
}

#[test]
fn more_steps_than_the_table_of_timesteps_has_rows_are_refused() {
    let bundle = Bundle::from_bytes(&edited("\"steps\": 24", "\"steps\": 28")).unwrap();
    let message = compile(&bundle).unwrap_err().to_string();
    for part in ["high_level", "timestep", "24 rows", "`context.steps`", "28"] {
        assert!(
            message.contains(part),
            "\"{message}\" does not say {part:?}"
        );
    }
    assert!(!message.contains('\n'), "{message}");
}

/// Tests a table of 24 rows, of which one is read at every fifth step.
#[test]
fn the_longest_context_that_is_named_is_one_of_whole_plans() {
    let mut bytes = edited("\"steps\": 24", "\"steps\": 30");
    let at = bytes.windows(12).position(|part| part == b"\"horizon\": 4");
    bytes[at.expect("the horizon") + 11] = b'5';
    let bundle = Bundle::from_bytes(&bytes).unwrap_or_else(|error| panic!("{error}"));
    let message = compile(&bundle).unwrap_err().to_string();
    assert!(message.contains("it may be 25 at most"), "{message}");
}

/// Parses the tiny bundle's contract with this `language.acceptance`.
fn with_acceptance(acceptance: serde_json::Value) -> Result<Contract, BundleError> {
    let mut contract = contract();
    contract["language"]["acceptance"] = acceptance;
    Contract::parse(&contract.to_string())
}

#[test]
fn a_contract_may_say_which_sentences_are_followed() {
    let acceptance = serde_json::json!({
        "similarity": "alignment", "threshold": 0.608, "accepted_known": 0.925, "accepted_other": 0.1125
    });
    let read = with_acceptance(acceptance.clone()).unwrap();
    let read = read
        .language
        .expect("a language")
        .acceptance
        .expect("it says so");
    assert_eq!(read.similarity, Similarity::Alignment);
    assert!((read.threshold - 0.608).abs() < 1e-6 && read.accepted_other < read.accepted_known);
    let none = with_acceptance(serde_json::Value::Null).unwrap();
    assert_eq!(none.language.expect("a language").acceptance, None);
    for (part, value) in [
        ("threshold", serde_json::json!(1.5)),
        ("threshold", serde_json::json!(-1.01)),
        ("accepted_known", serde_json::json!(-0.1)),
        ("accepted_other", serde_json::json!(92.5)),
        ("similarity", serde_json::json!("guess")),
    ] {
        let mut wrong = acceptance.clone();
        wrong[part] = value;
        let error = with_acceptance(wrong).unwrap_err().to_string();
        let named = if part == "similarity" { "guess" } else { part };
        assert!(error.contains(named) && !error.contains('\n'), "{error}");
    }
}

#[test]
fn golden_episodes_that_do_not_read_are_refused() {
    // The first bytes of the blob, in base64, are the length of its header.
    let text = String::from_utf8_lossy(TINY).into_owned();
    let at = text.find("AAAAAAB7").expect("the golden blob");
    let start = &text[at..at + 8];
    refused(&edited(start, "AAAAAA!!"), &["lads.golden", "base64"]);
    refused(&edited(start, "//////97"), &["lads.golden", "safetensors"]);
}

#[test]
fn a_missing_entry_is_named() {
    // Renames the input's declaration only: the first place where the name stands is a node.
    let name = b"low_level/act/plan";
    let mut bytes = TINY.to_vec();
    let places: Vec<usize> = (0..bytes.len() - name.len())
        .filter(|&i| bytes[i..].starts_with(name))
        .collect();
    let last = *places.last().expect("the name is there");
    bytes[last + name.len() - 1] = b'm';
    refused(&bytes, &["low_level/act/pla"]);
}
