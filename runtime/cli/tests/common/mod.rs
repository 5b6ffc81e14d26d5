//! Runs the command, for all tests of this crate.
#![allow(dead_code, reason = "each suite uses its own part")]

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use lads_compiler::{Bundle, compile};
use lads_core::{Golden, Policy};

pub fn tiny() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../compiler/tests/data/tiny.onnx")
}

/// Runs `lads` with `input` on its stdin.
pub fn lads(arguments: &[&str], input: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads"));
    command
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    // A program that refused its arguments has closed its end.
    let _ = child.stdin.take().unwrap().write_all(input.as_bytes());
    child.wait_with_output().unwrap()
}

/// Returns the output of `lads` when it succeeds.
pub fn answer(arguments: &[&str], input: &str) -> String {
    let output = lads(arguments, input);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    assert!(output.stderr.is_empty());
    String::from_utf8(output.stdout).unwrap()
}

/// Asserts exit code 2 and one line on stderr with all `parts`; returns the text on stdout.
pub fn refused(arguments: &[&str], input: &str, parts: &[&str]) -> String {
    let output = lads(arguments, input);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(
        errors.starts_with("error: ") && !errors.contains("panicked"),
        "{errors}"
    );
    for part in parts {
        assert!(errors.contains(part), "'{part}' is not in: {errors}");
    }
    String::from_utf8(output.stdout).unwrap()
}

pub fn act<'a>(model: &'a str, rest: &[&'a str]) -> Vec<&'a str> {
    [&["act", "--model", model, "--instruction", "dl"], rest].concat()
}

pub fn with_golden(use_it: impl FnOnce(&Policy<'_>, Golden<'_>)) {
    let image = compile(&Bundle::open(&tiny()).unwrap()).unwrap();
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    use_it(&policy, policy.golden().unwrap());
}

pub fn csv(values: &[f32]) -> String {
    values
        .iter()
        .map(f32::to_string)
        .collect::<Vec<_>>()
        .join(",")
        + "\n"
}

pub fn numbers(line: &str) -> Vec<f32> {
    line.trim_matches(['[', ']'])
        .split(',')
        .map(|number| number.parse().unwrap())
        .collect()
}

/// Copies the small bundle, with one text of its metadata replaced by another of the same length.
pub fn altered(folder: &Path, from: &str, to: &str) -> String {
    assert_eq!(from.len(), to.len());
    let mut bytes = fs::read(tiny()).unwrap();
    let place = bytes
        .windows(from.len())
        .position(|window| window == from.as_bytes())
        .unwrap();
    bytes[place..place + to.len()].copy_from_slice(to.as_bytes());
    let path = folder.join("altered.onnx");
    fs::write(&path, bytes).unwrap();
    path.to_str().unwrap().to_owned()
}
