//! The statistics of a verification: are two success rates the same?
//!
//! - Two samples of proportions: Newcombe's hybrid score interval of the difference (Newcombe 1998, *Statistics in Medicine* 17:873, method
//!   10), from two Wilson intervals.
//! - Paired proportions, from the same episodes: Newcombe's interval with the pairs' correlation (Newcombe 1998, *Statistics in Medicine*
//!   17:2635, method 10). It has a width even where no pair differs.
//! - McNemar's exact test: under no difference, each pair that differs is as likely to differ one way as the other.
//! - Equivalence within a margin by two one-sided tests at 5 %: the 90 % interval lies inside the margin (Schuirmann 1987).
//!
//! Nothing here can fail: over no episodes an interval is the widest there is.

use serde::Serialize;
use statrs::distribution::{Binomial, ContinuousCDF as _, DiscreteCDF as _, Normal};

use crate::metrics::Interval;

/// Confidence of the reported intervals.
const REPORTED: f64 = 0.95;
/// Confidence of the interval that two one-sided tests at 5 % amount to.
const EQUIVALENCE: f64 = 0.90;

/// A difference, run minus reference, and whether it is negligible.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Difference {
    /// The estimate.
    pub estimate: f64,
    /// Its 95 % interval.
    pub interval: Interval,
    /// Its 90 % interval, which decides the equivalence test.
    pub interval_90: Interval,
    /// What is negligible.
    pub margin: f64,
    /// Whether the 90 % interval lies inside `-margin..margin`: equivalent at 5 %.
    pub equivalent: bool,
}

impl Difference {
    fn new(estimate: f64, margin: f64, interval: impl Fn(f64) -> Interval) -> Self {
        let interval_90 = interval(quantile(EQUIVALENCE));
        Self {
            estimate,
            interval: interval(quantile(REPORTED)),
            interval_90,
            margin,
            equivalent: -margin < interval_90.0 && interval_90.1 < margin,
        }
    }

    /// Whether even the 95 % interval lies wholly outside of the margin.
    pub fn beyond_margin(&self) -> bool {
        self.interval.0 > self.margin || self.interval.1 < -self.margin
    }

    /// How many times as many pairs would make the interval fit into the margin, were the estimate to stay; `None` where it is no matter
    /// of number. An interval narrows with the root of the number.
    pub fn growth_needed(&self) -> Option<f64> {
        let room = self.margin - self.estimate.abs();
        let half = (self.interval_90.1 - self.estimate).max(self.estimate - self.interval_90.0);
        (room > 0.0).then(|| (half / room).powi(2).max(1.0))
    }
}

/// Two-sided standard normal quantile of a confidence.
fn quantile(confidence: f64) -> f64 {
    Normal::standard().inverse_cdf(f64::midpoint(1.0, confidence))
}

/// How pairs of episodes fell out.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Pairs {
    /// Done in both.
    pub both: usize,
    /// Done in the run only.
    pub run_only: usize,
    /// Done in the reference only.
    pub reference_only: usize,
    /// Done in neither.
    pub neither: usize,
}

impl Pairs {
    /// One more pair.
    pub fn add(&mut self, run: bool, reference: bool) {
        match (run, reference) {
            (true, true) => self.both += 1,
            (true, false) => self.run_only += 1,
            (false, true) => self.reference_only += 1,
            (false, false) => self.neither += 1,
        }
    }

    /// Number of pairs.
    pub fn len(&self) -> usize {
        self.both + self.run_only + self.reference_only + self.neither
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Successes of run and reference.
    fn successes(&self) -> [usize; 2] {
        [self.both + self.run_only, self.both + self.reference_only]
    }

    /// Two-sided p-value of McNemar's exact test; 1 where no pair differs.
    pub fn mcnemar(&self) -> f64 {
        let differing = (self.run_only + self.reference_only) as u64;
        let fewer = self.run_only.min(self.reference_only) as u64;
        let Ok(fair) = Binomial::new(0.5, differing) else {
            return 1.0;
        };
        (2.0 * fair.cdf(fewer)).min(1.0)
    }

    /// Difference of the rates, the pairing used.
    pub fn paired(&self, margin: f64) -> Difference {
        let [run, reference] = self.successes();
        let n = self.len();
        let correlation = self.correlation();
        let estimate = share(run, n) - share(reference, n);
        Difference::new(estimate, margin, |z| {
            hybrid(estimate, (run, n), (reference, n), correlation, z)
        })
    }

    /// Difference of the rates as if run and reference were two samples.
    pub fn unpaired(&self, margin: f64) -> Difference {
        let [run, reference] = self.successes();
        let n = self.len();
        let estimate = share(run, n) - share(reference, n);
        Difference::new(estimate, margin, |z| {
            hybrid(estimate, (run, n), (reference, n), 0.0, z)
        })
    }

    /// The correlation of the pairs with Newcombe's continuity correction.
    fn correlation(&self) -> f64 {
        let [a, b, c, d] =
            [self.both, self.run_only, self.reference_only, self.neither].map(|x| x as f64);
        let product = (a + b) * (c + d) * (a + c) * (b + d);
        if product == 0.0 {
            return 0.0;
        }
        let excess = a * d - b * c;
        let half = self.len() as f64 / 2.0;
        let corrected = if excess > 0.0 {
            (excess - half).max(0.0)
        } else {
            excess
        };
        corrected / product.sqrt()
    }
}

fn share(count: usize, n: usize) -> f64 {
    if n == 0 { 0.0 } else { count as f64 / n as f64 }
}

/// The interval of a difference of two proportions out of their score intervals.
fn hybrid(
    estimate: f64,
    (x1, n1): (usize, usize),
    (x2, n2): (usize, usize),
    correlation: f64,
    z: f64,
) -> Interval {
    let (below1, above1) = score_arms(x1, n1, z);
    let (below2, above2) = score_arms(x2, n2, z);
    let arm = |a: f64, b: f64| (a * a - 2.0 * correlation * a * b + b * b).max(0.0).sqrt();
    Interval(
        (estimate - arm(below1, above2)).max(-1.0),
        (estimate + arm(above1, below2)).min(1.0),
    )
}

/// How far a Wilson interval reaches below and above its proportion; as far as there is room over no episodes.
fn score_arms(successes: usize, n: usize, z: f64) -> (f64, f64) {
    if n == 0 {
        return (1.0, 1.0);
    }
    let (p, n) = (share(successes, n), n as f64);
    let z2 = z * z;
    let centre = (p + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = z * (p * (1.0 - p) / n + z2 / (4.0 * n * n)).sqrt() / (1.0 + z2 / n);
    ((p - (centre - half)).max(0.0), (centre + half - p).max(0.0))
}

/// Numbers of completed sub-tasks, run and reference, episode by episode.
#[derive(Debug, Clone, Default)]
pub struct Counts(Vec<[f64; 2]>);

impl Counts {
    /// One more pair of episodes.
    pub fn add(&mut self, run: usize, reference: usize) {
        self.0.push([run as f64, reference as f64]);
    }

    fn mean(&self, of: impl Fn(&[f64; 2]) -> f64) -> f64 {
        self.0.iter().map(of).sum::<f64>() / self.0.len().max(1) as f64
    }

    fn variance(&self, of: impl Fn(&[f64; 2]) -> f64) -> f64 {
        let mean = self.mean(&of);
        self.mean(|pair| (of(pair) - mean).powi(2))
    }

    /// Difference of the means, the pairing used. One pair that differs by one is added to what was seen, so that to have seen no
    /// difference is not taken for certainty.
    pub fn paired(&self, margin: f64) -> Difference {
        let n = self.0.len().max(1) as f64;
        let error = ((self.variance(|[run, reference]| run - reference) + 1.0 / n) / n).sqrt();
        self.difference(margin, error)
    }

    /// Difference of the means as if run and reference were two samples.
    pub fn unpaired(&self, margin: f64) -> Difference {
        let n = self.0.len().max(1) as f64;
        let error = ((self.variance(|x| x[0]) + self.variance(|x| x[1]) + 1.0 / n) / n).sqrt();
        self.difference(margin, error)
    }

    fn difference(&self, margin: f64, error: f64) -> Difference {
        let estimate = self.mean(|[run, reference]| run - reference);
        Difference::new(estimate, margin, |z| {
            Interval(estimate - z * error, estimate + z * error)
        })
    }

    /// Means of run and reference.
    pub fn means(&self) -> [f64; 2] {
        [self.mean(|x| x[0]), self.mean(|x| x[1])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Stream;

    fn close(interval: Interval, low: f64, high: f64) {
        let near = |a: f64, b: f64| (a - b).abs() < 5e-5;
        assert!(
            near(interval.0, low) && near(interval.1, high),
            "{interval:?} against {low}, {high}"
        );
    }

    #[test]
    fn two_samples_agree_with_newcombe_1998_table_ii() {
        let interval = |x1, n1, x2, n2| {
            let estimate = share(x1, n1) - share(x2, n2);
            hybrid(estimate, (x1, n1), (x2, n2), 0.0, quantile(0.95))
        };
        close(interval(56, 70, 48, 80), 0.0524, 0.3339);
        close(interval(9, 10, 3, 10), 0.1705, 0.8090);
        close(interval(10, 10, 0, 20), 0.6791, 1.0);
    }

    #[test]
    fn pairs_without_correlation_are_two_samples() {
        // One margin is empty, so the correlation counts as none.
        let pairs = Pairs {
            both: 40,
            run_only: 0,
            reference_only: 0,
            neither: 0,
        };
        assert_eq!(pairs.paired(0.1), pairs.unpaired(0.1));
        assert_eq!(pairs.mcnemar(), 1.0);
    }

    #[test]
    fn mcnemar_by_hand() {
        let pairs = |run_only, reference_only| Pairs {
            both: 9,
            run_only,
            reference_only,
            neither: 3,
        };
        // 2 · (1 + 5) / 2^5 and 2 · 1 / 2^6.
        assert!((pairs(1, 4).mcnemar() - 0.375).abs() < 1e-12);
        assert!((pairs(6, 0).mcnemar() - 0.03125).abs() < 1e-12);
        assert_eq!(pairs(3, 3).mcnemar(), 1.0);
    }

    #[test]
    fn the_95_percent_interval_of_pairs_covers_the_truth_about_that_often() {
        let (n, trials) = (60, 2_000);
        let mut stream = Stream::new(&[20]);
        let mut covered = 0;
        for _ in 0..trials {
            let mut pairs = Pairs::default();
            for _ in 0..n {
                // Done in the reference with 0.8; the run does the same in nine of ten cases, else fails.
                let reference = stream.uniform(0.0, 1.0) < 0.8;
                let run = reference && stream.uniform(0.0, 1.0) < 0.9;
                pairs.add(run, reference);
            }
            let Interval(low, high) = pairs.paired(0.1).interval;
            covered += usize::from(low <= -0.08 && -0.08 <= high);
        }
        let rate = covered as f64 / f64::from(trials);
        assert!((0.92..=0.99).contains(&rate), "{rate}");
    }

    #[test]
    fn pairing_narrows_and_equivalence_needs_room() {
        let same = Pairs {
            both: 144,
            run_only: 0,
            reference_only: 0,
            neither: 36,
        };
        assert!(same.paired(0.05).equivalent && !same.unpaired(0.05).equivalent);
        let growth = same.unpaired(0.05).growth_needed().unwrap();
        assert!((1.0..4.0).contains(&growth), "{growth}");
        let worse = Pairs {
            both: 100,
            run_only: 0,
            reference_only: 44,
            neither: 36,
        };
        let difference = worse.paired(0.05);
        assert!(difference.beyond_margin() && !difference.equivalent);
        assert_eq!(difference.growth_needed(), None);
    }

    #[test]
    fn counts_by_hand() {
        let mut counts = Counts::default();
        for (run, reference) in [(4, 4), (3, 4), (4, 4), (2, 2)] {
            counts.add(run, reference);
        }
        assert_eq!(counts.means(), [3.25, 3.5]);
        let paired = counts.paired(0.1);
        assert_eq!(paired.estimate, -0.25);
        // Variance 3/16, one quarter added, over four pairs: error 0.33072.
        assert!((paired.interval.1 - (-0.25 + 1.959964 * 0.330719)).abs() < 1e-5);
        assert!(!paired.equivalent);
    }

    #[test]
    fn nothing_seen_is_no_evidence() {
        let none = Pairs::default();
        assert!(
            none.is_empty() && !none.paired(0.05).equivalent && !none.paired(0.05).beyond_margin()
        );
        assert!(!Counts::default().paired(0.1).equivalent);
    }
}
