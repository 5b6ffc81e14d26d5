//! Runs the fuzz targets' functions on the kept corpus and on scripts of a seeded generator, so that no fuzzer is needed.
//!
//! `LADS_FUZZ_SECONDS` says how long each generator runs.

use std::env;
use std::fs;
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

fn drive(name: &str, target: fn(&[u8])) {
    let corpus = project_path("tests/fuzz/corpus").join(name);
    let mut kept = 0;
    for entry in fs::read_dir(&corpus).expect("the corpus is there") {
        let path = entry.expect("it can be read").path();
        target(&fs::read(&path).expect("it can be read"));
        kept += 1;
    }
    assert!(kept > 0, "the corpus is empty");
    let seconds = env::var("LADS_FUZZ_SECONDS").ok();
    let seconds = seconds
        .and_then(|text| text.parse().ok())
        .unwrap_or(SECONDS);
    let (start, mut state, mut scripts) = (Instant::now(), 1, 0_u64);
    while start.elapsed() < Duration::from_secs(seconds) {
        let before = state;
        let script = generated(&mut state);
        let survived = std::panic::catch_unwind(|| target(&script));
        assert!(survived.is_ok(), "state {before}: {script:?}");
        scripts += 1;
    }
    println!("{name}: {kept} kept scripts, {scripts} generated ones");
}

#[test]
fn edited_images_are_refused_or_run() {
    drive("image", hostile::image);
}

#[test]
fn edited_bundles_are_refused_or_compile() {
    drive("bundle", hostile::bundle);
}
