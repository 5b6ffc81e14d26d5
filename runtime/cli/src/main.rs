//! The `lads` command, implemented by [`lads_cli`].
#![forbid(unsafe_code)]

use std::process::ExitCode;
#[cfg(unix)]
use std::sync::Arc;

fn main() -> ExitCode {
    // With a handler, a file that may not grow (`ulimit -f`) is an error of the write, and not the end of the policy.
    #[cfg(unix)]
    let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::default());
    ExitCode::from(lads_cli::command(std::env::args_os()))
}
