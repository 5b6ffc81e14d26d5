//! The `lads` command: inspects a policy, compiles it, tests it on this machine, and drives it from
//! a pipe. No simulator, no Python.
//!
//! It is a library for programs that offer the same command or the same report elsewhere, such as
//! the Python package: [`command`] is the command, [`inspect_json`] its report as data, [`chain`]
//! its one-line form of an error.
//!
//! Every refusal ends with one line on stderr that names the thing and the remedy, and with exit
//! code 2. Files are written by [`lads_host::output`]: completely or not at all, and never over an
//! input.
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod act;
mod bench;
mod compile;
mod emit;
mod images;
mod import;
mod inspect;
mod line;
mod log;
mod model;
mod refusal;
mod seen;
mod self_test;

use std::ffi::OsString;
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

use clap::{Parser, Subcommand};
use lads_host::Opened;
use serde_json::Value;

use crate::inspect::foreign::Foreign;
use crate::model::Model;
use crate::refusal::Refusal;
pub use crate::refusal::chain;

/// Exit code of every refusal.
const REFUSED: u8 = 2;

/// Inspects, compiles, tests and drives LADS policies.
#[derive(Debug, Parser)]
#[command(name = "lads", version, arg_required_else_help = false)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Prints channels, schedule, programs, states and memory of a policy; of another ONNX file,
    /// everything that it lacks to be a policy
    ///
    /// Exit code 0 means that the file could be told about, sound or not; of a sound policy, `missing` in the JSON is empty.
    Inspect {
        /// Bundle (.onnx), compiled image (.lads), or any ONNX file
        model: PathBuf,
        /// Print one JSON object
        #[arg(long)]
        json: bool,
        /// Print the observations of the golden episode as CSV instead, one per line: input for
        /// `lads act`
        #[arg(long, conflicts_with = "json")]
        observations: bool,
    },
    /// Makes a bundle of any policy.onnx and a description of the robot: raw sensor values in,
    /// motor commands out
    Import(import::Request),
    /// Compiles a bundle to a program image, and writes it as a file, as source, or both
    Compile(compile::Request),
    /// Replays the policy's golden episode on this machine and compares the indices in force and the actions
    SelfTest {
        /// Bundle (.onnx) or compiled image (.lads)
        model: PathBuf,
    },
    /// Answers each observation (a line of stdin: CSV or JSON array) with an action (a line of stdout)
    ///
    /// A line holds the elements of all observation channels, in the policy's order. An empty line starts a new episode of the same
    /// instruction.
    Act {
        /// Bundle (.onnx) or compiled image (.lads)
        #[arg(long)]
        model: PathBuf,
        /// Instruction to follow: the text or the id of an instruction that the policy knows; none
        /// for a policy that takes none
        #[arg(long)]
        instruction: Option<String>,
        /// Where the frames of a camera come from: a folder of PNG files, one for each control step in the order of their names; with several
        /// cameras CHANNEL=FOLDER for each; or `raw` for the bytes of frames on stdin, without lines. Left out, a line has every byte
        #[arg(long, value_name = "FOLDER|raw")]
        images: Vec<String>,
        /// Append the index in force, such as that of a latent plan, to every action
        #[arg(long)]
        plans: bool,
        /// Sample indices from the policy's distribution instead of taking the likeliest
        #[arg(long)]
        sample: bool,
        /// Seed of the sampling
        #[arg(long, default_value_t = 0, requires = "sample")]
        seed: u64,
        /// Record every control step in this MCAP file, which Foxglove opens; it is complete when the input ends or the command is interrupted
        #[arg(long, value_name = "FILE")]
        log: Option<PathBuf>,
    },
    /// Measures the control loop at its real rate: latency by kind of step, deadline misses, first call, growth with the context
    Bench(bench::Request),
}

/// Runs the command with these arguments, the program's name first, and returns the exit code: 0,
/// or 2 if something was refused.
pub fn command(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let arguments = match Arguments::try_parse_from(arguments) {
        Ok(arguments) => arguments,
        Err(error) if error.use_stderr() => {
            let text = error.to_string();
            // The first paragraph is what is wrong; the rest is the usage.
            let wrong = text.split("\n\n").next().unwrap_or_default();
            eprintln!("{}; see lads --help", refusal::one_line(wrong));
            return REFUSED;
        }
        Err(help) => {
            // Help or version; a closed pipe is not a failure.
            let _ = help.print();
            return 0;
        }
    };
    match run(arguments.command) {
        Ok(()) => 0,
        Err(refusal) => {
            eprintln!("error: {refusal}");
            REFUSED
        }
    }
}

/// Returns the report that `lads inspect --json` prints on a policy that was read from `path`.
pub fn inspect_json(path: &Path, opened: &Opened) -> Value {
    inspect::Report::of(path, opened).json()
}

fn run(command: Command) -> Result<(), Refusal> {
    match command {
        Command::Bench(request) => {
            let report = bench::bench(&request)?;
            if request.json {
                print(&format!("{:#}\n", report.json()))
            } else {
                print(&report.to_string())
            }
        }
        Command::Inspect {
            model,
            json,
            observations,
        } => inspect(&model, json, observations),
        Command::Import(request) => import::import(&request),
        Command::Compile(request) => compile::compile(request),
        Command::SelfTest { model } => {
            let line = self_test::self_test(&Model::open(&model)?)?;
            print(&format!("{line}\n"))
        }
        Command::Act {
            model,
            instruction,
            images,
            plans,
            sample,
            seed,
            log,
        } => {
            let sample = sample.then_some(seed);
            let request = act::Request {
                instruction: instruction.as_deref(),
                plans,
                images: &images,
                sample,
                log: log.as_deref(),
            };
            act::act(
                &Model::open(&model)?,
                &request,
                io::stdin().lock(),
                io::stdout().lock(),
            )
        }
    }
}

fn inspect(path: &Path, json: bool, observations: bool) -> Result<(), Refusal> {
    let model = match Model::open(path) {
        Ok(model) => model,
        Err(refusal) => {
            let foreign = Foreign::look(path, &refusal).filter(|_| !observations);
            return match foreign.ok_or(refusal)? {
                foreign if json => print(&format!("{:#}\n", foreign.json())),
                foreign => print(&foreign.to_string()),
            };
        }
    };
    if observations {
        return print(&inspect::observations(&model)?);
    }
    let report = inspect::Report::of(&model.path, model.opened());
    if json {
        print(&format!("{:#}\n", report.json()))
    } else {
        print(&report.to_string())
    }
}

/// Prints to stdout; a closed reader is not an error. Whatever a file's names hold, nothing but lines reaches the terminal.
fn print(text: &str) -> Result<(), Refusal> {
    let text = &refusal::without_controls(text);
    let mut stdout = io::stdout().lock();
    match stdout
        .write_all(text.as_bytes())
        .and_then(|()| stdout.flush())
    {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(Refusal::new(
            "stdout",
            error,
            "connect it to a reader or a place with room",
        )),
        _ => Ok(()),
    }
}
