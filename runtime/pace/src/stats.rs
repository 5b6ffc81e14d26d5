//! Distributions of latencies, and ratios that hold on a busy machine.
//!
//! A ratio is taken within one round, in which all contenders were measured within a second or so,
//! and then the median over the rounds: a slowdown of the machine that lasts longer than a round
//! affects both sides of a ratio.

use hdrhistogram::Histogram;
use serde::Serialize;

use crate::contender::{Kind, Sample};

/// Distribution of the latencies of one kind of call, in nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summary {
    /// Number of calls.
    pub count: u64,
    /// Median latency: half of the calls took at most this.
    pub p50: u64,
    /// 90th percentile of the latency.
    pub p90: u64,
    /// 99th percentile of the latency.
    pub p99: u64,
    /// 99.9th percentile of the latency; with fewer than 1,000 calls, the longest.
    pub p999: u64,
    /// Longest latency.
    pub max: u64,
    /// Median absolute deviation of the rounds' medians.
    pub spread: u64,
}

/// Returns the median of some numbers; NaN if there are none.
pub fn median(numbers: &[f64]) -> f64 {
    quantile(numbers, 0.5)
}

/// Returns a quantile of some numbers, interpolated; NaN if there are none.
pub fn quantile(numbers: &[f64], q: f64) -> f64 {
    let mut sorted = numbers.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = q * sorted.len().saturating_sub(1) as f64;
    let (below, above) = (
        sorted.get(at.floor() as usize),
        sorted.get(at.ceil() as usize),
    );
    match (below, above) {
        (Some(below), Some(above)) => below + (above - below) * at.fract(),
        _ => f64::NAN,
    }
}

/// Returns the median absolute deviation from the median.
pub fn spread(numbers: &[f64]) -> f64 {
    let centre = median(numbers);
    let deviations: Vec<_> = numbers.iter().map(|x| (x - centre).abs()).collect();
    median(&deviations)
}

/// Samples of one contender, round by round.
#[derive(Debug, Clone, Default)]
pub struct Rounds(pub Vec<Vec<Sample>>);

impl Rounds {
    /// Returns all samples of a kind.
    pub fn of(&self, kind: Kind) -> impl Iterator<Item = &Sample> {
        self.0
            .iter()
            .flatten()
            .filter(move |sample| sample.kind == kind)
    }

    /// Returns the kinds that occur.
    pub fn kinds(&self) -> Vec<Kind> {
        let present = |kind: &Kind| self.of(*kind).next().is_some();
        Kind::ALL.into_iter().filter(present).collect()
    }

    /// Returns a quantile of each round, in nanoseconds; NaN for a round without such a call.
    pub fn quantiles(&self, kind: Kind, q: f64) -> Vec<f64> {
        let of_round = |round: &Vec<Sample>| {
            let took: Vec<_> = round
                .iter()
                .filter(|sample| sample.kind == kind)
                .map(|sample| sample.took as f64)
                .collect();
            quantile(&took, q)
        };
        self.0.iter().map(of_round).collect()
    }

    /// Returns the distribution over all rounds; `None` without such calls.
    pub fn summary(&self, kind: Kind) -> Option<Summary> {
        summary(
            self.of(kind).map(|sample| sample.took),
            &self.quantiles(kind, 0.5),
        )
    }

    /// Returns the distribution of the wake-ups' lateness.
    pub fn lateness(&self) -> Option<Summary> {
        summary(self.0.iter().flatten().map(|sample| sample.late), &[])
    }

    /// Counts the calls whose result came after the next deadline.
    pub fn misses(&self, period_ns: u64) -> usize {
        let late = |sample: &&Sample| sample.late + sample.took > period_ns;
        self.0.iter().flatten().filter(late).count()
    }
}

fn summary(values: impl Iterator<Item = u64>, medians: &[f64]) -> Option<Summary> {
    let mut histogram = Histogram::<u64>::new(3).ok()?;
    for value in values {
        histogram.record(value.max(1)).ok()?;
    }
    let medians: Vec<_> = medians.iter().copied().filter(|x| !x.is_nan()).collect();
    (!histogram.is_empty()).then(|| Summary {
        count: histogram.len(),
        p50: histogram.value_at_quantile(0.5),
        p90: histogram.value_at_quantile(0.9),
        p99: histogram.value_at_quantile(0.99),
        p999: histogram.value_at_quantile(0.999),
        max: histogram.max(),
        spread: if medians.is_empty() {
            0
        } else {
            spread(&medians) as u64
        },
    })
}

/// Ratio of two sides: the median over rounds, and the quartiles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Ratio {
    /// Median over the rounds.
    pub median: f64,
    /// First quartile over the rounds.
    pub low: f64,
    /// Third quartile over the rounds.
    pub high: f64,
}

impl Ratio {
    /// Computes the ratio of two rows of numbers, one pair for each round.
    pub fn of(above: &[f64], below: &[f64]) -> Option<Self> {
        let pairs = above.iter().zip(below).map(|(a, b)| a / b);
        let ratios: Vec<_> = pairs.filter(|ratio| ratio.is_finite()).collect();
        (!ratios.is_empty()).then(|| Self {
            median: median(&ratios),
            low: quantile(&ratios, 0.25),
            high: quantile(&ratios, 0.75),
        })
    }
}

/// Fits the exponent `e` of `y = c x^e` by least squares on logarithms, and returns it with the
/// quality of the fit (R²).
pub fn exponent(points: &[(f64, f64)]) -> Option<(f64, f64)> {
    let logs: Vec<_> = points
        .iter()
        .filter(|(x, y)| *x > 0.0 && *y > 0.0)
        .map(|(x, y)| (x.ln(), y.ln()))
        .collect();
    let n = logs.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / n;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let sum =
        |of: &dyn Fn(f64, f64) -> f64| logs.iter().map(|(x, y)| of(x - mx, y - my)).sum::<f64>();
    let (xx, xy, yy) = (sum(&|x, _| x * x), sum(&|x, y| x * y), sum(&|_, y| y * y));
    (logs.len() > 1 && xx > 0.0)
        .then(|| (xy / xx, if yy > 0.0 { xy * xy / (xx * yy) } else { 1.0 }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(took: u64, late: u64) -> Sample {
        Sample {
            kind: Kind::Act,
            step: 0,
            late,
            took,
        }
    }

    #[test]
    fn medians_quantiles_and_spreads() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0, 2.0, 3.0]), 2.5);
        assert_eq!(quantile(&[0.0, 10.0], 0.25), 2.5);
        assert!(median(&[]).is_nan());
        assert_eq!(spread(&[1.0, 2.0, 9.0]), 1.0);
    }

    #[test]
    fn a_ratio_is_taken_round_by_round() {
        // The machine is three times slower in the second round; the ratio does not see it.
        let ratio = Ratio::of(&[10.0, 30.0, 11.0], &[20.0, 60.0, 22.0]).expect("three pairs");
        assert_eq!((ratio.median, ratio.low, ratio.high), (0.5, 0.5, 0.5));
        assert_eq!(Ratio::of(&[f64::NAN], &[1.0]), None);
        assert_eq!(Ratio::of(&[], &[]), None);
    }

    #[test]
    fn summaries_count_misses_and_keep_the_longest() {
        let rounds = Rounds(vec![
            vec![sample(100, 0), sample(200, 900)],
            vec![sample(5000, 1)],
        ]);
        let summary = rounds.summary(Kind::Act).expect("three samples");
        assert_eq!((summary.count, summary.p50), (3, 200));
        assert!(summary.max.abs_diff(5000) <= 5);
        assert_eq!(rounds.misses(1000), 2);
        assert_eq!(rounds.summary(Kind::Decision), None);
        assert_eq!(rounds.kinds(), [Kind::Act]);
    }

    #[test]
    fn exponents_of_powers() {
        let points: Vec<_> = (1..6)
            .map(|x| (f64::from(x), 3.0 * f64::from(x).powf(1.5)))
            .collect();
        let (e, fit) = exponent(&points).expect("five points");
        assert!((e - 1.5).abs() < 1e-9 && fit > 0.999);
        assert_eq!(exponent(&points[..1]), None);
    }
}
