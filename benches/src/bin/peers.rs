//! Measures lads and its peers in turns, by the protocol of `lads bench`.
//!
//! What can fail ends with one line on stderr and exit code 2.
#![forbid(unsafe_code)]

use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use lads_benches::peers::Peers;
use lads_compiler::WeightFormat;
use lads_pace::BenchError;
use lads_pace::paced::{Protocol, Report, measure};
use lads_pace::suite::{AUTO, Candidate, options};

/// Measures a policy at its real rate beside ONNX Runtime, tract and rten, and with a Python beside PyTorch and OpenVINO.
#[derive(Debug, Parser)]
struct Arguments {
    /// Bundle (.onnx)
    #[arg(long)]
    model: PathBuf,
    /// Control steps per second
    #[arg(long, default_value_t = 50.0)]
    rate: f64,
    /// Seconds for each contender
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// Threads that thrash the caches and compute beside it
    #[arg(long, default_value_t = 0)]
    load: usize,
    /// Formats of the weights to measure, side by side: auto, as the bundle was tuned, or one for all weights, of 16 bits or fewer with a cache of 16
    #[arg(long, value_delimiter = ',', default_value = AUTO)]
    weights: Vec<String>,
    /// The shared library of ONNX Runtime
    #[arg(long, default_value = "vendor/onnxruntime/libonnxruntime.so")]
    onnxruntime: PathBuf,
    /// A Python that has onnx and PyTorch or OpenVINO
    #[arg(long)]
    python: Option<PathBuf>,
    /// As one JSON object
    #[arg(long)]
    json: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match run(&arguments) {
        Ok(report) if arguments.json => println!("{:#}", report.json()),
        Ok(report) => print!("{report}"),
        Err(error) => {
            eprintln!("error: {error}");
            return ExitCode::from(2);
        }
    }
    ExitCode::SUCCESS
}

fn run(arguments: &Arguments) -> Result<Report, BenchError> {
    let path = &arguments.model;
    let bundle = lads_host::input::read(path)
        .map_err(|error| BenchError::new(path.display(), error, "name a bundle (.onnx)"))?;
    let mut models = vec![];
    for name in &arguments.weights {
        let known = WeightFormat::ALL
            .into_iter()
            .find(|format| format.name() == name);
        if known.is_none() && name != AUTO {
            let known = WeightFormat::ALL.map(WeightFormat::name).join(", ");
            return Err(BenchError::new(
                name,
                "no format of weights",
                format_args!("known are {AUTO}, {known}"),
            ));
        }
        let opened = lads_host::open_with(path, &options(known));
        let opened = opened.map_err(|error| BenchError::of(&error))?;
        if !opened.is_bundle() {
            return Err(BenchError::new(
                path.display(),
                "it is a compiled image, which no peer can read",
                "give the bundle (.onnx)",
            ));
        }
        models.push((name, opened));
    }
    let candidates: Vec<_> = models
        .iter()
        .map(|(weights, model)| Candidate::new(weights, model.image(), &model.policy()))
        .collect();
    let python = arguments.python.clone();
    let peers = Peers {
        bundle,
        onnxruntime: Some(arguments.onnxruntime.clone()),
        crates: true,
        python: python.map(|python| (python, path.clone())),
    };
    let protocol = Protocol {
        rate: arguments.rate,
        seconds: arguments.seconds,
        load: arguments.load,
    };
    let shown = std::io::stderr().is_terminal();
    let mut progress = |done: usize, of: usize| {
        if shown {
            eprint!(
                "\rround {done} of {of}{}",
                if done == of { "\n" } else { "" }
            );
        }
    };
    measure(&candidates, &peers, &protocol, &mut progress)
}
