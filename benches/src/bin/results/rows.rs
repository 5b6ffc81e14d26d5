//! Ratios that the runtime is held to, each with its target and its measurement: the table
//! [`COMPARISONS`], and four single numbers.

use lads_pace::contender::Kind::{self, Act, Decision, Ordinary};
use lads_pace::stats::{Ratio, Rounds, quantile};
use serde::Serialize;
use serde_json::Value;

use crate::files::Measured;
use crate::measure::{Run, ratio};
use crate::plain;
use Mode::{Hot, Loaded, Paced, PacedAll};
use Statistic::{P50, P999};

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

/// Runs that ratios are computed of.
#[derive(Clone, Copy)]
enum Mode {
    /// One call after the other.
    Hot,
    /// 50 Hz, with few contenders.
    Paced,
    /// 50 Hz, with all contenders.
    PacedAll,
    /// 50 Hz, on a machine under load.
    Loaded,
}

/// Latencies that are divided.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Statistic {
    /// Median, with [`paired`].
    P50,
    /// 99.9th percentile, with [`pooled`].
    P999,
}

/// One side of a ratio, a contender and a kind of its calls.
pub type Side = (&'static str, Kind);

/// Ratio of the latencies of two contenders in one run.
struct Comparison {
    id: &'static str,
    label: &'static str,
    run: Mode,
    statistic: Statistic,
    above: Side,
    below: Side,
    target: Option<f64>,
}

const F32: &str = "lads f32";
const INT16: &str = "lads int16";
const F16: &str = "lads f16";
const AUTO: &str = "lads auto";
const ORT: &str = "ONNX Runtime";
const SWEEP: &str = "bare sweep f32";
const THIRD: Option<f64> = Some(1.0 / 3.0);

/// Ratios of the page, in its order.
#[rustfmt::skip]
const COMPARISONS: &[Comparison] = &[
    Comparison { id: "act_hot_f32", label: "`low_level/act`, hot: f32 / ONNX Runtime", run: Hot, statistic: P50, above: (F32, Act), below: (ORT, Act), target: THIRD },
    Comparison { id: "act_hot_f32_sweep", label: "`low_level/act`, hot: f32 / bare sweep over the same bytes", run: Hot, statistic: P50, above: (F32, Act), below: (SWEEP, Act), target: Some(1.3) },
    Comparison { id: "step_hot_f32", label: "ordinary step, hot: f32 / ONNX Runtime", run: Hot, statistic: P50, above: (F32, Ordinary), below: (ORT, Ordinary), target: THIRD },
    Comparison { id: "decision_hot", label: "decision step / ordinary step, hot, f32", run: Hot, statistic: P50, above: (F32, Decision), below: (F32, Ordinary), target: Some(1.25) },
    Comparison { id: "decision_paced", label: "decision step / ordinary step, 50 Hz, f32", run: Paced, statistic: P50, above: (F32, Decision), below: (F32, Ordinary), target: Some(1.25) },
    Comparison { id: "act_hot_int16", label: "`low_level/act`, hot: int16 / ONNX Runtime f32", run: Hot, statistic: P50, above: (INT16, Act), below: (ORT, Act), target: Some(0.25) },
    Comparison { id: "act_hot_f16", label: "`low_level/act`, hot: f16 / ONNX Runtime f32", run: Hot, statistic: P50, above: (F16, Act), below: (ORT, Act), target: Some(0.25) },
    Comparison { id: "step_hot_int16", label: "ordinary step, hot: int16 / ONNX Runtime f32", run: Hot, statistic: P50, above: (INT16, Ordinary), below: (ORT, Ordinary), target: None },
    Comparison { id: "step_hot_f16", label: "ordinary step, hot: f16 / ONNX Runtime f32", run: Hot, statistic: P50, above: (F16, Ordinary), below: (ORT, Ordinary), target: None },
    Comparison { id: "step_hot_auto", label: "ordinary step, hot: auto / ONNX Runtime f32", run: Hot, statistic: P50, above: (AUTO, Ordinary), below: (ORT, Ordinary), target: Some(0.2) },
    Comparison { id: "decision_hot_auto", label: "decision step / ordinary step, hot, auto", run: Hot, statistic: P50, above: (AUTO, Decision), below: (AUTO, Ordinary), target: None },
    Comparison { id: "decision_paced_auto", label: "decision step / ordinary step, 50 Hz, auto", run: Paced, statistic: P50, above: (AUTO, Decision), below: (AUTO, Ordinary), target: Some(1.2) },
    Comparison { id: "step_paced_auto_p50", label: "ordinary step, 50 Hz: auto / ONNX Runtime f32, p50", run: Paced, statistic: P50, above: (AUTO, Ordinary), below: (ORT, Ordinary), target: Some(0.14) },
    Comparison { id: "step_paced_auto_p999", label: "ordinary step, 50 Hz: auto / ONNX Runtime f32, p99.9", run: Paced, statistic: P999, above: (AUTO, Ordinary), below: (ORT, Ordinary), target: Some(0.25) },
    Comparison { id: "act_paced_f32_p50", label: "`low_level/act`, 50 Hz: f32 / ONNX Runtime f32, p50", run: Paced, statistic: P50, above: (F32, Act), below: (ORT, Act), target: Some(0.2) },
    Comparison { id: "act_paced_f32_p999", label: "`low_level/act`, 50 Hz: f32 / ONNX Runtime f32, p99.9", run: Paced, statistic: P999, above: (F32, Act), below: (ORT, Act), target: THIRD },
    Comparison { id: "act_paced_int16_p50", label: "`low_level/act`, 50 Hz: int16 / ONNX Runtime f32, p50", run: Paced, statistic: P50, above: (INT16, Act), below: (ORT, Act), target: Some(0.125) },
    Comparison { id: "act_paced_int16_p999", label: "`low_level/act`, 50 Hz: int16 / ONNX Runtime f32, p99.9", run: Paced, statistic: P999, above: (INT16, Act), below: (ORT, Act), target: THIRD },
    Comparison { id: "act_paced_f16_p50", label: "`low_level/act`, 50 Hz: f16 / ONNX Runtime f32, p50", run: Paced, statistic: P50, above: (F16, Act), below: (ORT, Act), target: Some(0.125) },
    Comparison { id: "act_paced_f16_p999", label: "`low_level/act`, 50 Hz: f16 / ONNX Runtime f32, p99.9", run: Paced, statistic: P999, above: (F16, Act), below: (ORT, Act), target: THIRD },
    Comparison { id: "step_paced_f32_p50", label: "ordinary step, 50 Hz: f32 / ONNX Runtime f32, p50", run: Paced, statistic: P50, above: (F32, Ordinary), below: (ORT, Ordinary), target: Some(0.2) },
    Comparison { id: "step_paced_f32_p999", label: "ordinary step, 50 Hz: f32 / ONNX Runtime f32, p99.9", run: Paced, statistic: P999, above: (F32, Ordinary), below: (ORT, Ordinary), target: THIRD },
    Comparison { id: "step_paced_int16_p50", label: "ordinary step, 50 Hz: int16 / ONNX Runtime f32, p50", run: Paced, statistic: P50, above: (INT16, Ordinary), below: (ORT, Ordinary), target: Some(0.125) },
    Comparison { id: "step_paced_int16_p999", label: "ordinary step, 50 Hz: int16 / ONNX Runtime f32, p99.9", run: Paced, statistic: P999, above: (INT16, Ordinary), below: (ORT, Ordinary), target: THIRD },
    Comparison { id: "step_paced_f16_p50", label: "ordinary step, 50 Hz: f16 / ONNX Runtime f32, p50", run: Paced, statistic: P50, above: (F16, Ordinary), below: (ORT, Ordinary), target: Some(0.125) },
    Comparison { id: "step_paced_f16_p999", label: "ordinary step, 50 Hz: f16 / ONNX Runtime f32, p99.9", run: Paced, statistic: P999, above: (F16, Ordinary), below: (ORT, Ordinary), target: THIRD },
    Comparison { id: "int16_act_hot", label: "`low_level/act`, hot: int16 / f32", run: Hot, statistic: P50, above: (INT16, Act), below: (F32, Act), target: Some(0.7) },
    Comparison { id: "f16_act_hot", label: "`low_level/act`, hot: f16 / f32", run: Hot, statistic: P50, above: (F16, Act), below: (F32, Act), target: Some(0.7) },
    Comparison { id: "int16_step_hot", label: "ordinary step, hot: int16 / f32", run: Hot, statistic: P50, above: (INT16, Ordinary), below: (F32, Ordinary), target: Some(0.7) },
    Comparison { id: "f16_step_hot", label: "ordinary step, hot: f16 / f32", run: Hot, statistic: P50, above: (F16, Ordinary), below: (F32, Ordinary), target: Some(0.7) },
    Comparison { id: "int16_act_paced", label: "`low_level/act`, 50 Hz: int16 / f32", run: Paced, statistic: P50, above: (INT16, Act), below: (F32, Act), target: Some(0.7) },
    Comparison { id: "f16_act_paced", label: "`low_level/act`, 50 Hz: f16 / f32", run: Paced, statistic: P50, above: (F16, Act), below: (F32, Act), target: Some(0.7) },
    Comparison { id: "int16_step_paced", label: "ordinary step, 50 Hz: int16 / f32", run: Paced, statistic: P50, above: (INT16, Ordinary), below: (F32, Ordinary), target: Some(0.7) },
    Comparison { id: "f16_step_paced", label: "ordinary step, 50 Hz: f16 / f32", run: Paced, statistic: P50, above: (F16, Ordinary), below: (F32, Ordinary), target: Some(0.7) },
    Comparison { id: "act_paced_sweep", label: "`low_level/act`, 50 Hz: f32 / bare sweep", run: Paced, statistic: P50, above: (F32, Act), below: (SWEEP, Act), target: None },
    Comparison { id: "step_loaded_f32", label: "ordinary step, 50 Hz under load: f32 / ONNX Runtime", run: Loaded, statistic: P50, above: (F32, Ordinary), below: (ORT, Ordinary), target: None },
    Comparison { id: "act_hot_tract", label: "`low_level/act`, hot: f32 / tract", run: Hot, statistic: P50, above: (F32, Act), below: ("tract", Act), target: None },
    Comparison { id: "step_hot_tract", label: "ordinary step, hot: f32 / tract", run: Hot, statistic: P50, above: (F32, Ordinary), below: ("tract", Ordinary), target: None },
    Comparison { id: "act_paced_tract", label: "`low_level/act`, 50 Hz: f32 / tract", run: PacedAll, statistic: P50, above: (F32, Act), below: ("tract", Act), target: None },
    Comparison { id: "step_paced_tract", label: "ordinary step, 50 Hz: f32 / tract", run: PacedAll, statistic: P50, above: (F32, Ordinary), below: ("tract", Ordinary), target: None },
    Comparison { id: "act_hot_rten", label: "`low_level/act`, hot: f32 / rten", run: Hot, statistic: P50, above: (F32, Act), below: ("rten", Act), target: None },
    Comparison { id: "step_hot_rten", label: "ordinary step, hot: f32 / rten", run: Hot, statistic: P50, above: (F32, Ordinary), below: ("rten", Ordinary), target: None },
    Comparison { id: "act_paced_rten", label: "`low_level/act`, 50 Hz: f32 / rten", run: PacedAll, statistic: P50, above: (F32, Act), below: ("rten", Act), target: None },
    Comparison { id: "step_paced_rten", label: "ordinary step, 50 Hz: f32 / rten", run: PacedAll, statistic: P50, above: (F32, Ordinary), below: ("rten", Ordinary), target: None },
    Comparison { id: "act_hot_pytorch", label: "`low_level/act`, hot: f32 / PyTorch", run: Hot, statistic: P50, above: (F32, Act), below: ("PyTorch", Act), target: None },
    Comparison { id: "step_hot_pytorch", label: "ordinary step, hot: f32 / PyTorch", run: Hot, statistic: P50, above: (F32, Ordinary), below: ("PyTorch", Ordinary), target: None },
    Comparison { id: "act_paced_pytorch", label: "`low_level/act`, 50 Hz: f32 / PyTorch", run: PacedAll, statistic: P50, above: (F32, Act), below: ("PyTorch", Act), target: None },
    Comparison { id: "step_paced_pytorch", label: "ordinary step, 50 Hz: f32 / PyTorch", run: PacedAll, statistic: P50, above: (F32, Ordinary), below: ("PyTorch", Ordinary), target: None },
    Comparison { id: "act_hot_openvino", label: "`low_level/act`, hot: f32 / OpenVINO", run: Hot, statistic: P50, above: (F32, Act), below: ("OpenVINO", Act), target: None },
    Comparison { id: "step_hot_openvino", label: "ordinary step, hot: f32 / OpenVINO", run: Hot, statistic: P50, above: (F32, Ordinary), below: ("OpenVINO", Ordinary), target: None },
    Comparison { id: "act_paced_openvino", label: "`low_level/act`, 50 Hz: f32 / OpenVINO", run: PacedAll, statistic: P50, above: (F32, Act), below: ("OpenVINO", Act), target: None },
    Comparison { id: "step_paced_openvino", label: "ordinary step, 50 Hz: f32 / OpenVINO", run: PacedAll, statistic: P50, above: (F32, Ordinary), below: ("OpenVINO", Ordinary), target: None },
];

/// Targets that are lower where the CPU has AVX-512.
const WITH_AVX512: [(&str, f64); 2] = [("step_hot_auto", 0.1), ("step_paced_auto_p50", 0.11)];

impl Comparison {
    /// Computes the row, whose ratio is missing if a contender was not measured.
    fn row(&self, measured: &Measured) -> Row {
        let run = match self.run {
            Hot => &measured.hot,
            Paced => &measured.paced,
            PacedAll => &measured.paced_all,
            Loaded => &measured.loaded,
        };
        let named = (self.id.to_owned(), self.label.to_owned());
        between(
            run,
            self.statistic,
            (self.above, self.below),
            named,
            self.target,
        )
    }
}

/// Computes a row of two contenders' latencies in one run, which is named by its id and label.
pub fn between(
    run: &Run,
    statistic: Statistic,
    (above, below): (Side, Side),
    (id, label): (String, String),
    target: Option<f64>,
) -> Row {
    let (ratio, halves) = match statistic {
        P50 => paired(run, above, below),
        P999 => (pooled(run, above, below, 0.999), None),
    };
    Row {
        id,
        label,
        ratio,
        halves,
        target,
        unit: "",
    }
}

/// Computes a ratio of medians, the median over rounds of the rounds' ratios, and the distance
/// between the two halves of the run.
fn paired(run: &Run, above: Side, below: Side) -> (Option<Ratio>, Option<f64>) {
    let per_round = |(name, kind): Side| {
        let rounds = run.of(name);
        rounds.map_or_else(Vec::new, |rounds| rounds.quantiles(kind, 0.5))
    };
    match ratio(&per_round(above), &per_round(below)) {
        Some((ratio, halves)) => (Some(ratio), Some(halves).filter(|halves| !halves.is_nan())),
        None => (None, None),
    }
}

/// Computes a ratio of tails, over all calls of the run, because a round is too short for one; its
/// range is that of four parts of the run.
fn pooled(run: &Run, above: Side, below: Side, q: f64) -> Option<Ratio> {
    let of = |(name, kind): Side, part: Option<usize>| {
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
    at(None).map(|median| Ratio { median, low, high })
}

/// Computes the row of a number that was measured elsewhere, with its range.
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

/// Computes all rows, in the order of the page.
pub fn rows(measured: &Measured) -> Vec<Row> {
    let Measured {
        cold, preparation, ..
    } = measured;
    let mut rows: Vec<Row> = COMPARISONS.iter().map(|row| row.row(measured)).collect();
    let mut vectors = measured.machine["vectors"].as_array().into_iter().flatten();
    if vectors.any(|one| one == "avx512f") {
        for (id, most) in WITH_AVX512 {
            if let Some(row) = rows.iter_mut().find(|row| row.id == id) {
                row.target = Some(most);
            }
        }
    }
    rows.extend(measured.plain.iter().flat_map(plain::Measured::rows));
    rows.extend([
        number(
            "first_step",
            "first control step after warming up / the same step hot",
            &cold["with"]["first_to_hot"],
            Some(1.5),
            "",
        ),
        number(
            "first_step_cold",
            "first control step without warming up / the same step hot",
            &cold["without"]["first_to_hot"],
            None,
            "",
        ),
        number(
            "compile",
            "compile kitchen.onnx",
            &preparation["compile_ms"],
            Some(150.0),
            "ms",
        ),
        number(
            "open",
            "open its image",
            &preparation["images"][0]["open_ms"],
            Some(1.0),
            "ms",
        ),
    ]);
    rows
}
