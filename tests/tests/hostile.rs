//! Runs the fuzz targets' functions on the kept corpus and on scripts of a seeded generator, so that no fuzzer is needed.
//!
//! `LADS_FUZZ_SECONDS` says how long each generator runs.

use std::env;
use std::ffi::OsStr;
use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use lads_tests::{hostile, project_path};

/// Seconds that each generator runs unless the environment says otherwise.
const SECONDS: u64 = 15;

/// Draws the next number of Knuth's MMIX generator.
fn next(state: &mut u64) -> u64 {
    *state = state
        .wrapping_mul(6364136223846793005)
        .wrapping_add(1442695040888963407);
    *state >> 33
}

/// Generates a script of a few edits, small numbers more often than large ones.
fn generated(state: &mut u64) -> Vec<u8> {
    let edits = 1 + next(state) % 5;
    let mut script = Vec::new();
    for _ in 0..edits * 8 {
        let shift = next(state) % 8;
        script.push((next(state) as u8) >> shift);
    }
    // The length chooses the image; less than an edit at the end is not an edit.
    script.extend((0..next(state) % 8).map(|_| 0));
    script
}

/// Reads the kept inputs of a target, by name.
fn kept(name: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let corpus = project_path("tests/fuzz/corpus").join(name);
    let entries = fs::read_dir(&corpus).expect("the corpus is there");
    let mut paths: Vec<PathBuf> = entries
        .map(|entry| entry.expect("it can be read").path())
        .collect();
    assert!(!paths.is_empty(), "the corpus is empty");
    paths.sort();
    let read = |path: PathBuf| {
        let bytes = fs::read(&path).expect("it can be read");
        (path, bytes)
    };
    paths.into_iter().map(read).collect()
}

fn drive(name: &str, target: fn(&[u8]), make: impl Fn(&mut u64) -> Vec<u8>) {
    let seconds = env::var("LADS_FUZZ_SECONDS").ok();
    let seconds = seconds
        .and_then(|text| text.parse().ok())
        .unwrap_or(SECONDS);
    let (start, mut state, mut scripts) = (Instant::now(), 1, 0_u64);
    while start.elapsed() < Duration::from_secs(seconds) {
        let before = state;
        let script = make(&mut state);
        let survived = std::panic::catch_unwind(|| target(&script));
        let shown = &script[..script.len().min(256)];
        assert!(survived.is_ok(), "state {before}: {}", shown.escape_ascii());
        scripts += 1;
    }
    println!("{name}: {scripts} generated scripts");
}

/// Edits a kept case: the policy by a script, and sometimes a few bytes of what stands before it.
fn edited(case: &[u8], state: &mut u64) -> Vec<u8> {
    let mut bytes = match next(state) % 4 {
        0 => vec![],
        _ => generated(state),
    };
    let own = bytes.len();
    bytes.extend_from_slice(case);
    let texts = case.len().min(1024);
    for _ in 0..next(state) % 4 {
        // Earlier edits may have made it shorter.
        let at = (own + next(state) as usize % texts).min(bytes.len());
        match next(state) % 3 {
            0 if at < bytes.len() => bytes[at] = TEXT[next(state) as usize % TEXT.len()],
            0 | 1 => bytes.insert(at, TEXT[next(state) as usize % TEXT.len()]),
            _ => drop(bytes.drain(at..(at + next(state) as usize % 16).min(bytes.len()))),
        }
    }
    bytes
}

/// Bytes with a meaning to readers of TOML, YAML, JSON and CSV.
const TEXT: &[u8] = b"[]{}:,=\"'\n -.0159e&*!#\\\xff";

#[test]
fn edited_images_are_refused_or_run() {
    for (_, bytes) in &kept("image") {
        hostile::image(bytes);
    }
    drive("image", hostile::image, generated);
}

#[test]
fn edited_bundles_are_refused_or_compile() {
    for (_, bytes) in &kept("bundle") {
        hostile::bundle(bytes);
    }
    drive("bundle", hostile::bundle, generated);
}

#[test]
fn edited_policies_are_refused_or_imported() {
    let cases = kept("import");
    // A form of the field is imported as it is; the others miss or contradict something.
    let refused = ["deploy", "manifest", "metadata", "files", "recording"];
    for (path, bytes) in &cases {
        let name = path.file_name().and_then(OsStr::to_str);
        let imported = hostile::import(bytes);
        // What a fuzzer has found is named by its digest.
        let found = name.is_none_or(|name| name.len() == 40);
        assert!(
            found || imported != name.is_some_and(|name| refused.contains(&name)),
            "{name:?}"
        );
    }
    let target = |bytes: &[u8]| {
        hostile::import(bytes);
    };
    drive("import", target, move |state| {
        let (_, case) = &cases[next(state) as usize % cases.len()];
        edited(case, state)
    });
}
