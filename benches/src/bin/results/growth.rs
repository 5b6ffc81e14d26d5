//! Measures how costs grow with a policy's sizes: random bundles of growing size, which the exporter makes, and the exponents of power laws
//! through them.

use std::path::Path;

use lads_benches::peers::Peers;
use lads_compiler::{Bundle, compile};
use lads_core::Policy;
use lads_pace::BenchError;
use lads_pace::clock::Pace;
use lads_pace::contender::{Block, Kind, Work};
use lads_pace::stats::exponent;
use lads_pace::suite::{Candidate, with_contenders};
use lads_pace::turns::take_turns;
use serde::{Deserialize, Serialize};

use crate::Effort;
use crate::measure::CONTEXT;

/// Measurements of one bundle.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Point {
    /// Size of the dimension that grows.
    pub value: f64,
    /// Size of the compiled image in bytes.
    pub image_bytes: f64,
    /// Size of the controller's memory in bytes.
    pub workspace_bytes: f64,
    /// Median times of the low level in microseconds: lads, then ONNX Runtime.
    pub act: [f64; 2],
    /// Median times of an ordinary step in microseconds: lads, then ONNX Runtime.
    pub ordinary: [f64; 2],
    /// Median times of a decision step in microseconds: lads, then ONNX Runtime.
    pub decision: [f64; 2],
}

/// Bundles that differ in one dimension.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Series {
    /// Name of the dimension.
    pub name: String,
    /// Measurements, in order of the dimension's size.
    pub points: Vec<Point>,
}

impl Series {
    /// Fits a power law to a column: its exponent, and R².
    pub fn exponent(&self, of: impl Fn(&Point) -> f64) -> Option<(f64, f64)> {
        let points: Vec<_> = self
            .points
            .iter()
            .map(|point| (point.value, of(point)))
            .collect();
        exponent(&points)
    }
}

/// Measures every bundle that `index.json` lists.
pub fn measure(
    folder: &Path,
    library: &Path,
    effort: Effort,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<Series>, BenchError> {
    let about = |error: &dyn std::fmt::Display| {
        BenchError::new(
            folder.display(),
            error,
            "make the bundles again (make bench does)",
        )
    };
    let index = std::fs::read(folder.join("index.json")).map_err(|error| about(&error))?;
    let index: Vec<(String, f64, String)> =
        serde_json::from_slice(&index).map_err(|error| about(&error))?;
    let mut all: Vec<Series> = vec![];
    for (series, value, file) in index {
        progress(&file);
        let bytes = std::fs::read(folder.join(&file)).map_err(|error| about(&error))?;
        let point = point(&bytes, value, library, effort)?;
        match all.last_mut().filter(|last| last.name == series) {
            Some(last) => last.points.push(point),
            None => all.push(Series {
                name: series,
                points: vec![point],
            }),
        }
    }
    Ok(all)
}

fn point(bytes: &[u8], value: f64, library: &Path, effort: Effort) -> Result<Point, BenchError> {
    let about =
        |error: &dyn std::fmt::Display| BenchError::new("a random bundle", error, "make it again");
    let bundle = Bundle::from_bytes(bytes).map_err(|error| about(&error))?;
    let image = compile(&bundle).map_err(|error| about(&error))?;
    let policy = Policy::new_checked(image.as_bytes()).map_err(|error| about(&error))?;
    let workspace = 4 * (policy.arena_len() + policy.state_len());
    let candidates = [Candidate::new("f32", image.as_bytes(), &policy)];
    let peers = Peers {
        bundle: bytes.to_vec(),
        onnxruntime: Some(library.to_owned()),
        ..Peers::default()
    };
    with_contenders(&candidates, &peers, vec![], |field, contenders| {
        let calls = 20;
        let first = field.episode.first_around(CONTEXT, field.words, calls);
        let block = |work| Block {
            work,
            pace: Pace::Hot,
            calls,
            settle: 3,
        };
        let blocks = [block(Work::Act), block(Work::Steps { first })];
        let runs = take_turns(
            contenders,
            &vec![blocks.to_vec(); effort.growth_rounds],
            &mut |_| (),
        )?;
        let medians = |kind| {
            let of = |i: usize| {
                let summary = runs.get(i).and_then(|rounds| rounds.summary(kind));
                summary.map_or(f64::NAN, |summary| summary.p50 as f64 / 1e3)
            };
            [of(0), of(1)]
        };
        Ok(Point {
            value,
            image_bytes: image.as_bytes().len() as f64,
            workspace_bytes: workspace as f64,
            act: medians(Kind::Act),
            ordinary: medians(Kind::Ordinary),
            decision: medians(Kind::Decision),
        })
    })
}
