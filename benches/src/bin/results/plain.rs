//! Measures policies of one entry, as robots' policy files have them, beside the runtimes that run such files: hot and at 50 Hz.

use std::path::Path;

use lads_benches::peers::Peers;
use lads_compiler::{Bundle, WeightFormat, compile_with};
use lads_core::Policy;
use lads_host::Aligned;
use lads_pace::BenchError;
use lads_pace::contender::{Contender, Kind};
use lads_pace::suite::{Candidate, options, with_contenders};

use crate::Effort;
use crate::measure::{Bare, Run, hot, paced};
use crate::rows::{Row, Statistic, between};

/// The policies: name of the file and of the rows, and what it is.
const POLICIES: [(&str, &str); 3] = [
    ("mlp", "MLP 51-512-256-128-14"),
    ("gru", "GRU 41-256-16"),
    ("history", "MLP 705-512-256-128-12"),
];

/// What is compared with ONNX Runtime: format, whether at 50 Hz, statistic, target.
const COMPARED: [(&str, bool, Statistic, Option<f64>); 6] = [
    ("f32", false, Statistic::P50, Some(0.4)),
    ("int16", false, Statistic::P50, Some(0.25)),
    ("f32", true, Statistic::P50, Some(0.25)),
    ("f32", true, Statistic::P999, Some(0.4)),
    ("int16", true, Statistic::P50, Some(0.2)),
    ("int16", true, Statistic::P999, None),
];

/// Measurements of one policy.
pub struct Measured {
    name: &'static str,
    pub title: &'static str,
    pub hot: Run,
    pub paced: Run,
}

/// Measures the bundles in a folder.
pub fn measure(
    folder: &Path,
    library: &Path,
    effort: Effort,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<Measured>, BenchError> {
    POLICIES
        .into_iter()
        .map(|(name, title)| {
            progress(title);
            one(&folder.join(format!("{name}.onnx")), library, effort).map(|(hot, paced)| {
                Measured {
                    name,
                    title,
                    hot,
                    paced,
                }
            })
        })
        .collect()
}

fn one(path: &Path, library: &Path, effort: Effort) -> Result<(Run, Run), BenchError> {
    let about = |error: &dyn std::fmt::Display| {
        BenchError::new(path.display(), error, "remove it, so that it is made again")
    };
    let bytes = std::fs::read(path).map_err(|error| about(&error))?;
    let bundle = Bundle::from_bytes(&bytes).map_err(|error| about(&error))?;
    let mut images = vec![];
    for weights in [WeightFormat::F32, WeightFormat::Int16] {
        let image = compile_with(&bundle, &options(Some(weights)));
        let image = image.map_err(|error| about(&error))?;
        images.push((weights.name(), Aligned::new(image.as_bytes())));
    }
    let mut candidates = vec![];
    for (weights, image) in &images {
        let policy = Policy::new_checked(image.as_bytes()).map_err(|error| about(&error))?;
        candidates.push(Candidate::new(weights, image.as_bytes(), &policy));
    }
    // All but some kilobytes of such a bundle are its weights.
    let bare =
        || -> Vec<Box<dyn Contender>> { vec![Box::new(Bare::steps("f32", bytes.len() / 64 * 64))] };
    let peers = |crates| Peers {
        bundle: bytes.clone(),
        onnxruntime: Some(library.to_owned()),
        crates,
        python: None,
    };
    let hot = with_contenders(&candidates, &peers(true), bare(), |field, contenders| {
        hot(field, contenders, effort, &mut |_| ())
    })?;
    let paced = with_contenders(&candidates, &peers(false), bare(), |field, contenders| {
        paced(field, contenders, effort.plain_rounds, 0, &mut |_| ())
    })?;
    Ok((hot, paced))
}

impl Measured {
    /// Computes the rows of the page.
    pub fn rows(&self) -> Vec<Row> {
        let peer = |name| (name, Kind::Ordinary);
        let ours = |format| {
            peer(if format == "f32" {
                "lads f32"
            } else {
                "lads int16"
            })
        };
        let mut rows = vec![];
        for (format, at_rate, statistic, target) in COMPARED {
            let run = if at_rate { &self.paced } else { &self.hot };
            let (mode, tail) = (
                if at_rate { "50 Hz" } else { "hot" },
                if statistic == Statistic::P999 {
                    ", p99.9"
                } else {
                    ""
                },
            );
            let id = format!(
                "{}_{format}_{}{}",
                self.name,
                if at_rate { "paced" } else { "hot" },
                if tail.is_empty() { "" } else { "_p999" }
            );
            let label = format!("{}, {mode}: {format} / ONNX Runtime f32{tail}", self.title);
            let sides = (ours(format), peer("ONNX Runtime"));
            rows.push(between(run, statistic, sides, (id, label), target));
        }
        for (run, mode) in [(&self.hot, "hot"), (&self.paced, "50 Hz")] {
            let others: &[&'static str] = if mode == "hot" {
                &["tract", "rten", "bare sweep f32"]
            } else {
                &["bare sweep f32"]
            };
            for &other in others {
                let id = format!("{}_{mode}_{other}", self.name).replace(' ', "_");
                let label = format!("{}, {mode}: f32 / {other}", self.title);
                let sides = (ours("f32"), peer(other));
                rows.push(between(run, Statistic::P50, sides, (id, label), None));
            }
        }
        rows
    }
}
