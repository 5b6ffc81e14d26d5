//! Tests and intervals for pairs of outcomes: done or not, in run and reference.

use serde::Serialize;
use statrs::distribution::{Binomial, DiscreteCDF as _};

use super::{Difference, EQUIVALENCE, EQUIVALENCE_LEVEL, REPORTED, exact, share, smallest_growth};
use crate::metrics::{Interval, wilson_at};

/// Pairs of episodes, counted by outcome.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Pairs {
    /// Number of pairs done in both.
    pub both: usize,
    /// Number of pairs done in the run only.
    pub run_only: usize,
    /// Number of pairs done in the reference only.
    pub reference_only: usize,
    /// Number of pairs done in neither.
    pub neither: usize,
}

impl Pairs {
    /// Adds a pair of outcomes.
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

    /// Whether there are no pairs.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Numbers of successes of run and reference.
    fn successes(&self) -> [usize; 2] {
        [self.both + self.run_only, self.both + self.reference_only]
    }

    /// Success rates of run and reference.
    pub fn shares(&self) -> [f64; 2] {
        self.successes().map(|count| share(count, self.len()))
    }

    /// Computes the two-sided p-value of McNemar's exact test; 1 where no pair differs.
    pub fn mcnemar(&self) -> f64 {
        let differing = (self.run_only + self.reference_only) as u64;
        let fewer = self.run_only.min(self.reference_only) as u64;
        let Ok(fair) = Binomial::new(0.5, differing) else {
            return 1.0;
        };
        (2.0 * fair.cdf(fewer)).min(1.0)
    }

    /// Compares the rates as pairs.
    pub fn paired(&self, margin: f64) -> Difference {
        let [run, reference] = self.shares();
        let (b, c, n) = (self.run_only, self.reference_only, self.len());
        let p_equivalence = self.p_equivalence(margin, 1.0);
        let equivalent = p_equivalence <= EQUIVALENCE_LEVEL;
        let estimate = run - reference;
        let searched = !equivalent && n > 0 && estimate.abs() < margin;
        let enough = |growth: f64| self.p_equivalence(margin, growth) <= EQUIVALENCE_LEVEL;
        Difference {
            estimate,
            interval: exact::interval_at(b, c, n, REPORTED),
            interval_90: exact::interval_at(b, c, n, EQUIVALENCE),
            margin,
            p_equivalence: Some(p_equivalence),
            p_beyond: Some(self.p_beyond(margin)),
            equivalent,
            growth_needed: searched.then(|| smallest_growth(enough)).flatten(),
        }
    }

    /// Computes the smaller p-value of the two one-sided tests of a difference within the margin.
    pub(super) fn p_beyond(&self, margin: f64) -> f64 {
        let (b, c, n) = (self.run_only, self.reference_only, self.len());
        exact::p_greater(b, c, n, margin).min(exact::p_greater(c, b, n, margin))
    }

    /// Computes the larger p-value of the two one-sided tests, with `growth` times as many pairs of each kind.
    pub(super) fn p_equivalence(&self, margin: f64, growth: f64) -> f64 {
        let grown = |count: usize| (count as f64 * growth).round() as usize;
        let (b, c, n) = (
            grown(self.run_only),
            grown(self.reference_only),
            grown(self.len()),
        );
        let lost = exact::p_greater(b, c, n, -margin);
        lost.max(exact::p_greater(c, b, n, -margin))
    }

    /// Compares the rates as if run and reference were two independent samples.
    pub fn unpaired(&self, margin: f64) -> Difference {
        let [run, reference] = self.successes();
        let n = self.len();
        let estimate = share(run, n) - share(reference, n);
        Difference::apart(estimate, margin, |z| {
            hybrid(estimate, (run, n), (reference, n), z)
        })
    }
}

/// Computes the interval of a difference of two proportions from their score intervals.
fn hybrid(estimate: f64, first: (usize, usize), second: (usize, usize), z: f64) -> Interval {
    let (below1, above1) = score_arms(first, z);
    let (below2, above2) = score_arms(second, z);
    Interval(
        (estimate - below1.hypot(above2)).max(-1.0),
        (estimate + above1.hypot(below2)).min(1.0),
    )
}

/// Computes how far a Wilson interval reaches below and above its proportion; without episodes, as far as there is room.
fn score_arms((successes, n): (usize, usize), z: f64) -> (f64, f64) {
    if n == 0 {
        return (1.0, 1.0);
    }
    let Interval(low, high) = wilson_at(successes, n, z);
    let p = share(successes, n);
    ((p - low).max(0.0), (high - p).max(0.0))
}

#[cfg(test)]
mod tests {
    use super::super::quantile;
    use super::*;

    #[test]
    fn two_samples_agree_with_newcombe_1998_table_ii() {
        let check = |x1, n1, x2, n2, low: f64, high: f64| {
            let estimate = share(x1, n1) - share(x2, n2);
            let found = hybrid(estimate, (x1, n1), (x2, n2), quantile(0.95));
            let near = |a: f64, b: f64| (a - b).abs() < 5e-5;
            assert!(near(found.0, low) && near(found.1, high), "{found:?}");
        };
        check(56, 70, 48, 80, 0.0524, 0.3339);
        check(9, 10, 3, 10, 0.1705, 0.8090);
        check(10, 10, 0, 20, 0.6791, 1.0);
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
    fn pairing_narrows_and_equivalence_needs_room() {
        let same = Pairs {
            both: 144,
            run_only: 0,
            reference_only: 0,
            neither: 36,
        };
        assert!(same.paired(0.05).equivalent && !same.unpaired(0.05).equivalent);
        let few = Pairs {
            both: 36,
            neither: 9,
            ..Pairs::default()
        };
        let paired = few.paired(0.05);
        assert!(
            !paired.equivalent,
            "a loss of 5 % shows in none of 45 pairs with 9.9 %"
        );
        let growth = paired.growth_needed.unwrap();
        assert!((1.28..1.4).contains(&growth), "59 pairs decide: {growth}");
        let worse = Pairs {
            both: 100,
            run_only: 0,
            reference_only: 44,
            neither: 36,
        };
        let difference = worse.paired(0.05);
        assert!(difference.beyond_margin(1e-3) && !difference.equivalent);
        assert_eq!(difference.growth_needed, None);
    }

    #[test]
    fn nothing_seen_is_no_evidence() {
        let none = Pairs::default();
        let paired = none.paired(0.05);
        assert!(none.is_empty() && !paired.equivalent && !paired.beyond_margin(0.5));
    }
}
