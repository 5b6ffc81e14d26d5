//! Shared by the harness's commands: arguments that are refused in one line, and exit code 2 for everything refused.

use std::fmt::Display;
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use clap::error::{ContextKind, ContextValue};
use indicatif::{ProgressBar, ProgressStyle};

/// Exit code of everything that was refused.
pub const REFUSED: u8 = 2;

/// Parses the arguments of command `name`; on failure gives the exit code, after one line on stderr, or after the help on stdout.
pub fn arguments<A: Parser>(name: &str) -> Result<A, ExitCode> {
    arguments_moved(name, &[])
}

/// Parses the arguments of command `name`, and tells a user of one of the `moved` options what replaces it.
pub fn arguments_moved<A: Parser>(name: &str, moved: &[(&str, &str)]) -> Result<A, ExitCode> {
    A::try_parse().map_err(|error| {
        if !error.use_stderr() {
            // Help or version; a closed pipe is not a failure.
            let _ = error.print();
            return ExitCode::SUCCESS;
        }
        let unknown = match error.get(ContextKind::InvalidArg) {
            Some(ContextValue::String(option)) => option.as_str(),
            _ => "",
        };
        if let Some((option, now)) = moved.iter().find(|(option, _)| *option == unknown) {
            eprintln!("error: {option} is a command of its own now: {now}; see {name} --help");
            return ExitCode::from(REFUSED);
        }
        let text = error.to_string();
        // The first paragraph is what is wrong; the rest is the usage.
        let wrong = text.split("\n\n").next().unwrap_or_default();
        eprintln!("{}; see {name} --help", one_line(wrong));
        ExitCode::from(REFUSED)
    })
}

/// Prints why the command refuses, in one line whatever the errors underneath contain, and gives the exit code.
pub fn refuse(wrong: impl Display) -> ExitCode {
    eprintln!("error: {}", one_line(&wrong.to_string()));
    ExitCode::from(REFUSED)
}

/// A progress bar over `count` things, as wide as the terminal leaves room; indicatif hides it where stderr is not a terminal.
pub fn progress(count: usize, things: &str) -> ProgressBar {
    let bar = ProgressBar::new(count as u64).with_style(style(things));
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}

/// Style of progress bars; everything beside the bar fits into 40 columns.
fn style(things: &str) -> ProgressStyle {
    let style = ProgressStyle::with_template(&format!(
        "{{wide_bar}} {{pos}}/{{len}} {things} {{elapsed}}, {{eta}} left {{msg}}"
    ));
    style.unwrap_or_else(|_| ProgressStyle::default_bar())
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use indicatif::{InMemoryTerm, ProgressDrawTarget};

    use super::*;

    #[test]
    fn a_narrow_terminal_has_one_line_of_progress() {
        for columns in [40, 80, 200] {
            let terminal = InMemoryTerm::new(6, columns);
            let target = ProgressDrawTarget::term_like(Box::new(terminal.clone()));
            let bar = ProgressBar::with_draw_target(Some(500), target);
            bar.set_style(style("episodes"));
            bar.inc(123);
            bar.tick();
            let shown = terminal.contents();
            assert_eq!(shown.lines().count(), 1, "{columns}: {shown}");
            assert!(shown.contains("123/500 episodes"), "{columns}: {shown}");
            bar.finish_and_clear();
            assert_eq!(terminal.contents(), "", "{columns}");
        }
    }
}
