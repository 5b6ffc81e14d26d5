//! What the harness's commands share: arguments that are refused in one line, and exit code 2 for everything refused.

use std::fmt::Display;
use std::process::ExitCode;

use clap::Parser;

/// Exit code of everything that was refused.
pub const REFUSED: u8 = 2;

/// The arguments of command `name`; else the exit code, after one line on stderr, or after the help on stdout.
pub fn arguments<A: Parser>(name: &str) -> Result<A, ExitCode> {
    A::try_parse().map_err(|error| {
        if !error.use_stderr() {
            // Help or version; a closed pipe is no failure.
            let _ = error.print();
            return ExitCode::SUCCESS;
        }
        let text = error.to_string();
        // The first paragraph is what is wrong; the rest is the usage.
        let wrong = text.split("\n\n").next().unwrap_or_default();
        eprintln!("{}; see {name} --help", one_line(wrong));
        ExitCode::from(REFUSED)
    })
}

/// Says what is refused, in one line whatever the errors underneath contain.
pub fn refuse(wrong: impl Display) -> ExitCode {
    eprintln!("error: {}", one_line(&wrong.to_string()));
    ExitCode::from(REFUSED)
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
