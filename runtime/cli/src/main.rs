//! The `lads` command; [`lads_cli`] has what it does.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(lads_cli::command(std::env::args_os()))
}
