//! Measures a policy at its real rate, over whole episodes, alone or beside peers, as a control
//! thread would see it.
//!
//! A run is made of rounds. In a round every contender gets one block at one part of the episode (two periods of the schedule long),
//! one of actions for a given index and one of new instructions, where the policy has them; within a block the calls come at the period's absolute deadlines. The rounds go through
//! the parts of the episode again and again.

use std::fmt::{self, Display, Formatter};
use std::time::Duration;

use serde_json::{Value, json};

use crate::clock::Pace;
use crate::contender::{Block, Contender, Kind, Work};
use crate::error::BenchError;
use crate::load::Load;
use crate::realtime::Realtime;
use crate::stats::{Ratio, Rounds, Summary, median};
use crate::suite::{Candidate, Entrant, Field, Others, with_contenders};
use crate::turns::take_turns;

/// Number of calls before the recorded ones of each block.
const SETTLE: usize = 3;

/// Number of actions for a given index in a round.
const ACTIONS: usize = 10;

/// Number of new instructions in a round.
const INSTRUCTIONS: usize = 2;

/// Smallest number of control steps of a part of the episode.
const FEWEST: usize = 8;

/// Settings of a measurement.
#[derive(Debug, Clone)]
pub struct Protocol {
    /// Number of control steps per second.
    pub rate: f64,
    /// Duration for each contender, in seconds.
    pub seconds: f64,
    /// Number of threads that make load during the measurement.
    pub load: usize,
}

/// An invalid field of a [`Protocol`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {wrong}; {remedy}")]
pub struct InvalidField {
    /// Name of the field.
    pub field: &'static str,
    /// Fault of the field.
    pub wrong: String,
    /// Value to give instead.
    pub remedy: String,
}

impl Protocol {
    /// Refuses rates, times and loads with which nothing can be measured on this machine.
    pub fn check(&self) -> Result<(), InvalidField> {
        let senseless = |field, wrong, remedy: &str| {
            let remedy = remedy.to_owned();
            Err(InvalidField {
                field,
                wrong,
                remedy,
            })
        };
        if !(self.rate.is_finite() && (0.1..=10_000.0).contains(&self.rate)) {
            return senseless("rate", format!("{} Hz", self.rate), "give 0.1 to 10000");
        }
        if !(self.seconds.is_finite() && (0.1..=86_400.0).contains(&self.seconds)) {
            return senseless(
                "seconds",
                format!("{} s", self.seconds),
                "give 0.1 to 86400",
            );
        }
        let most = std::thread::available_parallelism().map_or(64, |cores| 16 * cores.get());
        if self.load > most {
            let remedy = format!("give at most {most} on this machine");
            return senseless("load", format!("{} threads", self.load), &remedy);
        }
        Ok(())
    }
}

/// Results of a measurement.
#[derive(Debug)]
pub struct Report {
    protocol: Protocol,
    granted: String,
    entrants: Vec<Entrant>,
    absent: Vec<String>,
    /// Image channels of the policy.
    images: Vec<String>,
    runs: Vec<Rounds>,
    /// Number of control steps of one part of the episode.
    part: usize,
    steps: usize,
}

/// Measures the candidate images and all other contenders.
pub fn measure(
    candidates: &[Candidate<'_>],
    others: &dyn Others,
    protocol: &Protocol,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Report, BenchError> {
    protocol.check().map_err(|error| BenchError::of(&error))?;
    let _load = Load::start(protocol.load);
    with_contenders(candidates, others, vec![], |field, contenders| {
        run(field, contenders, protocol, progress)
    })
}

fn run(
    field: &Field<'_>,
    contenders: &mut [&mut dyn Contender],
    protocol: &Protocol,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Report, BenchError> {
    let steps = field.episode.context_steps;
    let part = (2 * field.episode.period).max(FEWEST).min(steps);
    let parts = steps / part;
    let pace = Pace::Every(Duration::from_secs_f64(1.0 / protocol.rate));
    let block = |work, calls, settle| Block {
        work,
        pace,
        calls,
        settle,
    };
    let round = |number: usize| {
        // By the golden ratio: however many rounds there are, they are spread over the whole episode.
        let at = ((number as f64 * 0.618_033_988_75).fract() * parts as f64) as usize;
        let first = at * part;
        vec![
            block(Work::Steps { first }, part, SETTLE),
            block(Work::Act, ACTIONS, SETTLE),
            block(Work::Instruct, INSTRUCTIONS, 1),
        ]
    };
    let of_round = part + ACTIONS + INSTRUCTIONS + 2 * SETTLE + 1;
    let rounds = ((protocol.rate * protocol.seconds) as usize / of_round).max(1);
    let rounds: Vec<_> = (0..rounds).map(round).collect();
    let granted = Realtime::enter();
    let mut told = |done| progress(done, rounds.len());
    let runs = take_turns(contenders, &rounds, &mut told)?;
    Ok(Report {
        protocol: protocol.clone(),
        granted: granted.to_string(),
        entrants: field.entrants.clone(),
        absent: field.absent.clone(),
        images: field.episode.images.clone(),
        runs,
        part,
        steps,
    })
}

impl Report {
    fn period_ns(&self) -> u64 {
        (1e9 / self.protocol.rate) as u64
    }

    /// Compares the first contender with each of the others, by kind of call.
    fn ratios(&self) -> Vec<(&Entrant, Kind, Ratio, Ratio)> {
        let mut all = vec![];
        let Some((ours, others)) = self.runs.split_first() else {
            return all;
        };
        for (run, entrant) in others.iter().zip(self.entrants.iter().skip(1)) {
            for kind in ours.kinds() {
                let at = |q| Ratio::of(&ours.quantiles(kind, q), &run.quantiles(kind, q));
                if let (Some(p50), Some(max)) = (at(0.5), at(1.0)) {
                    all.push((entrant, kind, p50, max));
                }
            }
        }
        all
    }

    /// Compares a decision step with an ordinary one of the same contender.
    fn decision(run: &Rounds) -> Option<Ratio> {
        Ratio::of(
            &run.quantiles(Kind::Decision, 0.5),
            &run.quantiles(Kind::Ordinary, 0.5),
        )
    }

    /// Returns the median of the ordinary steps in each part of the episode.
    fn growth(&self, run: &Rounds) -> Vec<(usize, f64)> {
        let of_part = |first: usize| {
            let inside = |step: usize| (first..first + self.part).contains(&step);
            let took: Vec<_> = run
                .of(Kind::Ordinary)
                .filter(|sample| inside(sample.step))
                .map(|sample| sample.took as f64)
                .collect();
            (first, median(&took))
        };
        let parts = (0..self.steps).step_by(self.part).map(of_part);
        parts.filter(|(_, took)| !took.is_nan()).collect()
    }

    /// Formats the report as one JSON object; times in microseconds.
    pub fn json(&self) -> Value {
        let contenders = self.entrants.iter().zip(&self.runs).map(|(entrant, run)| {
            let kinds: serde_json::Map<_, _> = run
                .kinds()
                .into_iter()
                .filter_map(|kind| Some((kind.name().to_owned(), summary_json(&run.summary(kind)?))))
                .collect();
            json!({
                "name": entrant.name,
                "detail": entrant.detail,
                "largest_error": entrant.largest_error,
                "first_us": us(entrant.first_ns),
                "again_us": us(entrant.again_ns),
                "latency_us": kinds,
                "lateness_us": run.lateness().as_ref().map(summary_json),
                "deadline_misses": run.misses(self.period_ns()),
                "decision_to_ordinary": Self::decision(run),
                "growth_us": self.growth(run).iter().map(|(step, took)| json!([step, took / 1e3])).collect::<Vec<_>>(),
            })
        });
        let ratios = self.ratios().into_iter().map(|(entrant, kind, p50, max)| {
            json!({ "to": entrant.name, "kind": kind.name(), "p50": p50, "max": max })
        });
        json!({
            "rate_hz": self.protocol.rate,
            "period_us": us(self.period_ns()),
            "images": self.images,
            "seconds": self.protocol.seconds,
            "load_threads": self.protocol.load,
            "granted": self.granted,
            "of": self.entrants.first().map(|entrant| &entrant.name),
            "ratios": ratios.collect::<Vec<_>>(),
            "contenders": contenders.collect::<Vec<_>>(),
            "absent": self.absent,
        })
    }
}

fn us(ns: u64) -> f64 {
    ns as f64 / 1e3
}

fn summary_json(summary: &Summary) -> Value {
    json!({
        "count": summary.count,
        "p50": us(summary.p50),
        "p90": us(summary.p90),
        "p99": us(summary.p99),
        "p99.9": us(summary.p999),
        "max": us(summary.max),
        "spread_of_medians": us(summary.spread),
    })
}

impl Display for Report {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Protocol {
            rate,
            seconds,
            load,
        } = &self.protocol;
        writeln!(
            f,
            "{rate} Hz (a period of {:.1} us), {seconds} s for each contender, {load} load threads, {}",
            us(self.period_ns()),
            self.granted
        )?;
        if !self.images.is_empty() {
            let images = self.images.join(", ");
            writeln!(
                f,
                "  each control step reads a frame ({images}) that is there when it begins: to draw or capture it is not in the times"
            )?;
        }
        for entrant in &self.entrants {
            writeln!(f, "  {:<13} {}", entrant.name, entrant.detail)?;
        }
        for absent in &self.absent {
            writeln!(f, "  not run: {absent}")?;
        }
        self.write_ratios(f)?;
        self.write_latencies(f)?;
        self.write_growth(f)
    }
}

impl Report {
    fn write_ratios(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "\nratios (median over rounds, quartiles)         p50                  longest"
        )?;
        let ours = self.entrants.first().map_or("", |entrant| &entrant.name);
        for (entrant, kind, p50, max) in self.ratios() {
            let pair = format!("{ours} / {}", entrant.name);
            writeln!(
                f,
                "  {pair:<28} {:<9} {}  {}",
                kind.name(),
                Shown(p50),
                Shown(max)
            )?;
        }
        for (entrant, run) in self.entrants.iter().zip(&self.runs) {
            if let Some(ratio) = Self::decision(run) {
                writeln!(
                    f,
                    "  {:<28} {:<9} {}",
                    entrant.name,
                    "decision / ordinary step",
                    Shown(ratio)
                )?;
            }
        }
        Ok(())
    }

    fn write_latencies(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let columns =
            ["calls", "p50", "p90", "p99", "p99.9", "max"].map(|name| format!("{name:>9}"));
        writeln!(f, "\nlatency [us]               {}", columns.concat())?;
        for (entrant, run) in self.entrants.iter().zip(&self.runs) {
            let kinds = run
                .kinds()
                .into_iter()
                .filter_map(|kind| Some((kind.name(), run.summary(kind)?)));
            let late = run.lateness().map(|summary| ("wake-up", summary));
            for (name, s) in kinds.chain(late) {
                let numbers =
                    [s.p50, s.p90, s.p99, s.p999, s.max].map(|ns| format!("{:>9.1}", us(ns)));
                writeln!(
                    f,
                    "  {:<13} {name:<10} {:>9}{}",
                    entrant.name,
                    s.count,
                    numbers.concat()
                )?;
            }
        }
        writeln!(
            f,
            "\n                           misses   first instruction and step [us]   again [us]"
        )?;
        for (entrant, run) in self.entrants.iter().zip(&self.runs) {
            let misses = run.misses(self.period_ns());
            let [first, again] = [entrant.first_ns, entrant.again_ns].map(us);
            writeln!(
                f,
                "  {:<23} {misses:>7} {first:>25.1} {again:>20.1}",
                entrant.name
            )?;
        }
        Ok(())
    }

    fn write_growth(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "\nordinary step, p50 [us], from control step")?;
        let growth: Vec<_> = self.runs.iter().map(|run| self.growth(run)).collect();
        let steps = growth
            .first()
            .into_iter()
            .flatten()
            .map(|(step, _)| format!("{step:>7}"));
        writeln!(f, "  {:<13} {}", "", steps.collect::<String>())?;
        for (entrant, growth) in self.entrants.iter().zip(&growth) {
            let took = growth
                .iter()
                .map(|(_, took)| format!("{:>7.1}", took / 1e3));
            writeln!(f, "  {:<13} {}", entrant.name, took.collect::<String>())?;
        }
        Ok(())
    }
}

/// Displays a ratio with its quartiles, in columns.
struct Shown(Ratio);

impl Display for Shown {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Ratio { median, low, high } = self.0;
        write!(f, "{median:>6.3} ({low:.3} to {high:.3})")
    }
}
