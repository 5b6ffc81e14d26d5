//! Makes the command line of the program under test.

use std::path::Path;
use std::process::Command;

/// Makes a `lads-run` command with a shipped model.
pub fn lads_run(model: &str, arguments: &[&str]) -> Command {
    let model = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../models")
        .join(model);
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads-run"));
    // Another job than the main one comes first.
    let (job, rest) = match arguments {
        [job, rest @ ..] if !job.starts_with('-') => (Some(job), rest),
        _ => (None, arguments),
    };
    command.args(job).arg("--model").arg(model).args(rest);
    command
}
