//! The `sweep` subcommand: the benchmark at several levels of each fault, one fault at a time, on the same episodes.
//!
//! A fault may lead to observations outside the contract, which the controller refuses. Such an episode ends there, as the machine would
//! stop, and counts with what it has completed; each level says how many did.

use std::fmt::Write as _;

use lads_sim::faults::Faults;
use lads_sim::results::{Results, Splits};
use serde::Serialize;

use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

use lads_sim::evaluate::Setup;
use lads_sim::output;
use lads_sim::sight::is_image;

use crate::arguments::{Sweep as Asked, Wanted};
use crate::bench;
use crate::end::{End, print, refused, unwritable};
use crate::{given, some_episodes, threads};

/// Value of the JSON's `format`.
const FORMAT: &str = "lads-sweep";

/// Version of the JSON's form.
const FORMAT_VERSION: u32 = 1;

/// Result of the benchmark at one level of one fault.
#[derive(Debug, Serialize)]
pub struct Level {
    /// Name of the fault's option, without its dashes.
    fault: &'static str,
    /// Value of the fault's option.
    value: f64,
    /// Scores by split.
    splits: Splits,
    /// Episodes of all splits.
    episodes: usize,
    /// Number of episodes that ended because the controller refused an observation.
    refused_episodes: usize,
    /// Earliest control step, from 0, at which an observation was refused.
    first_refused_step: Option<usize>,
}

/// Results of all levels of all faults, as written to JSON.
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

/// Each fault with its setter and its levels, of which the first is zero.
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

/// Runs the benchmark once for each level of each fault.
pub fn run(asked: &Asked, stop: &AtomicBool) -> Result<ExitCode, End> {
    let episodes = &asked.episodes;
    some_episodes(Some(episodes.episodes))?;
    let threads = threads(episodes.threads, false)?;
    let inputs = [
        ("--model", Some(&asked.policy.model)),
        ("--image", asked.policy.image.as_ref()),
    ];
    let outputs = given([("--json", asked.json.as_ref())]);
    output::apart(&given(inputs), &outputs).map_err(refused)?;
    output::check(&[], &outputs).map_err(refused)?;
    let wanted = Wanted {
        judged: true,
        ..Wanted::of(&asked.policy, &asked.language, episodes, threads)
    };
    bench::with(&wanted, stop, |bench| {
        if bench.evaluation.contract.observations().any(is_image) {
            return Err(refused(
                "the policy sees images, which no fault delays or loses; sweep one that observes numbers",
            ));
        }
        // Before the policy moves anything.
        print(&bench.heard.first)?;
        let sweep = sweep(|faults, what| {
            let setup = Setup {
                faults,
                stop_where_refused: true,
                ..bench.evaluation.setup
            };
            let (results, evaluated) = bench.run(setup, what)?;
            Ok((results, evaluated.refused_at))
        })?;
        if let Some(path) = &asked.json {
            output::write_json(&sweep, path).map_err(|error| unwritable("--json", path, &error))?;
        }
        print(&sweep.table())?;
        Ok(ExitCode::SUCCESS)
    })
}

/// Runs all levels: `run` runs the benchmark with given faults and returns its results. Results come with the control steps at which
/// episodes were refused, in rising order.
fn sweep(run: impl Fn(Faults, &str) -> Result<(Results, Vec<usize>), End>) -> Result<Sweep, End> {
    // Without faults all four are the same run.
    let runs = 1 + FAULTS
        .iter()
        .map(|(_, _, levels)| levels.len() - 1)
        .sum::<usize>();
    let mut done = 1;
    let (plain, plain_refused) = run(Faults::default(), &format!("no fault, run 1 of {runs}"))?;
    let mut levels = Vec::new();
    for (fault, set, of_fault) in FAULTS {
        for (number, level) in of_fault.into_iter().enumerate() {
            let mut faults = Faults::default();
            set(&mut faults, level);
            let (splits, refused) = if number == 0 {
                (plain.splits.clone(), plain_refused.clone())
            } else {
                done += 1;
                let what = format!("{fault} {level}, run {done} of {runs}");
                let (results, refused) = run(faults, &what)?;
                (results.splits, refused)
            };
            let scores = splits.0.iter();
            levels.push(Level {
                fault,
                value: level,
                episodes: scores.map(|(_, result)| result.score.episodes).sum(),
                splits,
                refused_episodes: refused.len(),
                first_refused_step: refused.first().copied(),
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
    /// Formats N-rate with its standard error, by fault and level.
    pub fn table(&self) -> String {
        let mut text = String::from(
            "N-rate with its standard error, one fault at a time; an episode whose observation the controller refuses ends there\n",
        );
        let mut last = "";
        for level in &self.levels {
            let filled = level.splits.0.iter().filter(|(_, s)| s.score.episodes > 0);
            if level.fault != last {
                let _ = write!(text, "\n{:<12} {:>6}", level.fault, "level");
                for (split, _) in filled.clone() {
                    let _ = write!(text, "  {split:>14}");
                }
                text.push_str("  refused");
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
            let (refused, all) = (level.refused_episodes, level.episodes);
            let _ = match level.first_refused_step {
                None => write!(text, "  none"),
                Some(step) => write!(text, "  {refused} of {all} episodes, from step {step}"),
            };
            text.push('\n');
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_says_where_observations_were_refused() {
        let level = |value, refused_episodes, first_refused_step| Level {
            fault: "noise-scale",
            value,
            splits: Splits(Vec::new().into_iter().collect()),
            episodes: 50,
            refused_episodes,
            first_refused_step,
        };
        let sweep = Sweep {
            format: FORMAT,
            format_version: FORMAT_VERSION,
            bundle_sha256: String::new(),
            seed: 0,
            noise: "v0".to_owned(),
            episodes_per_instruction: 2,
            levels: vec![level(1.0, 0, None), level(8.0, 12, Some(3))],
        };
        let table = sweep.table();
        let lines: Vec<&str> = table.lines().skip(2).collect();
        assert!(lines[0].ends_with("refused"));
        assert!(lines[1].ends_with("1  none"));
        assert!(lines[2].ends_with("8  12 of 50 episodes, from step 3"));
    }
}
