//! Measures the two runs that the ratios are from: hot, and at 50 Hz.

use std::time::Duration;

use lads_benches::sweep::Sweep;
use lads_pace::BenchError;
use lads_pace::clock::Pace;
use lads_pace::contender::{Block, Computed, Contender, Episode, Kind, Sample, Work, measure};
use lads_pace::load::Load;
use lads_pace::realtime::Realtime;
use lads_pace::stats::{Ratio, Rounds};
use lads_pace::suite::Field;
use lads_pace::turns::take_turns;
use serde_json::{Value, json};

use crate::Effort;
use crate::charts::Line;

/// Tokens in the context of the control steps that are compared.
pub const CONTEXT: usize = 300;

/// Control steps per second of the paced runs.
pub const RATE: u64 = 50;

/// Number of calls in a block.
const CALLS: usize = 20;

/// Measured rounds of several contenders, by name.
pub struct Run {
    pub names: Vec<String>,
    pub rounds: Vec<Rounds>,
    pub granted: String,
}

impl Run {
    /// Returns the rounds of a contender.
    pub fn of(&self, name: &str) -> Option<&Rounds> {
        let at = self.names.iter().position(|known| known == name)?;
        self.rounds.get(at)
    }

    /// Lists the latencies of all contenders and kinds, in microseconds.
    pub fn rows(&self) -> Vec<Value> {
        let us = |ns: u64| ns as f64 / 1e3;
        let mut rows = vec![];
        for (name, rounds) in self.names.iter().zip(&self.rounds) {
            for kind in rounds.kinds() {
                if let Some(s) = rounds.summary(kind) {
                    rows.push(json!({
                        "contender": name, "kind": kind.name(), "calls": s.count,
                        "p50": us(s.p50), "p90": us(s.p90), "p99": us(s.p99), "p99.9": us(s.p999), "max": us(s.max),
                        "spread": us(s.spread), "misses": rounds.misses(1_000_000_000 / RATE),
                    }));
                }
            }
        }
        rows
    }
}

/// A contender that reads as many bytes as weights have, the low level's or those of a policy of one entry, and does nothing else.
pub struct Bare {
    name: String,
    sweep: Sweep,
    kind: Kind,
}

impl Bare {
    pub fn new(label: &str, bytes: usize) -> Self {
        Self {
            name: format!("bare sweep {label}"),
            sweep: Sweep::new(bytes),
            kind: Kind::Act,
        }
    }

    /// Makes a contender that reads as many bytes as a whole policy's weights have, in each control step.
    pub fn steps(label: &str, bytes: usize) -> Self {
        Self {
            kind: Kind::Ordinary,
            ..Self::new(label, bytes)
        }
    }
}

impl Contender for Bare {
    fn name(&self) -> &str {
        &self.name
    }

    fn detail(&self) -> String {
        format!("{} bytes, the widest vectors, one sum", self.sweep.bytes())
    }

    fn replay(&mut self, _: usize) -> Result<Vec<Computed>, BenchError> {
        Ok(vec![])
    }

    fn offers(&self, work: Work) -> bool {
        match work {
            Work::Act => self.kind == Kind::Act,
            Work::Steps { .. } => self.kind == Kind::Ordinary,
            Work::Instruct | Work::Recompute { .. } => false,
        }
    }

    fn block(&mut self, block: &Block, samples: &mut Vec<Sample>) -> Result<(), BenchError> {
        measure(block, samples, |_| {
            std::hint::black_box(self.sweep.read());
            Ok((self.kind, 0))
        })
    }
}

/// Measures hot, one after the other: the low level, control steps around [`CONTEXT`], instructions, and the whole history where it is
/// offered.
pub fn hot(
    field: &Field<'_>,
    contenders: &mut [&mut dyn Contender],
    effort: Effort,
    progress: &mut dyn FnMut(usize),
) -> Result<Run, BenchError> {
    let episode = field.episode;
    let block = |work, calls| Block {
        work,
        pace: Pace::Hot,
        calls,
        settle: 3,
    };
    let first = episode.first_around(CONTEXT, field.words, CALLS);
    let blocks = [
        block(Work::Act, 2 * CALLS),
        block(Work::Steps { first }, CALLS),
        block(Work::Instruct, 3),
    ];
    let mut rounds = take_turns(
        contenders,
        &vec![blocks.to_vec(); effort.hot_rounds],
        progress,
    )?;
    // Tens of milliseconds a call: a few are enough.
    let whole = [Block {
        settle: 1,
        ..block(
            Work::Recompute {
                step: episode.context_steps - 1,
            },
            2,
        )
    }];
    let recomputed = take_turns(
        contenders,
        &vec![whole.to_vec(); effort.recompute_rounds],
        &mut |_| (),
    )?;
    for (rounds, more) in rounds.iter_mut().zip(recomputed) {
        rounds.0.extend(more.0);
    }
    Ok(Run {
        names: names(contenders),
        rounds,
        granted: "ordinary scheduling".into(),
    })
}

/// Measures once every 20 ms, asleep in between.
pub fn paced(
    field: &Field<'_>,
    contenders: &mut [&mut dyn Contender],
    rounds: usize,
    load: usize,
    progress: &mut dyn FnMut(usize),
) -> Result<Run, BenchError> {
    let _load = Load::start(load);
    let pace = Pace::Every(Duration::from_nanos(1_000_000_000 / RATE));
    let block = |work, calls| Block {
        work,
        pace,
        calls,
        settle: 3,
    };
    let first = field.episode.first_around(CONTEXT, field.words, CALLS);
    let blocks = [block(Work::Act, CALLS), block(Work::Steps { first }, CALLS)];
    let granted = Realtime::enter();
    let rounds = take_turns(contenders, &vec![blocks.to_vec(); rounds], progress)?;
    Ok(Run {
        names: names(contenders),
        rounds,
        granted: granted.to_string(),
    })
}

/// Measures ordinary steps at several contexts, hot: `(tokens, microseconds)` for each contender.
pub fn contexts(
    field: &Field<'_>,
    contenders: &mut [&mut dyn Contender],
    effort: Effort,
) -> Result<Vec<Line>, BenchError> {
    let episode: &Episode = field.episode;
    let last = episode.context_steps.saturating_sub(CALLS);
    let firsts: Vec<_> = (0..=6).map(|i| i * last / 6).collect();
    let mut points = vec![vec![]; contenders.len()];
    for first in firsts {
        let block = Block {
            work: Work::Steps { first },
            pace: Pace::Hot,
            calls: CALLS,
            settle: 3,
        };
        let rounds = vec![vec![block]; effort.context_rounds];
        let runs = take_turns(contenders, &rounds, &mut |_| ())?;
        let tokens = field.words + 2 * block.middle();
        for (points, rounds) in points.iter_mut().zip(&runs) {
            if let Some(summary) = rounds.summary(Kind::Ordinary) {
                points.push((tokens as f64, summary.p50 as f64 / 1e3));
            }
        }
    }
    Ok(names(contenders).into_iter().zip(points).collect())
}

fn names(contenders: &[&mut dyn Contender]) -> Vec<String> {
    contenders
        .iter()
        .map(|contender| contender.name().to_owned())
        .collect()
}

/// Computes the ratio of two rows of rounds, and how far its first and second half of the run are apart.
pub fn ratio(above: &[f64], below: &[f64]) -> Option<(Ratio, f64)> {
    let whole = Ratio::of(above, below)?;
    let middle = above.len().min(below.len()) / 2;
    let half = |from: usize, to: usize| Ratio::of(above.get(from..to)?, below.get(from..to)?);
    let apart = match (half(0, middle), half(middle, 2 * middle)) {
        (Some(a), Some(b)) => (a.median / b.median - 1.0).abs(),
        _ => f64::NAN,
    };
    Some((whole, apart))
}
