//! Measures everything and writes `benches/RESULTS.md`, `benches/results.json` and the charts: `make bench`.
//!
//! What can fail ends with one line on stderr and exit code 2, and leaves the files as they were.
#![forbid(unsafe_code)]

mod charts;
mod cold;
mod criterion;
mod files;
mod growth;
mod machine;
mod markdown;
mod measure;
mod page;
mod plain;
mod regression;
mod rows;

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::Instant;

use clap::Parser;
use lads_benches::bundle;
use lads_benches::peers::Peers;
use lads_benches::peers::onnxruntime::OnnxRuntime;
use lads_benches::peers::recompute::Recompute;
use lads_benches::peers::{cut::Source, tract::Tract};
use lads_compiler::{Bundle, WeightFormat, compile, compile_with};
use lads_core::Policy;
use lads_host::Aligned;
use lads_pace::BenchError;
use lads_pace::clock::now;
use lads_pace::contender::{Contender, Episode};
use lads_pace::stats::{median, quantile};
use lads_pace::suite::{AUTO, Candidate, options, with_contenders};
use serde_json::{Value, json};

use crate::measure::Bare;

/// Numbers of repetitions of the measurements.
#[derive(Debug, Clone, Copy)]
pub struct Effort {
    hot_rounds: usize,
    recompute_rounds: usize,
    paced_rounds: usize,
    paced_all_rounds: usize,
    load_rounds: usize,
    context_rounds: usize,
    growth_rounds: usize,
    plain_rounds: usize,
    processes: usize,
}

impl Effort {
    const FULL: Self = Self {
        hot_rounds: 60,
        recompute_rounds: 6,
        paced_rounds: 110,
        paced_all_rounds: 10,
        load_rounds: 16,
        context_rounds: 6,
        growth_rounds: 8,
        plain_rounds: 50,
        processes: 15,
    };
    const QUICK: Self = Self {
        hot_rounds: 8,
        recompute_rounds: 2,
        paced_rounds: 4,
        paced_all_rounds: 2,
        load_rounds: 2,
        context_rounds: 2,
        growth_rounds: 2,
        plain_rounds: 2,
        processes: 3,
    };
}

/// Measures everything and writes the page of results.
#[derive(Debug, Parser)]
struct Arguments {
    /// The shared library of ONNX Runtime
    #[arg(long, default_value = "vendor/onnxruntime/libonnxruntime.so")]
    onnxruntime: PathBuf,
    /// A Python with PyTorch, OpenVINO and the exporter
    #[arg(long, default_value = ".venv/bin/python")]
    python: PathBuf,
    /// Folder for the page, its numbers and charts
    #[arg(long, default_value = "benches")]
    output: PathBuf,
    /// Folder for bundles and models that are made on the way
    #[arg(long, default_value = "target/bench")]
    scratch: PathBuf,
    /// Criterion's folder
    #[arg(long, default_value = "target/criterion")]
    criterion: PathBuf,
    /// A tenth of the measurements: to try the machinery, not for numbers
    #[arg(long)]
    quick: bool,
    /// Open this image in a fresh process and time its first steps
    #[arg(long, hide = true)]
    cold: Option<PathBuf>,
    /// Warm up first
    #[arg(long, hide = true)]
    warm: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let outcome = match &arguments.cold {
        Some(image) => cold::child(image, arguments.warm),
        None => run(&arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn about(thing: impl std::fmt::Display, error: impl std::fmt::Display) -> BenchError {
    BenchError::new(thing, error, "run make bench, which prepares everything")
}

fn say(text: &str) {
    eprintln!("{text}");
}

/// Compiles the shipped policy with the weights stored in every way that gives the same plans, and as
/// it was tuned.
fn images(bundle: &Bundle) -> Result<Vec<(&'static str, Aligned)>, BenchError> {
    let mut images = vec![];
    for weights in WeightFormat::ALL {
        let full = weights == WeightFormat::F32;
        match compile_with(bundle, &options(Some(weights))) {
            Ok(image) => images.push((weights.name(), Aligned::new(image.as_bytes()))),
            Err(error) if full => return Err(about("models/kitchen.onnx", error)),
            Err(error) => say(&format!("without {} weights: {error}", weights.name())),
        }
    }
    let tuned = compile_with(bundle, &options(None));
    let tuned = tuned.map_err(|error| about("models/kitchen.onnx", error))?;
    images.push((AUTO, Aligned::new(tuned.as_bytes())));
    Ok(images)
}

/// Formats that the paced run for the tails measures.
const FOR_TAILS: [&str; 4] = ["f32", "int16", "f16", AUTO];

#[expect(clippy::too_many_lines, reason = "the order of the run, step by step")]
fn run(arguments: &Arguments) -> Result<(), BenchError> {
    let started = Instant::now();
    let effort = if arguments.quick {
        Effort::QUICK
    } else {
        Effort::FULL
    };
    let path = bundle();
    let bytes = std::fs::read(&path).map_err(|error| about(path.display(), error))?;
    let opened = Bundle::from_bytes(&bytes).map_err(|error| about(path.display(), error))?;
    let images = images(&opened)?;
    std::fs::create_dir_all(&arguments.scratch)
        .map_err(|error| about(arguments.scratch.display(), error))?;

    say("preparation: compile and open");
    let preparation = preparation(&bytes, &opened, &images, effort)?;
    say("first steps of fresh processes");
    let image_file = arguments.scratch.join("kitchen.lads");
    lads_host::output::write(&image_file, images[0].1.as_bytes())
        .map_err(|error| about(image_file.display(), error))?;
    let cold = cold::measure(&image_file, effort.processes)?;

    let mut candidates = vec![];
    for (weights, image) in &images {
        let image = image.as_bytes();
        let policy = Policy::new_checked(image).map_err(|error| about("the image", error))?;
        candidates.push(Candidate::new(weights, image, &policy));
    }
    let main_peers = Peers {
        bundle: bytes.clone(),
        onnxruntime: Some(arguments.onnxruntime.clone()),
        ..Peers::default()
    };
    let all_peers = Peers {
        crates: true,
        python: Some((arguments.python.clone(), path.clone())),
        ..main_peers.clone()
    };
    let act_bytes = low_level_bytes(&bytes)?;

    say("beside all peers: hot");
    let whole = export_recompute(arguments, &candidates)?;
    let bare = || -> Vec<Box<dyn Contender>> {
        let bare = [("f32", act_bytes), ("f16", act_bytes / 2)];
        bare.map(|(label, bytes)| Box::new(Bare::new(label, bytes)) as Box<dyn Contender>)
            .into()
    };
    let mut guests = bare();
    guests.extend(recomputes(arguments, &whole));
    let (field, hot, paced_all, contexts) =
        with_contenders(&candidates, &all_peers, guests, |field, contenders| {
            let hot = measure::hot(field, contenders, effort, &mut |_| ())?;
            say("beside all peers: at 50 Hz");
            let rounds = effort.paced_all_rounds;
            let paced = measure::paced(field, contenders, rounds, 0, &mut |_| ())?;
            say("growth with the context");
            let contexts = measure::contexts(field, contenders, effort)?;
            let entrants = json!({
                "entrants": field.entrants, "absent": field.absent, "words": field.words,
            });
            Ok((entrants, hot, paced, contexts))
        })?;
    let tails: Vec<_> = candidates
        .iter()
        .filter(|candidate| FOR_TAILS.contains(&candidate.weights))
        .copied()
        .collect();
    say("beside ONNX Runtime: at 50 Hz, for the tails");
    let (paced, loaded) = with_contenders(&tails, &main_peers, bare(), |field, contenders| {
        let rounds = effort.paced_rounds;
        let paced = measure::paced(field, contenders, rounds, 0, &mut |_| ())?;
        say("the same beside a thread that thrashes the caches");
        let loaded = measure::paced(field, contenders, effort.load_rounds, 1, &mut |_| ())?;
        Ok((paced, loaded))
    })?;

    say("growth with the network");
    let folder = arguments.scratch.join("growth");
    let grown = export_growth(arguments, &folder)
        .and_then(|()| growth::measure(&folder, &arguments.onnxruntime, effort, &mut say));
    let (grown, not_grown) = match grown {
        Ok(grown) => (grown, None),
        Err(error) => (vec![], Some(error.to_string())),
    };

    say("policies of one entry");
    let folder = arguments.scratch.join("plain");
    // The last that the script writes.
    made(arguments, &folder.join("history.onnx"), |python| {
        python.arg(script("plain.py")).arg(&folder);
    })?;
    let plain = plain::measure(&folder, &arguments.onnxruntime, effort, &mut say)?;

    let measured = files::Measured {
        machine: machine::describe(),
        field,
        preparation,
        cold,
        hot,
        paced_all,
        paced,
        loaded,
        contexts,
        growth: grown,
        not_grown,
        plain,
        criterion: criterion::collect(&arguments.criterion),
        quick: arguments.quick,
        seconds: started.elapsed().as_secs_f64(),
    };
    let rows = rows::rows(&measured);
    let before = regression::committed(&arguments.output);
    let changes = regression::compare(&rows, &measured.machine["cpu"], before.as_ref());
    for warning in &changes.warnings {
        say(&format!("warning: {warning}"));
    }
    files::write(&arguments.output, &measured, &rows, &changes)?;
    say(&format!(
        "{} in {:.0} s",
        arguments.output.join("RESULTS.md").display(),
        measured.seconds
    ));
    Ok(())
}

/// Size of the low level's weights with 32 bits, in bytes.
fn low_level_bytes(bundle: &[u8]) -> Result<usize, BenchError> {
    let act = Source::new(bundle)?.cut("low_level/act")?;
    // All but some hundred bytes of this model are its weights; cache lines are the unit in any case.
    Ok(act.len() / 64 * 64)
}

/// Measures compiling and opening, and lists sizes.
fn preparation(
    bytes: &[u8],
    bundle: &Bundle,
    images: &[(&'static str, Aligned)],
    effort: Effort,
) -> Result<Value, BenchError> {
    let spread = |took: &[f64]| json!({ "median": median(took), "low": quantile(took, 0.25), "high": quantile(took, 0.75) });
    let timed = |times: usize, call: &mut dyn FnMut() -> Result<(), BenchError>| {
        let mut took = vec![];
        for _ in 0..times {
            let start = now();
            call()?;
            took.push((now() - start) as f64 / 1e6);
        }
        Ok::<_, BenchError>(spread(&took))
    };
    let refuse = |error: &dyn std::fmt::Display| about("models/kitchen.onnx", error);
    let read = timed(effort.processes, &mut || {
        Bundle::from_bytes(bytes)
            .map(drop)
            .map_err(|error| refuse(&error))
    })?;
    let compiled = timed(effort.processes, &mut || {
        compile(bundle).map(drop).map_err(|error| refuse(&error))
    })?;
    let mut sizes = vec![];
    for (weights, image) in images {
        let bytes = image.as_bytes();
        let opened = timed(20 * effort.processes, &mut || {
            Policy::new_checked(bytes)
                .map(drop)
                .map_err(|error| refuse(&error))
        })?;
        let policy = Policy::new_checked(bytes).map_err(|error| refuse(&error))?;
        sizes.push(json!({
            "weights": weights,
            "image_bytes": bytes.len(),
            "workspace_bytes": 4 * (policy.arena_len() + policy.state_len()),
            "open_ms": opened,
        }));
    }
    Ok(
        json!({ "read_ms": read, "compile_ms": compiled, "images": sizes, "bundle_bytes": bytes.len() }),
    )
}

/// Exports the model without a cache at the last control step of an episode; returns its path, or why there is none.
fn export_recompute(
    arguments: &Arguments,
    candidates: &[Candidate<'_>],
) -> Result<Result<PathBuf, String>, BenchError> {
    let policy =
        Policy::new_checked(candidates[0].image).map_err(|error| about("the image", error))?;
    let episode = Episode::of(&policy)?;
    let steps = episode.context_steps;
    let observations: Vec<_> = (0..steps).map(|step| episode.observation(step)).collect();
    let actions =
        (1..steps).map(|step| &episode.recorded[(step - 1) % episode.recorded.len()].action);
    let file = arguments.scratch.join("episode.json");
    let content = json!({
        "instruction": episode.instruction, "observations": observations, "actions": actions.collect::<Vec<_>>(),
    });
    lads_host::output::write(&file, content.to_string().as_bytes())
        .map_err(|error| about(file.display(), error))?;
    let model = arguments.scratch.join("recompute.onnx");
    let done = Command::new(&arguments.python)
        .arg(script("recompute.py"))
        .arg(bundle())
        .arg(&file)
        .arg(&model)
        .output();
    Ok(match done {
        Ok(output) if output.status.success() => Ok(model),
        Ok(output) => Err(String::from_utf8_lossy(&output.stderr)
            .lines()
            .last()
            .unwrap_or("no reason")
            .to_owned()),
        Err(error) => Err(format!("{}: {error}", arguments.python.display())),
    })
}

/// Measures the model without a cache, on the runtimes that take it.
fn recomputes(arguments: &Arguments, model: &Result<PathBuf, String>) -> Vec<Box<dyn Contender>> {
    let model = match model {
        Ok(model) => model,
        Err(error) => {
            say(&format!("no model without a cache: {error}"));
            return vec![];
        }
    };
    let mut open: Vec<Box<dyn Contender>> = vec![];
    let onnxruntime =
        OnnxRuntime::new(&arguments.onnxruntime).and_then(|engine| Recompute::new(&engine, model));
    for opened in [onnxruntime, Recompute::new(&Tract, model)] {
        match opened {
            Ok(contender) => open.push(Box::new(contender)),
            Err(error) => say(&error.to_string()),
        }
    }
    open
}

/// Path of a script of this crate.
fn script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("python")
        .join(name)
}

/// Makes the random bundles that grow with the exporter, unless they exist.
fn export_growth(arguments: &Arguments, folder: &Path) -> Result<(), BenchError> {
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../exporter/configs/kitchen.toml");
    made(arguments, &folder.join("index.json"), |python| {
        python.args(["-m", "lads_exporter", "growth", "--config"]);
        python.arg(config).arg("-o").arg(folder);
    })
}

/// Runs Python, unless the file that it makes is there.
fn made(
    arguments: &Arguments,
    file: &Path,
    call: impl FnOnce(&mut Command),
) -> Result<(), BenchError> {
    if file.is_file() {
        return Ok(());
    }
    let mut python = Command::new(&arguments.python);
    call(&mut python);
    let output = python
        .output()
        .map_err(|error| about(arguments.python.display(), error))?;
    if output.status.success() {
        return Ok(());
    }
    let reason = String::from_utf8_lossy(&output.stderr);
    Err(about(
        "the random bundles",
        reason.lines().last().unwrap_or("no reason"),
    ))
}
