//! Makes command lines of `lads-run`, and judges what it refuses.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Returns a file of the project, by its path from the root.
pub fn project_file(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Path of the kitchen bundle that ships.
pub fn kitchen_bundle() -> PathBuf {
    project_file("models/kitchen.onnx")
}

/// Makes a `lads-run` command with a model, by its path or as the name of a shipped one.
pub fn lads_run(model: impl AsRef<Path>, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads-run"));
    // Another job than the main one comes first.
    let (job, rest) = match arguments {
        [job, rest @ ..] if !job.starts_with('-') => (Some(job), rest),
        _ => (None, arguments),
    };
    let model = project_file("models").join(model);
    command.args(job).arg("--model").arg(model).args(rest);
    // Whatever the user's own cache has.
    command.env("LADS_CACHE", "/nonexistent");
    command
}

/// Asserts exit code 2, nothing on stdout, and one line on stderr with all `parts`.
pub fn assert_refused(output: &Output, parts: &[&str]) {
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(output.stdout.is_empty());
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(
        errors.starts_with("error: ") && !errors.contains("panicked"),
        "{errors}"
    );
    for part in parts {
        assert!(errors.contains(part), "'{part}' is not in: {errors}");
    }
}

/// Runs `lads-run` and asserts that it refuses, see [`assert_refused`].
pub fn refused(model: &Path, arguments: &[&str], parts: &[&str]) {
    assert_refused(&lads_run(model, arguments).output().unwrap(), parts);
}
