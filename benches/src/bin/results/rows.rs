//! Ratios that the runtime is held to, each with its target and its measurement.

use lads_pace::contender::Kind;
use lads_pace::stats::{Ratio, Rounds, quantile};
use serde::Serialize;
use serde_json::Value;

use crate::files::Measured;
use crate::measure::{Run, ratio};

/// A ratio of the table.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// Short name, for the comparison with earlier results.
    pub id: String,
    /// Label of the row, for people.
    pub label: String,
    /// Measured ratio, if there is one.
    pub ratio: Option<Ratio>,
    /// Distance between the first and the second half of the run.
    pub halves: Option<f64>,
    /// Largest ratio that meets the target, if there is a target.
    pub target: Option<f64>,
    /// Unit of the number; empty for a ratio.
    pub unit: &'static str,
}

impl Row {
    /// Whether the target is met; `None` without a target or a measurement.
    pub fn met(&self) -> Option<bool> {
        Some(self.ratio?.median <= self.target?)
    }
}

/// One side of a ratio, as `(run, contender, kind, quantile)`.
type Side<'r> = (&'r Run, &'static str, Kind, f64);

fn per_round((run, name, kind, q): Side<'_>) -> Vec<f64> {
    run.of(name)
        .map(|rounds| rounds.quantiles(kind, q))
        .unwrap_or_default()
}

/// Computes the row of a p50: the median over rounds of the rounds' ratios.
fn paired(id: &str, label: &str, above: Side<'_>, below: Side<'_>, target: Option<f64>) -> Row {
    let found = ratio(&per_round(above), &per_round(below));
    Row {
        id: id.into(),
        label: label.into(),
        ratio: found.map(|(ratio, _)| ratio),
        halves: found
            .map(|(_, halves)| halves)
            .filter(|halves| !halves.is_nan()),
        target,
        unit: "",
    }
}

/// Computes the row of a tail: over all calls of the run, because a round is too short for one. Its quartiles are those of four parts of
/// the run.
fn pooled(id: &str, label: &str, above: Side<'_>, below: Side<'_>, target: Option<f64>) -> Row {
    let of = |(run, name, kind, q): Side<'_>, part: Option<usize>| {
        let rounds: &Rounds = run.of(name)?;
        let part = rounds
            .0
            .iter()
            .enumerate()
            .filter(|(i, _)| part.is_none_or(|part| i % 4 == part));
        let took: Vec<_> = part
            .flat_map(|(_, samples)| samples)
            .filter(|sample| sample.kind == kind)
            .map(|sample| sample.took as f64)
            .collect();
        Some(quantile(&took, q))
    };
    let at = |part| Some(of(above, part)? / of(below, part)?).filter(|ratio| ratio.is_finite());
    let parts: Vec<_> = (0..4).filter_map(|part| at(Some(part))).collect();
    let (low, high) = (quantile(&parts, 0.0), quantile(&parts, 1.0));
    let ratio = at(None).map(|median| Ratio { median, low, high });
    Row {
        id: id.into(),
        label: label.into(),
        ratio,
        halves: None,
        target,
        unit: "",
    }
}

fn number(id: &str, label: &str, value: &Value, target: Option<f64>, unit: &'static str) -> Row {
    let part = |name: &str| value[name].as_f64();
    let ratio = (|| {
        Some(Ratio {
            median: part("median")?,
            low: part("low")?,
            high: part("high")?,
        })
    })();
    Row {
        id: id.into(),
        label: label.into(),
        ratio,
        halves: None,
        target,
        unit,
    }
}

const ORT: &str = "ONNX Runtime";

/// Contenders whose weights have half the bytes, each with the format of its weights.
const HALVED: [[&str; 2]; 2] = [["lads int16", "int16"], ["lads f16", "f16"]];

/// Computes all rows, in the order of the page.
#[expect(clippy::too_many_lines, reason = "a list: every row of the page, once")]
pub fn rows(measured: &Measured) -> Vec<Row> {
    let Measured {
        hot,
        paced,
        paced_all,
        loaded,
        ..
    } = measured;
    let (act, ordinary, decision) = (Kind::Act, Kind::Ordinary, Kind::Decision);
    let third = Some(1.0 / 3.0);
    let mut rows = vec![
        paired(
            "act_hot_f32",
            "`low_level/act`, hot: f32 / ONNX Runtime",
            (hot, "lads f32", act, 0.5),
            (hot, ORT, act, 0.5),
            third,
        ),
        paired(
            "act_hot_f32_sweep",
            "`low_level/act`, hot: f32 / bare sweep over the same bytes",
            (hot, "lads f32", act, 0.5),
            (hot, "bare sweep f32", act, 0.5),
            Some(1.3),
        ),
        paired(
            "step_hot_f32",
            "ordinary step, hot: f32 / ONNX Runtime",
            (hot, "lads f32", ordinary, 0.5),
            (hot, ORT, ordinary, 0.5),
            third,
        ),
        paired(
            "decision_hot",
            "decision step / ordinary step, hot, f32",
            (hot, "lads f32", decision, 0.5),
            (hot, "lads f32", ordinary, 0.5),
            Some(1.25),
        ),
        paired(
            "decision_paced",
            "decision step / ordinary step, 50 Hz, f32",
            (paced, "lads f32", decision, 0.5),
            (paced, "lads f32", ordinary, 0.5),
            Some(1.25),
        ),
    ];
    let kinds = [
        (act, "`low_level/act`", "act"),
        (ordinary, "ordinary step", "step"),
    ];
    for (kind, name, short) in kinds {
        for [ours, weights] in HALVED {
            rows.push(paired(
                &format!("{short}_hot_{weights}"),
                &format!("{name}, hot: {weights} / ONNX Runtime f32"),
                (hot, ours, kind, 0.5),
                (hot, ORT, kind, 0.5),
                (kind == act).then_some(0.25),
            ));
        }
    }
    for (kind, name, short) in kinds {
        let full = ["lads f32", "f32"];
        for ([ours, weights], target) in [(full, 0.2), (HALVED[0], 0.125), (HALVED[1], 0.125)] {
            let (id, label) = (
                format!("{short}_paced_{weights}"),
                format!("{name}, 50 Hz: {weights} / ONNX Runtime f32"),
            );
            rows.push(paired(
                &format!("{id}_p50"),
                &format!("{label}, p50"),
                (paced, ours, kind, 0.5),
                (paced, ORT, kind, 0.5),
                Some(target),
            ));
            rows.push(pooled(
                &format!("{id}_p999"),
                &format!("{label}, p99.9"),
                (paced, ours, kind, 0.999),
                (paced, ORT, kind, 0.999),
                third,
            ));
        }
    }
    for (run, name, short) in [(hot, "hot", "hot"), (paced, "50 Hz", "paced")] {
        for (kind, what, part) in kinds {
            for [ours, weights] in HALVED {
                rows.push(paired(
                    &format!("{weights}_{part}_{short}"),
                    &format!("{what}, {name}: {weights} / f32"),
                    (run, ours, kind, 0.5),
                    (run, "lads f32", kind, 0.5),
                    Some(0.7),
                ));
            }
        }
    }
    rows.push(paired(
        "act_paced_sweep",
        "`low_level/act`, 50 Hz: f32 / bare sweep",
        (paced, "lads f32", act, 0.5),
        (paced, "bare sweep f32", act, 0.5),
        None,
    ));
    rows.push(paired(
        "step_loaded_f32",
        "ordinary step, 50 Hz under load: f32 / ONNX Runtime",
        (loaded, "lads f32", ordinary, 0.5),
        (loaded, ORT, ordinary, 0.5),
        None,
    ));
    for peer in ["tract", "rten", "PyTorch", "OpenVINO"] {
        for (run, mode, short) in [(hot, "hot", "hot"), (paced_all, "50 Hz", "paced")] {
            for (kind, what, part) in [
                (act, "`low_level/act`", "act"),
                (ordinary, "ordinary step", "step"),
            ] {
                let (id, label) = (
                    format!("{part}_{short}_{}", peer.to_lowercase()),
                    format!("{what}, {mode}: f32 / {peer}"),
                );
                rows.push(paired(
                    &id,
                    &label,
                    (run, "lads f32", kind, 0.5),
                    (run, peer, kind, 0.5),
                    None,
                ));
            }
        }
    }
    rows.push(number(
        "first_step",
        "first control step after warming up / the same step hot",
        &measured.cold["with"]["first_to_hot"],
        Some(1.5),
        "",
    ));
    rows.push(number(
        "first_step_cold",
        "first control step without warming up / the same step hot",
        &measured.cold["without"]["first_to_hot"],
        None,
        "",
    ));
    rows.push(number(
        "compile",
        "compile kitchen.onnx",
        &measured.preparation["compile_ms"],
        Some(150.0),
        "ms",
    ));
    rows.push(number(
        "open",
        "open its image",
        &measured.preparation["images"][0]["open_ms"],
        Some(1.0),
        "ms",
    ));
    rows
}
