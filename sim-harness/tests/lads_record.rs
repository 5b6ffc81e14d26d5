//! Tests `lads-run record`: the pictures, that they change nothing, and that an interrupted film leaves nothing behind.
//!
//! Where there is no EGL these tests are skipped with a printed line.
#![cfg(feature = "record")]

#[path = "common/interrupt.rs"]
mod interrupt;
#[path = "common/lads_run.rs"]
mod program;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use program::lads_run;
use serde_json::Value;

const DRAWER: [&str; 5] = ["--instruction", "open drawer", "--episodes", "2", "--json"];

/// Runs `lads-run record`; `None`, after a line, where there is no EGL.
fn recorded(model: &str, arguments: &[&str], out: &Path) -> Option<Output> {
    let output = lads_run(model, &[&["record"], arguments].concat())
        .arg(out)
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    if errors.contains("by EGL") {
        println!("skipped: {errors}");
        return None;
    }
    assert!(output.status.success(), "{errors}");
    Some(output)
}

/// Reads the JSON results without measured times.
fn runs(json: &Path) -> Value {
    let results: Value = serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
    results["instructions"].clone()
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    files.sort();
    files
}

#[test]
fn a_film_has_every_step_and_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let [plain, filmed, out] =
        ["plain.json", "filmed.json", "out"].map(|name| folder.path().join(name));
    let arguments = [&DRAWER[..], &[filmed.to_str().unwrap(), "--episode", "1"]].concat();
    let out_folder = folder.path().join("out/");
    if recorded("lorel.onnx", &arguments, &out_folder).is_none() {
        return;
    }
    let output = lads_run("lorel.onnx", &DRAWER)
        .arg(&plain)
        .output()
        .unwrap();
    assert!(output.status.success());
    let runs = [&plain, &filmed].map(|json| runs(json));
    assert_eq!(runs[0], runs[1]);

    let steps = runs[0][0]["runs"][1]["steps"].as_u64().unwrap();
    let pictures = files(&out);
    assert_eq!(pictures.len() as u64, steps + 1);
    let pictures: Vec<Vec<u8>> = pictures.iter().map(|path| pixels(path)).collect();
    // The arm moves, and there is more to see than a colour.
    let changed = |pair: &[Vec<u8>]| pair[0] != pair[1];
    assert!(pictures.windows(2).all(changed));
    let colors: std::collections::BTreeSet<&[u8]> = pictures[0].chunks(3).collect();
    assert!(colors.len() > 500, "{}", colors.len());
    assert_eq!(files(folder.path()).len(), 3, "no temporary file stays");
}

fn pixels(path: &Path) -> Vec<u8> {
    let file = std::io::BufReader::new(fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    pixels
}

#[test]
fn films_are_files_that_players_know() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = &DRAWER[..2];
    let path = |name: &str| folder.path().join(name);
    if recorded("lorel.onnx", arguments, &path("a.gif")).is_none() {
        return;
    }
    assert!(fs::read(path("a.gif")).unwrap().starts_with(b"GIF89a"));
    let ffmpeg = Command::new("ffmpeg").arg("-version").output();
    if ffmpeg.is_err() {
        println!("skipped: ffmpeg is not installed");
        let refused = lads_run("lorel.onnx", &[&["record"], arguments].concat())
            .arg(path("a.mp4"))
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert_eq!(refused.status.code(), Some(2));
        assert!(
            errors.contains("install it") && errors.lines().count() == 1,
            "{errors}"
        );
        return;
    }
    recorded("lorel.onnx", arguments, &path("a.mp4")).unwrap();
    assert_eq!(&fs::read(path("a.mp4")).unwrap()[4..8], b"ftyp");
    assert_eq!(files(folder.path()).len(), 2);
}

#[test]
fn without_egl_one_line_names_the_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let output = lads_run("kitchen.onnx", &["record"])
        .arg(folder.path().join("a.gif"))
        // The vendor-neutral EGL finds no vendor.
        .env("__EGL_VENDOR_LIBRARY_FILENAMES", "/dev/null")
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(
        errors.contains("by EGL") && errors.contains("libegl1"),
        "{errors}"
    );
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(files(folder.path()).is_empty());
}

#[test]
fn an_interrupted_film_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let [out, json] = ["a.gif", "r.json"].map(|name| folder.path().join(name));
    let mut command = lads_run(
        "kitchen.onnx",
        &["record", "--instruction", "kbls", "--episodes", "1"],
    );
    command.arg(&out).arg("--json").arg(&json);
    // The film's temporary file is there from the first picture on.
    let begun = |_| !files(folder.path()).is_empty();
    let Some((code, errors)) = interrupt::when(&mut command, &begun) else {
        println!("skipped: it ended before it could be interrupted");
        return;
    };
    if errors.contains("by EGL") {
        println!("skipped: {errors}");
        return;
    }
    assert_eq!(code, Some(130), "{errors}");
    assert!(errors.contains("nothing was written"), "{errors}");
    assert!(
        files(folder.path()).is_empty(),
        "{:?}",
        files(folder.path())
    );
}
