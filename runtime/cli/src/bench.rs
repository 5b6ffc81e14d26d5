//! `lads bench`: measures the time of a policy's control steps at its real rate.
//!
//! What can fail: an invalid argument, a policy without a golden episode, a contender whose results
//! differ.

use std::io::IsTerminal;
use std::path::PathBuf;

use clap::Args;
use lads_compiler::WeightFormat;
use lads_pace::paced::{Protocol, Report, measure};
use lads_pace::suite::{AUTO, Candidate, Nobody, options};

use crate::compile::{Choice, auto_or, weight_format};
use crate::model::Model;
use crate::refusal::Refusal;

/// Options of `lads bench`.
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
    /// Threads that thrash the caches and compute during the measurement
    #[arg(long, default_value_t = 0)]
    load: usize,
    /// Weight formats to measure, side by side: auto, as the bundle was tuned, or one for all weights;
    /// formats of 16 bits or fewer get a cache of 16 bits; an image keeps the formats that it was
    /// compiled with
    #[arg(
        long,
        value_name = "FORMAT",
        value_delimiter = ',',
        default_value = AUTO,
        value_parser = auto_or(weight_format)
    )]
    weights: Vec<Choice<WeightFormat>>,
    /// Print one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Runs the measurement.
pub fn bench(request: &Request) -> Result<Report, Refusal> {
    let protocol = Protocol {
        rate: request.rate,
        seconds: request.seconds,
        load: request.load,
    };
    protocol.check().map_err(|senseless| {
        let flag = format!("--{}", senseless.field);
        Refusal::new(flag, senseless.wrong, senseless.remedy)
    })?;
    let mut models = vec![];
    for &Choice(weights) in &request.weights {
        let model = Model::compile(&request.model, &options(weights))?;
        models.push((weights.map_or(AUTO, WeightFormat::name), model));
    }
    if models.is_empty() {
        let remedy = "name a format, such as f32, or auto";
        return Err(Refusal::new("--weights", "it names none", remedy));
    }
    let candidates: Vec<_> = models
        .iter()
        .map(|(weights, model)| {
            let weights = if model.is_bundle() { weights } else { "image" };
            Candidate::new(weights, model.image(), &model.policy())
        })
        .collect();
    let shown = std::io::stderr().is_terminal();
    let mut progress = |done: usize, of: usize| {
        if shown {
            eprint!(
                "\rround {done} of {of}{}",
                if done == of { "\n" } else { "" }
            );
        }
    };
    measure(&candidates, &Nobody, &protocol, &mut progress)
        .map_err(|error| Refusal::with_remedy_inside(request.model.display(), error))
}
