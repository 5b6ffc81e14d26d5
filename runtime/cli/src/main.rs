//! The `lads` command: looks into a policy, compiles it, tests it on this machine, and drives it from a pipe. No simulator, no Python.
//!
//! Whatever is refused ends with one line on stderr that names the thing and the remedy, and with exit code 2. Files are written as
//! [`lads_host::output`] has it: whole or not at all, and never over what is read.
#![forbid(unsafe_code)]

mod act;
mod bench;
mod emit;
mod inspect;
mod line;
mod model;
mod refusal;
mod self_test;

use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use lads_compiler::{CacheFormat, Options, WeightFormat};
use lads_host::output;

use crate::model::Model;
use crate::refusal::Refusal;

/// Exit code of everything that was refused.
const REFUSED: u8 = 2;

/// Looks into, compiles, tests and drives LADS policies.
#[derive(Debug, Parser)]
#[command(version, arg_required_else_help = false)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Prints contract, programs, and the sizes of image, workspace and weights
    Inspect {
        /// Bundle (.onnx) or compiled image (.lads)
        model: PathBuf,
        /// As one JSON object
        #[arg(long)]
        json: bool,
        /// Instead, the observations of the golden episode as CSV, one per line: input for `lads act`
        #[arg(long, conflicts_with = "json")]
        observations: bool,
    },
    /// Compiles a bundle to a program image, and writes it as a file, as source, or both
    Compile {
        /// Bundle (.onnx); with --emit-c or --emit-rust also a compiled image (.lads)
        model: PathBuf,
        /// The image to write
        #[arg(short, long, required_unless_present_any = ["emit_c", "emit_rust"])]
        output: Option<PathBuf>,
        /// A C source to write: the image as a constant, aligned byte array
        #[arg(long, value_name = "FILE")]
        emit_c: Option<PathBuf>,
        /// A Rust source to write: the image as a constant, aligned byte array
        #[arg(long, value_name = "FILE")]
        emit_rust: Option<PathBuf>,
        /// How the weights are stored: f32; int16 or int8, with which the inputs of a layer are rounded too, and which are faster
        /// than f32 on x86-64; f16 or bf16, which are decoded. Fewer bits than 32 have to pass a gate: the golden episode replays
        /// with the same plans, and with actions inside the tolerance
        #[arg(long, value_name = "FORMAT", default_value = "f32", value_parser = weight_format)]
        weights: WeightFormat,
        /// How the weights of the low level are stored, if otherwise: with f32 the actions of a plan keep their bits, and all
        /// that fewer bits elsewhere can do is to choose another plan
        #[arg(long, value_name = "FORMAT", value_parser = weight_format)]
        low_level: Option<WeightFormat>,
        /// How the KV cache is stored: f32, or f16 in half the memory. It has to pass the same gate
        #[arg(long, value_name = "FORMAT", default_value = "f32", value_parser = cache_format)]
        cache: CacheFormat,
        /// Largest difference of an action that the gate, and later the image's self-test, accept, in the action's units; the
        /// bundle's own is meant for 32-bit weights
        #[arg(long, value_name = "DIFFERENCE", value_parser = tolerance)]
        tolerance: Option<f32>,
        /// Writes an image that the gate refuses, for experiments; its self-test fails
        #[arg(long)]
        force: bool,
    },
    /// Replays the policy's golden episode on this machine and compares plans and actions
    SelfTest {
        /// Bundle (.onnx) or compiled image (.lads)
        model: PathBuf,
    },
    /// Answers each observation (a line of stdin: CSV or JSON array) with an action (a line of stdout)
    ///
    /// An empty line starts a new episode of the same instruction.
    Act {
        /// Bundle (.onnx) or compiled image (.lads)
        #[arg(long)]
        model: PathBuf,
        /// What to do: the text or the id of an instruction that the policy knows
        #[arg(long)]
        instruction: String,
        /// Append the index of the latent plan in force to every action
        #[arg(long)]
        plans: bool,
        /// Sample plans from the policy's distribution instead of taking the likeliest
        #[arg(long)]
        sample: bool,
        /// Seed of the sampling
        #[arg(long, default_value_t = 0, requires = "sample")]
        seed: u64,
    },
    /// Measures the control loop at its real rate: latency by kind of step, deadline misses, first call, growth with the context
    Bench(bench::Request),
}

fn main() -> ExitCode {
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) if error.use_stderr() => {
            let text = error.to_string();
            // The first paragraph is what is wrong; the rest is the usage.
            let wrong = text.split("\n\n").next().unwrap_or_default();
            eprintln!("{}; see lads --help", refusal::one_line(wrong));
            return ExitCode::from(REFUSED);
        }
        Err(help) => {
            // Help or version; a closed pipe is no failure.
            let _ = help.print();
            return ExitCode::SUCCESS;
        }
    };
    match run(arguments.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(refusal) => {
            eprintln!("error: {refusal}");
            ExitCode::from(REFUSED)
        }
    }
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
        } => {
            let model = Model::open(&model)?;
            if observations {
                return print(&inspect::observations(&model)?);
            }
            let report = inspect::Report::of(&model)?;
            if json {
                print(&format!("{:#}\n", report.json()))
            } else {
                print(&report.to_string())
            }
        }
        Command::Compile {
            model,
            output,
            emit_c,
            emit_rust,
            weights,
            low_level,
            cache,
            tolerance,
            force,
        } => {
            let options = Options {
                weights,
                low_level,
                cache,
                tolerance,
                force,
            };
            let files = Files {
                output,
                emit_c,
                emit_rust,
            };
            files.check(&model)?;
            let model = Model::compile(&model, options)?;
            let again = files.output.is_some() || options != Options::default();
            if again && !model.is_bundle() {
                return Err(Refusal::new(
                    model.path.display(),
                    "it is a compiled image already",
                    "give the bundle (.onnx)",
                ));
            }
            model.policy()?;
            files.write(model.image())?;
            if options.is_exact() || force {
                return Ok(());
            }
            let line = self_test::self_test(&model)?;
            print(&format!("{options}: {line}\n"))
        }
        Command::SelfTest { model } => {
            let line = self_test::self_test(&Model::open(&model)?)?;
            print(&format!("{line}\n"))
        }
        Command::Act {
            model,
            instruction,
            plans,
            sample,
            seed,
        } => {
            let sample = sample.then_some(seed);
            let request = act::Request {
                instruction: &instruction,
                plans,
                sample,
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

/// The files that `lads compile` writes.
struct Files {
    output: Option<PathBuf>,
    emit_c: Option<PathBuf>,
    emit_rust: Option<PathBuf>,
}

impl Files {
    /// Whether all can be written, before any work; `model` is read.
    fn check(&self, model: &Path) -> Result<(), Refusal> {
        let outputs = [
            ("-o", &self.output),
            ("--emit-c", &self.emit_c),
            ("--emit-rust", &self.emit_rust),
        ];
        let outputs = outputs.into_iter();
        let outputs: Vec<_> = outputs
            .filter_map(|(option, path)| Some((option, path.as_deref()?)))
            .collect();
        output::check(&[("", model)], &outputs).map_err(Refusal::of)
    }

    /// Writes them; everything that can be refused is, before the first one is in its place.
    fn write(&self, image: &[u8]) -> Result<(), Refusal> {
        let mut drafts = vec![];
        let mut draft = |path: &PathBuf, bytes: &[u8]| {
            let draft = output::draft(path).and_then(|mut draft| {
                draft.write_all(bytes)?;
                Ok(draft)
            });
            let draft = draft.map_err(|error| unwritable(path, &error))?;
            drafts.push((path.clone(), bytes.len(), draft));
            Ok(())
        };
        if let Some(path) = &self.output {
            draft(path, image)?;
        }
        if let Some(path) = &self.emit_c {
            draft(path, emit::c(image, path)?.as_bytes())?;
        }
        if let Some(path) = &self.emit_rust {
            draft(path, emit::rust(image, path)?.as_bytes())?;
        }
        for (path, bytes, draft) in drafts {
            draft.commit().map_err(|error| unwritable(&path, &error))?;
            print(&format!("{}: {bytes} bytes\n", path.display()))?;
        }
        Ok(())
    }
}

fn weight_format(name: &str) -> Result<WeightFormat, String> {
    named(name, WeightFormat::ALL, WeightFormat::name)
}

fn cache_format(name: &str) -> Result<CacheFormat, String> {
    named(name, CacheFormat::ALL, CacheFormat::name)
}

fn named<T: Copy, const N: usize>(
    name: &str,
    known: [T; N],
    name_of: fn(T) -> &'static str,
) -> Result<T, String> {
    let found = known.into_iter().find(|&format| name_of(format) == name);
    found.ok_or_else(|| format!("known are {}", known.map(name_of).join(", ")))
}

fn tolerance(text: &str) -> Result<f32, String> {
    let number: Option<f32> = text.parse().ok();
    let positive = number.filter(|number| number.is_finite() && *number > 0.0);
    positive.ok_or_else(|| "it has to be a positive number".into())
}

/// Prints to stdout; a reader that has left is no failure.
fn print(text: &str) -> Result<(), Refusal> {
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

fn unwritable(path: &Path, error: &io::Error) -> Refusal {
    Refusal::new(
        path.display(),
        error,
        "name a file in an existing, writable folder",
    )
}
