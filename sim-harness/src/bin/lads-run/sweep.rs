//! `--sweep`: the benchmark at several levels of each fault, one fault at a time, on the same episodes.

use std::fmt::Write as _;

use lads_sim::faults::Faults;
use lads_sim::results::{Results, Splits};
use serde::Serialize;

use crate::end::End;

/// Value of the JSON's `format`.
const FORMAT: &str = "lads-sweep";

/// Version of the JSON's form.
const FORMAT_VERSION: u32 = 1;

/// What one level came to.
#[derive(Debug, Serialize)]
pub struct Level {
    /// The option's name without its dashes.
    fault: &'static str,
    /// Its value.
    value: f64,
    /// Scores by split.
    splits: Splits,
}

/// A sweep.
#[derive(Debug, Serialize)]
pub struct Sweep {
    format: &'static str,
    format_version: u32,
    bundle_sha256: String,
    seed: u64,
    noise: String,
    episodes_per_instruction: u32,
    levels: Vec<Level>,
}

type Set = fn(&mut Faults, f64);

/// Each fault with how it is set and its levels, the first of which is none of it.
const FAULTS: [(&str, Set, [f64; 5]); 4] = [
    (
        "delay-steps",
        |faults, level| faults.delay_steps = level as usize,
        [0.0, 1.0, 2.0, 4.0, 8.0],
    ),
    (
        "drop-rate",
        |faults, level| faults.drop_rate = level,
        [0.0, 0.1, 0.25, 0.5, 0.75],
    ),
    (
        "noise-scale",
        |faults, level| faults.noise_scale = level,
        [1.0, 0.0, 2.0, 4.0, 8.0],
    ),
    (
        "action-lag",
        |faults, level| faults.action_lag = level,
        [0.0, 0.5, 1.0, 2.0, 4.0],
    ),
];

/// Runs all levels: `run` runs the benchmark with given faults and says what it came to.
pub fn sweep(run: impl Fn(Faults, &str) -> Result<Results, End>) -> Result<Sweep, End> {
    // Without faults all four are the same run.
    let plain = run(Faults::default(), "no fault")?;
    let mut levels = Vec::new();
    for (fault, set, of_fault) in FAULTS {
        for (number, level) in of_fault.into_iter().enumerate() {
            let mut faults = Faults::default();
            set(&mut faults, level);
            let splits = if number == 0 {
                plain.splits.clone()
            } else {
                run(faults, &format!("{fault} {level}"))?.splits
            };
            levels.push(Level {
                fault,
                value: level,
                splits,
            });
        }
    }
    Ok(Sweep {
        format: FORMAT,
        format_version: FORMAT_VERSION,
        bundle_sha256: plain.bundle_sha256,
        seed: plain.seed,
        noise: plain.noise,
        episodes_per_instruction: plain.episodes_per_instruction,
        levels,
    })
}

impl Sweep {
    /// N-rate with its standard error, by fault and level.
    pub fn table(&self) -> String {
        let mut text = String::from("N-rate with its standard error, one fault at a time\n");
        let mut last = "";
        for level in &self.levels {
            let filled = level.splits.0.iter().filter(|(_, s)| s.score.episodes > 0);
            if level.fault != last {
                let _ = write!(text, "\n{:<12} {:>6}", level.fault, "level");
                for (split, _) in filled.clone() {
                    let _ = write!(text, "  {split:>14}");
                }
                text.push('\n');
                last = level.fault;
            }
            let _ = write!(text, "{:<12} {:>6}", "", level.value);
            for (_, result) in filled {
                let score = &result.score;
                let rate = score.n_rate.unwrap_or(f64::NAN);
                let error = score.n_rate_standard_error;
                let error = error.map_or(String::new(), |error| format!(" ±{error:.3}"));
                let _ = write!(text, "  {:>14}", format!("{rate:.3}{error}"));
            }
            text.push('\n');
        }
        text
    }
}
