//! Formats results as text, for people. Everything in it is in the JSON too.

use std::fmt::{self, Display, Formatter};

use crate::results::{InstructionResult, Results, SplitResult, SubTaskRate};
use lads_proof::timing::Latency;

/// Formats results as a table of a few lines per instruction, then the splits, latency and time.
pub struct Table<'r>(pub &'r Results);

impl Display for Table<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let results = self.0;
        heading(results, f)?;
        let splits = results.splits.0.iter();
        let splits = splits.filter(|(_, result)| result.score.episodes > 0);
        for (split, _) in splits.clone() {
            rows(split, &results.instructions, f)?;
        }
        for (split, result) in splits {
            split_block(split, result, f)?;
        }
        latency(results, f)?;
        time(results, f)
    }
}

fn heading(results: &Results, f: &mut Formatter<'_>) -> fmt::Result {
    let environment = &results.environment;
    let sha256: String = results.bundle_sha256.chars().take(12).collect();
    write!(
        f,
        "{} {}, noise {}, seed {}, ",
        environment.id, environment.version, results.noise, results.seed
    )?;
    match results.decision.temperature {
        Some(temperature) => write!(f, "plans sampled at temperature {temperature}")?,
        None if results.decision.rule == "uniform" => write!(f, "uniform random actions")?,
        None => write!(f, "plans by {}", results.decision.rule)?,
    }
    writeln!(
        f,
        ", episodes of {} steps; bundle sha256 {sha256}",
        environment.max_steps
    )
}

fn rows(split: &str, instructions: &[InstructionResult], f: &mut Formatter<'_>) -> fmt::Result {
    writeln!(
        f,
        "\n{split:<10} episodes      N    K1    K2    K3    K4  full success        sub-tasks"
    )?;
    let of_split = instructions.iter().filter(|result| result.split == split);
    of_split
        .into_iter()
        .try_for_each(|result| instruction_row(result, f))
}

fn instruction_row(result: &InstructionResult, f: &mut Formatter<'_>) -> fmt::Result {
    let score = &result.score;
    write!(
        f,
        "{:<10} {:>8}  {}",
        result.id,
        score.episodes,
        Number(score.n_rate)
    )?;
    score
        .k_rate
        .iter()
        .try_for_each(|&rate| write!(f, " {}", Number(rate)))?;
    write!(
        f,
        "  {} {}  ",
        Number(score.full_success),
        score.full_success_interval
    )?;
    list(&result.completions, f)?;
    if !result.un_instructed_completions.is_empty() {
        let asked = !result.completions.is_empty();
        write!(
            f,
            "{}",
            if asked {
                "; un-instructed: "
            } else {
                "completed: "
            }
        )?;
        list(&result.un_instructed_completions, f)?;
    }
    writeln!(f)
}

fn list(rates: &[SubTaskRate], f: &mut Formatter<'_>) -> fmt::Result {
    for (place, of_sub_task) in rates.iter().enumerate() {
        let comma = if place == 0 { "" } else { ", " };
        write!(
            f,
            "{comma}{} {:.2}",
            of_sub_task.sub_task,
            of_sub_task.rate.rate.unwrap_or(f64::NAN)
        )?;
    }
    Ok(())
}

fn split_block(split: &str, result: &SplitResult, f: &mut Formatter<'_>) -> fmt::Result {
    let score = &result.score;
    writeln!(
        f,
        "\n{split}: {} episodes, 95 % intervals in brackets",
        score.episodes
    )?;
    if result.completions.is_empty() {
        return completions_alone(result, f);
    }
    write!(f, "  N-rate             {}", Number(score.n_rate))?;
    match score.n_rate_standard_error {
        Some(error) => writeln!(f, " (standard error {error:.2})")?,
        None => writeln!(f)?,
    }
    for ((k, &rate), interval) in (1..).zip(&score.k_rate).zip(&score.k_rate_interval) {
        writeln!(f, "  K-rate {k}           {} {interval}", Number(rate))?;
    }
    let full = score.full_success_interval;
    writeln!(
        f,
        "  full success       {} {full}",
        Number(score.full_success)
    )?;
    for SubTaskRate { sub_task, rate } in &result.completions {
        writeln!(
            f,
            "  {sub_task:<18} {} {}",
            Number(rate.rate),
            rate.interval
        )?;
    }
    let per_episode = score.un_instructed as f64 / score.episodes as f64;
    write!(f, "  un-instructed      {per_episode:>5.2} per episode")?;
    for SubTaskRate { sub_task, rate } in &result.un_instructed_completions {
        write!(f, ", {sub_task} {} of {}", rate.count, rate.episodes)?;
    }
    writeln!(f)
}

/// Writes the completions of a sentence that commands nothing.
fn completions_alone(result: &SplitResult, f: &mut Formatter<'_>) -> fmt::Result {
    for SubTaskRate { sub_task, rate } in &result.un_instructed_completions {
        writeln!(
            f,
            "  {sub_task:<18} {} {}",
            Number(rate.rate),
            rate.interval
        )?;
    }
    writeln!(
        f,
        "  no success rate: the sentence names no sub-tasks to judge it by (--sub-tasks does)"
    )
}

fn latency(results: &Results, f: &mut Formatter<'_>) -> fmt::Result {
    writeln!(f, "\ncontroller [µs]      calls      p50      p99      max")?;
    let latency = &results.latency_us;
    let rows = [
        ("ordinary step", &latency.ordinary),
        ("decision step", &latency.decision),
        ("instruct", &latency.instruct),
    ];
    for (
        name,
        Latency {
            count,
            p50,
            p99,
            max,
        },
    ) in rows
    {
        let [p50, p99, max] = [p50, p99, max]
            .map(|value| value.map_or("-".to_owned(), |value| format!("{value:.1}")));
        writeln!(f, "{name:<16} {count:>9} {p50:>8} {p99:>8} {max:>8}")?;
    }
    Ok(())
}

fn time(results: &Results, f: &mut Formatter<'_>) -> fmt::Result {
    let time = &results.time;
    let threads = if time.threads == 1 {
        "thread"
    } else {
        "threads"
    };
    write!(f, "\n{:.1} s on {} {threads}", time.wall_s, time.threads)?;
    if let Some(share) = time.simulator_share {
        let controller = 100.0 * time.controller_cpu_s / time.episodes_cpu_s;
        let simulator = 100.0 * share;
        write!(
            f,
            "; CPU time of the episodes: {simulator:.1} % inside MuJoCo, {controller:.1} % in the controller"
        )?;
    }
    writeln!(f)
}

/// Formats a rate, or a dash without episodes, in 5 columns.
struct Number(Option<f64>);

impl Display for Number {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(value) => write!(f, "{value:>5.2}"),
            None => write!(f, "{:>5}", "-"),
        }
    }
}
