//! The `lads` command, implemented by [`lads_cli`].
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(lads_cli::command(std::env::args_os()))
}
