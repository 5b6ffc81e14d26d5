//! Statistics of a verification: tests whether two success rates are the same.
//!
//! - Paired proportions, from the same episodes: Tango's score interval (Tango 1998, *Statistics in Medicine* 17:891), and exact tests of
//!   its statistic that hold their level at any number of pairs ([`exact`]).
//! - Paired means: tests by betting that hold their level for any bounded numbers ([`counts`]).
//! - Two samples of proportions: Newcombe's hybrid score interval of the difference (Newcombe 1998, *Statistics in Medicine* 17:873, method
//!   10), from two Wilson intervals. Reported, not judged.
//! - McNemar's exact test: under no difference, each pair that differs is as likely to differ one way as the other. Reported, not judged:
//!   with enough pairs it finds the smallest difference.
//! - Equivalence within a margin by two one-sided tests at 5 % (Schuirmann 1987).
//!
//! Nothing here can fail: over no episodes an interval is the widest there is and no test rejects.

pub mod counts;
pub mod exact;
mod rates;
#[cfg(test)]
mod simulation;

use serde::Serialize;
use statrs::distribution::{ContinuousCDF as _, Normal};

pub use self::counts::Counts;
pub use self::rates::Pairs;
use crate::metrics::Interval;

/// Level of each of the two one-sided tests of equivalence.
pub const EQUIVALENCE_LEVEL: f64 = 0.05;
/// Confidence of the reported intervals.
const REPORTED: f64 = 0.95;
/// Confidence of the interval that is equivalent to two one-sided tests at 5 %.
const EQUIVALENCE: f64 = 0.90;
/// Largest growth at which a search for a sufficient number of episodes ends, as a factor on their number.
const MOST_GROWTH: f64 = 64.0;

/// Difference of run minus reference, and whether it is negligible.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Difference {
    /// Estimate of the difference.
    pub estimate: f64,
    /// 95 % interval of the difference.
    pub interval: Interval,
    /// 90 % interval of the difference.
    pub interval_90: Interval,
    /// Largest negligible difference.
    pub margin: f64,
    /// Larger p-value of the two one-sided tests of a difference as large as the margin; `None` for two samples, which are not judged.
    pub p_equivalence: Option<f64>,
    /// Smaller p-value of the two one-sided tests of a difference within the margin; `None` for two samples.
    pub p_beyond: Option<f64>,
    /// Whether the difference is negligible at 5 %: by the tests where there are any, else because the 90 % interval lies inside the
    /// margin.
    pub equivalent: bool,
    /// Factor by which the number of episodes must grow to show equivalence at this estimate; `None` if it is shown already, or no number
    /// suffices.
    #[serde(skip)]
    pub growth_needed: Option<f64>,
}

impl Difference {
    /// Makes the difference of two independent samples.
    fn apart(estimate: f64, margin: f64, interval: impl Fn(f64) -> Interval) -> Self {
        let interval_90 = interval(quantile(EQUIVALENCE));
        Self {
            estimate,
            interval: interval(quantile(REPORTED)),
            interval_90,
            margin,
            p_equivalence: None,
            p_beyond: None,
            equivalent: -margin < interval_90.0 && interval_90.1 < margin,
            growth_needed: None,
        }
    }

    /// Whether a test at `level` finds that the difference is larger than the margin.
    pub fn beyond_margin(&self, level: f64) -> bool {
        self.p_beyond.is_some_and(|p| p < level)
    }
}

/// Computes the two-sided standard normal quantile of a confidence.
fn quantile(confidence: f64) -> f64 {
    Normal::standard().inverse_cdf(f64::midpoint(1.0, confidence))
}

fn share(count: usize, n: usize) -> f64 {
    if n == 0 { 0.0 } else { count as f64 / n as f64 }
}

/// Finds the smallest factor up to [`MOST_GROWTH`] for which `enough` holds, to 2 %, provided that it goes on holding once it does.
fn smallest_growth(enough: impl Fn(f64) -> bool) -> Option<f64> {
    let mut high = 1.0;
    while !enough(high) {
        high *= 2.0;
        if high > MOST_GROWTH {
            return None;
        }
    }
    let mut low = high / 2.0;
    while high / low > 1.02 {
        let middle = f64::midpoint(low, high);
        if enough(middle) {
            high = middle;
        } else {
            low = middle;
        }
    }
    Some(high.max(1.0))
}

/// Finds where a function that falls through `level` between `low` and `high` does so.
fn crossing(falling: impl Fn(f64) -> f64, level: f64, low: f64, high: f64) -> f64 {
    let (mut low, mut high) = (low, high);
    for _ in 0..60 {
        let middle = f64::midpoint(low, high);
        if falling(middle) > level {
            low = middle;
        } else {
            high = middle;
        }
    }
    f64::midpoint(low, high)
}
