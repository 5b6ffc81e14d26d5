//! `lads bench`: how long the control steps of a policy take at its real rate, alone or beside what one would use instead.
//!
//! What can fail: an argument that makes no sense, a policy without a golden episode, a contender that computes something else.
//! Peers are there only with the cargo feature `peers`.

use std::io::IsTerminal;
use std::path::PathBuf;

use clap::Args;
use lads_benches::paced::{Protocol, Report, measure};
use lads_benches::suite::{Candidate, Peers, options};
use lads_compiler::WeightFormat;

use crate::model::Model;
use crate::refusal::Refusal;

/// Where `benches/setup.py` puts the library of ONNX Runtime.
const ONNXRUNTIME: &str = "vendor/onnxruntime/libonnxruntime.so";

/// What to measure and how.
#[derive(Debug, Args)]
pub struct Request {
    /// Bundle (.onnx) or compiled image (.lads)
    #[arg(long)]
    pub model: PathBuf,
    /// Control steps per second
    #[arg(long, default_value_t = 50.0)]
    rate: f64,
    /// Seconds for each contender
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// Threads that thrash the caches and compute beside it
    #[arg(long, default_value_t = 0)]
    load: usize,
    /// Formats of the weights to measure, side by side, those of 16 bits or fewer with a cache of 16; an image has those that it was
    /// compiled with
    #[arg(
        long,
        value_name = "FORMAT",
        value_delimiter = ',',
        default_value = "f32",
        value_parser = crate::weight_format
    )]
    weights: Vec<WeightFormat>,
    /// Beside ONNX Runtime, tract and rten, in turns; with --python also PyTorch and OpenVINO
    #[arg(long)]
    peers: bool,
    /// The shared library of ONNX Runtime
    #[arg(long, requires = "peers", default_value = ONNXRUNTIME)]
    onnxruntime: PathBuf,
    /// A Python that has onnx and PyTorch or OpenVINO
    #[arg(long, requires = "peers")]
    python: Option<PathBuf>,
    /// As one JSON object
    #[arg(long)]
    pub json: bool,
}

impl Request {
    fn check(&self) -> Result<(), Refusal> {
        let most = std::thread::available_parallelism().map_or(64, |cores| 16 * cores.get());
        if !(self.rate.is_finite() && (0.1..=10_000.0).contains(&self.rate)) {
            return Err(Refusal::new(
                "--rate",
                format_args!("{} Hz", self.rate),
                "give 0.1 to 10000",
            ));
        }
        if !(self.seconds.is_finite() && (0.1..=86_400.0).contains(&self.seconds)) {
            let wrong = format_args!("{} s", self.seconds).to_string();
            return Err(Refusal::new("--seconds", wrong, "give 0.1 to 86400"));
        }
        if self.load > most {
            let wrong = format!("{} threads", self.load);
            return Err(Refusal::new(
                "--load",
                wrong,
                format_args!("give at most {most} on this machine"),
            ));
        }
        if self.peers && cfg!(not(feature = "peers")) {
            return Err(Refusal::new(
                "--peers",
                "this lads was built without them",
                "build it with `cargo build --profile bench -p lads-cli --features peers`",
            ));
        }
        Ok(())
    }
}

/// Measures as requested.
pub fn bench(request: &Request) -> Result<Report, Refusal> {
    request.check()?;
    let mut models = vec![];
    for &weights in &request.weights {
        let model = Model::compile(&request.model, options(weights))?;
        models.push((weights.name(), model));
    }
    let (_, model) = models
        .first()
        .ok_or_else(|| Refusal::new("--weights", "it names none", "name a format, such as f32"))?;
    let mut peers = Peers::default();
    let mut bundle = vec![];
    if request.peers {
        if !model.is_bundle() {
            return Err(Refusal::new(
                model.path.display(),
                "it is a compiled image, which no peer can read",
                "give the bundle (.onnx)",
            ));
        }
        bundle = lads_host::input::read(&model.path)
            .map_err(|error| Refusal::new(model.path.display(), error, "name a bundle (.onnx)"))?;
        peers.onnxruntime = Some(request.onnxruntime.clone());
        peers.crates = true;
        peers.python = request
            .python
            .clone()
            .map(|python| (python, model.path.clone()));
    }
    let mut candidates = vec![];
    for (weights, model) in &models {
        let golden = model.policy()?.golden();
        candidates.push(Candidate {
            weights: if model.is_bundle() { weights } else { "image" },
            image: model.image(),
            tolerance: golden.map_or(0.0, |golden| golden.tolerance()),
        });
    }
    let protocol = Protocol {
        rate: request.rate,
        seconds: request.seconds,
        load: request.load,
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
    measure(&candidates, &bundle, &peers, &protocol, &mut progress)
        .map_err(|error| Refusal::with_remedy_inside(model.path.display(), error))
}
