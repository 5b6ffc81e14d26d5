//! `lads-run`: drives a bundle's policy through the simulated environment that its contract names, and reports success rates and latency;
//! its subcommands verify and tune the policy, replay and encode recordings, sweep over faults, show and film episodes, compare policies.
//!
//! Everything that can be wrong is looked at before the first episode: arguments, the place for the JSON, the bundle, its golden episode,
//! the instruction, the assets, and whether contract and environment fit. Any of it ends with one line on stderr and exit code 2, or with a
//! line for each of several files; an
//! interrupt ends with exit code 130. Files are written only after the last episode, to a temporary file that is then
//! renamed; `frames` alone keeps what it has, and goes on with it.
//! `verify` runs a reference's episodes, and its verdict is the exit code: 0 equivalent, 1 different, 3 inconclusive.
#![forbid(unsafe_code)]

mod arguments;
mod bench;
mod compare;
mod end;
mod frames;
mod language;
mod program;
mod record;
mod recordings;
mod report;
mod rollouts;
mod sweep;
mod tune;
mod verify;
mod viewer;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use arguments::{Arguments, Job, MOVED};
use end::{End, refused};
use indicatif::ProgressBar;
use lads_sim::evaluate::EvaluationError;
use lads_sim::{command, output};
use rollouts::Extra;
use signal_hook::consts::SIGINT;
use signal_hook::flag;

/// Exit code after an interrupt, as shells have it: 128 and the signal's number.
const INTERRUPTED: u8 = 130;

fn main() -> ExitCode {
    #[cfg(all(unix, feature = "camera"))]
    lads_sim::film::driver::draw_on_own_thread();
    let arguments: Arguments = match command::arguments_moved("lads-run", &MOVED) {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    match run(&arguments) {
        Ok(code) => code,
        Err(End::Interrupted) => {
            eprintln!("interrupted: nothing was written");
            ExitCode::from(INTERRUPTED)
        }
        Err(End::Refused(line)) => command::refuse(line),
        Err(End::AllRefused(lines)) => {
            for line in &lines {
                command::refuse(line);
            }
            ExitCode::from(command::REFUSED)
        }
    }
}

fn run(arguments: &Arguments) -> Result<ExitCode, End> {
    let stop = stop_on_interrupt()?;
    let job = match arguments {
        Arguments::Run(run) => {
            let extra = Extra {
                uniform: run.uniform,
                report: run.report.as_deref(),
                ..Extra::default()
            };
            return rollouts::run(&run.rollouts, &extra, &stop);
        }
        Arguments::Other(job) => job,
    };
    match job {
        Job::Verify(verify) => verify::run(verify, &stop),
        Job::Tune(asked) => tune::run(asked, &stop),
        Job::Replay(replay) => recordings::replay(replay),
        Job::Encode(encode) => recordings::encode(encode),
        Job::Report(asked) => compare::run(asked, &stop),
        Job::Frames(asked) => frames::run(asked, &stop),
        Job::Sweep(asked) => sweep::run(asked, &stop),
        Job::View(asked) => {
            let extra = Extra {
                viewer: true,
                ..Extra::default()
            };
            rollouts::run(asked, &extra, &stop)
        }
        Job::Record(record) => {
            let extra = Extra {
                record: Some(record),
                ..Extra::default()
            };
            rollouts::run(&record.rollouts, &extra, &stop)
        }
    }
}

/// Returns a flag that an interrupt raises; a second interrupt ends the program at once.
fn stop_on_interrupt() -> Result<Arc<AtomicBool>, End> {
    let stop = Arc::new(AtomicBool::new(false));
    let refuse = |error| {
        refused(format!(
            "interrupts cannot be handled ({error}); run it in another shell"
        ))
    };
    // In the order of the calls: at the first interrupt the flag is not raised yet.
    let code = i32::from(INTERRUPTED);
    flag::register_conditional_shutdown(SIGINT, code, Arc::clone(&stop)).map_err(refuse)?;
    flag::register(SIGINT, Arc::clone(&stop)).map_err(refuse)?;
    // With a handler, a file that may not grow (`ulimit -f`) is an error of the write, and not the end of the run.
    #[cfg(unix)]
    flag::register(signal_hook::consts::SIGXFSZ, Arc::default()).map_err(refuse)?;
    Ok(stop)
}

/// Lists the files that were named.
fn given<'p>(
    files: impl IntoIterator<Item = (&'p str, Option<&'p PathBuf>)>,
) -> Vec<output::Named<'p>> {
    let files = files.into_iter();
    files
        .filter_map(|(option, path)| Some((option, path?.as_path())))
        .collect()
}

/// Returns the number of threads to run on: as asked for, else one per core, or one where a window shows the episodes.
fn threads(asked: Option<usize>, viewer: bool) -> Result<usize, End> {
    match asked {
        Some(0) => Err(refused(
            "--threads 0: no thread to run the episodes; give at least 1",
        )),
        Some(threads) if threads > 1 && viewer => Err(refused(format!(
            "view --threads {threads}: a window shows one episode at a time; leave --threads out"
        ))),
        Some(threads) => Ok(threads),
        None if viewer => Ok(1),
        None => Ok(std::thread::available_parallelism().map_or(1, usize::from)),
    }
}

/// Refuses a run of zero episodes.
fn some_episodes(episodes: Option<u32>) -> Result<(), End> {
    if episodes == Some(0) {
        return Err(refused("--episodes 0: nothing to run; give at least 1"));
    }
    Ok(())
}

/// Makes a progress bar over episodes; indicatif hides it where stderr is not a terminal.
fn progress(episodes: usize) -> ProgressBar {
    progress_over(episodes, "episodes")
}

/// Makes a progress bar over `count` things.
fn progress_over(count: usize, things: &str) -> ProgressBar {
    command::progress(count, things)
}

/// Converts the error of an evaluation to the end of the run.
fn unfinished(error: EvaluationError) -> End {
    match error {
        EvaluationError::Interrupted => End::Interrupted,
        error => refused(format!(
            "{error}; run this instruction alone with the same seed to look into it"
        )),
    }
}
