//! Tests the dataset file: round trip, equal bytes, refusals; and what `lads-collect` says about bad input.

use std::collections::HashMap;
use std::path::Path;
use std::process::{Command, Output};

use lads_sim::dataset::{Dataset, Demonstration};
use lads_sim::expert::Transition;
use lads_sim::instructions::Instructions;

fn transition(number: f32) -> Transition {
    Transition {
        observation: std::array::from_fn(|index| number + index as f32),
        state: std::array::from_fn(|index| number - index as f32),
        action: [number / 1000.0; 9],
        executed: [-number / 1000.0; 9],
    }
}

fn dataset() -> Dataset {
    let demonstration = |instruction: usize, steps: usize| Demonstration {
        instruction,
        episode: (1 << 32) + steps as u64,
        transitions: (0..steps)
            .map(|step| transition((10 * instruction + step) as f32))
            .collect(),
        sub_task_ends: [1, 2, 3, steps],
        recovery_noise: 0.125,
        speed: 1.0625,
    };
    // Values are exact in f32, so that a round trip gives the same numbers.
    let metadata = ["noise", "seed", "attempts", "versions"]
        .map(|key| (key.to_owned(), format!("\"{key}\" of the test")));
    Dataset {
        metadata: HashMap::from(metadata),
        instructions: Instructions::kitchen().seen[..3].to_vec(),
        demonstrations: vec![demonstration(0, 7), demonstration(2, 4)],
    }
}

#[test]
fn a_dataset_survives_the_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("made/on/the/way.safetensors");
    dataset().write(&path).unwrap();
    let read = Dataset::read(&path).unwrap();
    assert_eq!(
        (&read.instructions, &read.demonstrations),
        (&dataset().instructions, &dataset().demonstrations)
    );
    assert!(
        dataset()
            .metadata
            .iter()
            .all(|(key, value)| read.metadata.get(key) == Some(value))
    );
    assert_eq!(read.metadata["format"], "lads-dataset");
    let names = std::fs::read_dir(path.parent().unwrap()).unwrap().count();
    assert_eq!(names, 1, "no temporary file is left");
}

#[test]
fn equal_datasets_are_equal_files() {
    let folder = tempfile::tempdir().unwrap();
    let files: Vec<Vec<u8>> = (0..4)
        .map(|number| {
            let path = folder.path().join(format!("{number}.safetensors"));
            // A new dataset each time: its metadata have another order in memory.
            dataset().write(&path).unwrap();
            std::fs::read(path).unwrap()
        })
        .collect();
    assert!(files.iter().all(|file| *file == files[0]));
}

/// Returns the error of reading a good file after `damage` was done to it.
fn refusal(damage: impl FnOnce(Vec<u8>) -> Vec<u8>) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.safetensors");
    dataset().write(&path).unwrap();
    std::fs::write(&path, damage(std::fs::read(&path).unwrap())).unwrap();
    let message = Dataset::read(&path).unwrap_err().to_string();
    assert!(
        message.contains("bad.safetensors") && message.lines().count() == 1,
        "{message}"
    );
    message
}

/// Replaces text in the header by text of the same length.
fn replace(mut file: Vec<u8>, from: &str, to: &str) -> Vec<u8> {
    assert_eq!(from.len(), to.len());
    let at = file
        .windows(from.len())
        .position(|window| window == from.as_bytes())
        .unwrap();
    file[at..at + to.len()].copy_from_slice(to.as_bytes());
    file
}

#[test]
fn damaged_files_are_refused_by_name() {
    assert!(refusal(|_| b"no dataset".to_vec()).contains("not a safetensors file"));
    assert!(refusal(|file| file[..file.len() - 5].to_vec()).contains("not a safetensors file"));
    assert!(
        refusal(|file| replace(file, "\"version\":\"1\"", "\"version\":\"2\""))
            .contains("version is not \"1\"")
    );
    assert!(refusal(|file| replace(file, "\"speed\"", "\"spoon\"")).contains("no tensor speed"));
    // The last element of `episode_offsets` no longer is the number of rows.
    assert!(
        refusal(|file| replace(file, "\x0b\0\0\0\0\0\0\0", "\x0c\0\0\0\0\0\0\0"))
            .contains("elements, expected")
    );
}

#[test]
fn a_missing_file_is_named() {
    let message = Dataset::read(Path::new("/no/such/file"))
        .unwrap_err()
        .to_string();
    assert!(message.contains("/no/such/file"), "{message}");
}

fn lads_collect(arguments: &[&str], vendor: Option<&str>) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads-collect"));
    if let Some(vendor) = vendor {
        command.env("LADS_VENDOR", vendor);
    }
    command.args(arguments).output().unwrap()
}

#[test]
fn lads_collect_refuses_bad_input_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("d.safetensors");
    let target = target.to_str().unwrap();
    let folder_text = folder.path().to_str().unwrap();
    let cases: [(&[&str], Option<&str>, &str); 4] = [
        (
            &["-o", target, "--episodes-per-instruction", "0"],
            None,
            "--episodes-per-instruction",
        ),
        (
            &["-o", target, "--recovery-noise", "7"],
            None,
            "recovery noise",
        ),
        (&["-o", folder_text], None, "is a folder"),
        (
            &["-o", target],
            Some("/no/such/vendor"),
            "run \"make setup\"",
        ),
    ];
    for (arguments, vendor, expected) in cases {
        let output = lads_collect(arguments, vendor);
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(
            message.contains(expected) && message.lines().count() == 1,
            "{message}"
        );
    }
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        0,
        "nothing was written"
    );
}
