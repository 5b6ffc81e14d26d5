//! The program under test.

use std::path::Path;
use std::process::Command;

/// `lads-run` with a model that ships.
pub fn lads_run(model: &str, arguments: &[&str]) -> Command {
    let model = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../models")
        .join(model);
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads-run"));
    command.arg("--model").arg(model).args(arguments);
    command
}
