//! Tests that a written log is read back unchanged.

use std::io::Cursor;
use std::path::Path;

use lads_proof::episode::{Completion, Episode};

use super::*;
use crate::trace::{Picture, Step};

fn step(number: u32) -> Step {
    let value = number as f32;
    Step {
        // Neither is a short decimal number.
        observation: vec![value / 3.0, f32::MIN_POSITIVE],
        action: vec![-value / 7.0],
        executed: vec![value],
        plan: Some(number / 2),
        decided: number.is_multiple_of(2),
        margin: (number > 0).then_some(0.1),
        scores: if number.is_multiple_of(2) {
            vec![0.3, value]
        } else {
            vec![]
        },
        controller_ns: u64::from(number) * 1000,
        gripper: (number == 1).then_some([0.1, -0.2, 1.0 / 3.0]),
        shown: None,
        pictures: ["left", "right eye"]
            .map(|name| picture(name, number))
            .into(),
    }
}

fn picture(channel: &str, number: u32) -> Picture {
    Picture {
        channel: channel.to_owned(),
        png: vec![0x89, b'P', b'N', b'G', number as u8, 0xff],
    }
}

fn log() -> Log {
    let steps: Vec<_> = (0..4).map(step).collect();
    let trace = Trace {
        instruction: 3,
        episode: 1,
        sampling_seed: Some(u64::MAX),
        noise_seed: None,
        commanded: false,
        continued: false,
        outcome: Episode {
            steps: steps.len(),
            success: true,
            completions: vec![Completion {
                sub_task: 0,
                step: 2,
            }],
            plans: vec![0, 1],
            final_state: vec![],
        },
        steps,
    };
    Log {
        origin: Origin {
            bundle_sha256: "00ff".to_owned(),
            environment: "bench".to_owned(),
            environment_version: "1".to_owned(),
            seed: 5,
            noise: "none".to_owned(),
            control_period_s: 0.02,
            period: Some(2),
            observation_names: vec!["left knee".to_owned(), "right \"knee\"".to_owned()],
            action_names: vec!["torque".to_owned()],
            notes: [("robot".to_owned(), "none at all".to_owned())].into(),
        },
        flights: vec![Flight {
            instruction_id: "kb".to_owned(),
            instruction_text: "lift the kettle".to_owned(),
            words: Some(vec![0.5, 0.1]),
            completed: vec!["kettle".to_owned()],
            trace,
        }],
    }
}

fn bytes(log: &Log) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    write(log, &mut file).unwrap();
    file.into_inner()
}

fn read_back(bytes: &[u8]) -> Result<Log, LogError> {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), bytes).unwrap();
    read(file.path())
}

#[test]
fn a_log_reads_back_bit_for_bit() {
    assert_eq!(read_back(&bytes(&log())).unwrap(), log());
    let empty = Log {
        flights: vec![],
        ..log()
    };
    assert_eq!(read_back(&bytes(&empty)).unwrap(), empty);
}

/// Tests the form that Foxglove shows: its schema's name and fields, a topic for each camera, the time of the control step.
#[test]
fn pictures_have_the_form_of_foxglove() {
    let bytes = bytes(&log());
    let messages = mcap::MessageStream::new(&bytes).unwrap();
    let images: Vec<_> = messages
        .map(Result::unwrap)
        .filter(|message| message.channel.topic.starts_with("/images/"))
        .collect();
    assert_eq!(images.len(), 8);
    let last = images.last().unwrap();
    assert_eq!(last.channel.topic, "/images/right eye");
    let schema = last.channel.schema.as_ref().unwrap();
    assert_eq!(
        (schema.name.as_str(), schema.encoding.as_str()),
        ("foxglove.CompressedImage", "jsonschema")
    );
    let described: serde_json::Value = serde_json::from_slice(&schema.data).unwrap();
    let message: serde_json::Value = serde_json::from_slice(&last.data).unwrap();
    for (field, value) in message.as_object().unwrap() {
        let kind = &described["properties"][field]["type"];
        assert_eq!(
            kind,
            if value.is_object() {
                "object"
            } else {
                "string"
            }
        );
    }
    assert_eq!(message["format"], "png");
    assert_eq!(message["data"], "iVBORwP/");
    // The fourth control step of 20 ms.
    assert_eq!(message["timestamp"]["nsec"], 60_000_000);
    assert_eq!(last.log_time, 60_000_000);
}

#[test]
fn the_names_of_the_first_version_are_read() {
    let mut old = mcap::Writer::new(Cursor::new(Vec::new())).unwrap();
    let known = [
        ("format_version", "1"),
        ("episodes", "0"),
        ("bundle_sha256", ""),
        ("environment", ""),
        ("environment_version", ""),
        ("seed", "0"),
        ("noise", ""),
        ("control_period_s", "0.1"),
        ("observation_names", "knee ankle"),
        ("action_names", "torque"),
    ];
    let metadata = known.map(|(key, value)| (key.to_owned(), value.to_owned()));
    let metadata = mcap::records::Metadata {
        name: METADATA.to_owned(),
        metadata: metadata.into(),
    };
    old.write_metadata(&metadata).unwrap();
    old.finish().unwrap();
    let found = read_back(&old.into_inner().into_inner()).unwrap().origin;
    assert_eq!(found.observation_names, ["knee", "ankle"]);
    assert_eq!(found.action_names, ["torque"]);
}

#[test]
fn what_is_no_whole_log_is_refused() {
    let whole = bytes(&log());
    let mut damaged = whole.clone();
    damaged[whole.len() / 2] ^= 1;
    for wrong in [&whole[..whole.len() - 20], &damaged, b"no log".as_slice()] {
        assert!(matches!(read_back(wrong), Err(LogError::Mcap(_))));
    }
    let mut short = log();
    short.flights[0].trace.steps[2].action.clear();
    let error = read_back(&bytes(&short)).unwrap_err().to_string();
    assert!(error.contains("kb episode 1: step 2 has other lengths"));
    assert!(matches!(
        read(Path::new("nowhere.mcap")),
        Err(LogError::Io(_))
    ));
}
