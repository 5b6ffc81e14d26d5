//! Writes RESULTS.md, results.json and the charts; every file as a whole or not at all.

use std::path::Path;

use lads_pace::BenchError;
use lads_pace::contender::Kind;
use serde_json::{Value, json};

use crate::charts::{Line, lines, tail};
use crate::growth::{Point, Series};
use crate::measure::{CONTEXT, RATE, Run};
use crate::page::page;
use crate::plain;
use crate::regression::Changes;
use crate::rows::Row;

/// Measurements that the results page is made of.
pub struct Measured {
    pub machine: Value,
    pub field: Value,
    pub preparation: Value,
    pub cold: Value,
    pub hot: Run,
    pub paced_all: Run,
    pub paced: Run,
    pub loaded: Run,
    pub contexts: Vec<Line>,
    pub growth: Vec<Series>,
    pub not_grown: Option<String>,
    pub plain: Vec<plain::Measured>,
    pub criterion: Vec<Value>,
    pub quick: bool,
    pub seconds: f64,
}

/// Writes all files of the results.
pub fn write(
    folder: &Path,
    measured: &Measured,
    rows: &[Row],
    changes: &Changes,
) -> Result<(), BenchError> {
    let charts = folder.join("charts");
    std::fs::create_dir_all(&charts).map_err(|error| {
        BenchError::new(charts.display(), error, "name a folder that can be written")
    })?;
    for (name, svg) in draw(measured) {
        save(&charts.join(name), svg.as_bytes())?;
    }
    save(
        &folder.join("results.json"),
        format!("{:#}\n", as_json(measured, rows)).as_bytes(),
    )?;
    save(
        &folder.join("RESULTS.md"),
        page(measured, rows, changes).as_bytes(),
    )
}

fn save(path: &Path, bytes: &[u8]) -> Result<(), BenchError> {
    let written = lads_host::output::write(path, bytes);
    written.map_err(|error| {
        BenchError::new(path.display(), error, "name a folder that can be written")
    })
}

fn as_json(measured: &Measured, rows: &[Row]) -> Value {
    json!({
        "machine": measured.machine,
        "quick": measured.quick,
        "seconds": measured.seconds,
        "context_tokens": CONTEXT,
        "rate_hz": RATE,
        "rows": rows,
        "contenders": measured.field,
        "preparation": measured.preparation,
        "first_steps": measured.cold,
        "latency_us": {
            "hot": measured.hot.rows(),
            "paced_all": measured.paced_all.rows(),
            "paced": measured.paced.rows(),
            "paced_loaded": measured.loaded.rows(),
        },
        "plain_us": measured.plain.iter().map(|it| json!({
            "policy": it.title, "hot": it.hot.rows(), "paced": it.paced.rows(),
        })).collect::<Vec<_>>(),
        "context_growth_us": measured.contexts,
        "network_growth": measured.growth,
        "criterion": measured.criterion,
    })
}

/// Draws the charts, by file name.
fn draw(measured: &Measured) -> Vec<(&'static str, String)> {
    let mut drawn = vec![];
    for (file, kind, title) in [
        ("paced-act.svg", Kind::Act, "low_level/act at 50 Hz"),
        (
            "paced-step.svg",
            Kind::Ordinary,
            "Ordinary control step at 50 Hz, 300 tokens",
        ),
    ] {
        let run = &measured.paced;
        let tails: Vec<Line> = run
            .names
            .iter()
            .zip(&run.rounds)
            .map(|(name, rounds)| {
                let mut took: Vec<_> = rounds
                    .of(kind)
                    .map(|sample| sample.took as f64 / 1e3)
                    .collect();
                (name.clone(), tail(&mut took))
            })
            .collect();
        drawn.push((
            file,
            lines(
                title,
                "latency [us]",
                "share of calls that took longer",
                &tails,
                true,
            ),
        ));
    }
    let title = "Ordinary control step against the context, hot";
    drawn.push((
        "context.svg",
        lines(
            title,
            "tokens in the context",
            "p50 [us]",
            &measured.contexts,
            false,
        ),
    ));
    let grown: Vec<Line> = measured
        .growth
        .iter()
        .map(|series| {
            let first = series
                .points
                .first()
                .map_or((1.0, 1.0), |point| (point.value, point.ordinary[0]));
            let relative = |point: &Point| (point.value / first.0, point.ordinary[0] / first.1);
            (
                series.name.clone(),
                series.points.iter().map(relative).collect(),
            )
        })
        .collect();
    let title = "Ordinary control step against the network, hot, f32";
    drawn.push((
        "network.svg",
        lines(
            title,
            "size, relative to the smallest",
            "p50, relative",
            &grown,
            true,
        ),
    ));
    drawn
}
