//! Tests and intervals for pairs of counts: numbers of completed sub-tasks, in run and reference.
//!
//! A difference of means is tested by betting (Waudby-Smith and Ramdas 2024, *JRSS B* 86:1): whoever bets a share of the capital on each pair, at
//! odds that are fair where the difference is as large as the hypothesis says, multiplies it by 20 with a chance of at most 5 %. That holds for
//! any distribution of bounded numbers at any number of pairs, also where all loss lies in a few episodes. The capital is split over four
//! bets. Nothing here can fail.

use std::collections::BTreeMap;

use super::{Difference, EQUIVALENCE, EQUIVALENCE_LEVEL, REPORTED, crossing, smallest_growth};
use crate::metrics::Interval;

/// Bets as shares of the largest bet that cannot lose everything twice, each with its share of the capital. The largest is the best where
/// few pairs differ, the smaller ones where many do.
const BETS: [(f64, f64); 4] = [(1.0, 0.5), (0.5, 0.25), (0.25, 0.125), (0.125, 0.125)];

/// Pairs of counts: completed sub-tasks in run and reference, episode by episode.
#[derive(Debug, Clone, Default)]
pub struct Counts {
    pairs: Vec<[f64; 2]>,
    /// Largest number of sub-tasks that any of the episodes commanded.
    most: usize,
}

impl Counts {
    /// Adds a pair of episodes, in which `commanded` sub-tasks could be completed.
    pub fn add(&mut self, run: usize, reference: usize, commanded: usize) {
        self.pairs.push([run as f64, reference as f64]);
        self.most = self.most.max(commanded).max(run).max(reference);
    }

    fn mean(&self, of: impl Fn(&[f64; 2]) -> f64) -> f64 {
        self.pairs.iter().map(of).sum::<f64>() / self.pairs.len().max(1) as f64
    }

    /// Mean counts of run and reference.
    pub fn means(&self) -> [f64; 2] {
        [self.mean(|x| x[0]), self.mean(|x| x[1])]
    }

    /// Compares the means as pairs.
    pub fn paired(&self, margin: f64) -> Difference {
        let bets = self.bets();
        let [run, reference] = self.means();
        let estimate = run - reference;
        let interval = |confidence: f64| {
            let level = (1.0 - confidence) / 2.0;
            // The p-value falls as the bound goes down from the estimate.
            let low = |of: &Bets, estimate: f64| {
                -crossing(|bound| of.p_greater(-bound, 1.0), level, -estimate, of.most)
            };
            Interval(low(&bets, estimate), -low(&bets.mirrored(), -estimate))
        };
        let p_equivalence = bets.p_equivalence(margin, 1.0);
        let equivalent = p_equivalence <= EQUIVALENCE_LEVEL;
        let searched = !equivalent && !self.pairs.is_empty() && estimate.abs() < margin;
        let enough = |growth: f64| bets.p_equivalence(margin, growth) <= EQUIVALENCE_LEVEL;
        Difference {
            estimate,
            interval: interval(REPORTED),
            interval_90: interval(EQUIVALENCE),
            margin,
            p_equivalence: Some(p_equivalence),
            p_beyond: Some(bets.p_beyond(margin)),
            equivalent,
            growth_needed: searched.then(|| smallest_growth(enough)).flatten(),
        }
    }

    /// Computes the p-values that judge, without the intervals: of equivalence, and of a difference beyond the margin.
    #[cfg(test)]
    pub(super) fn judged(&self, margin: f64) -> (f64, f64) {
        let bets = self.bets();
        (bets.p_equivalence(margin, 1.0), bets.p_beyond(margin))
    }

    /// Compares the means as if run and reference were two independent samples, by a normal approximation.
    pub fn unpaired(&self, margin: f64) -> Difference {
        let n = self.pairs.len() as f64;
        let [run, reference] = self.means();
        let squares = self.mean(|x| (x[0] - run).powi(2) + (x[1] - reference).powi(2));
        // One sample of one episode says nothing about its spread.
        let error = if n < 2.0 {
            f64::INFINITY
        } else {
            (squares / (n - 1.0)).sqrt()
        };
        let estimate = run - reference;
        let most = self.most.max(1) as f64;
        Difference::apart(estimate, margin, |z| {
            Interval(
                (estimate - z * error).max(-most),
                (estimate + z * error).min(most),
            )
        })
    }

    fn bets(&self) -> Bets {
        let mut seen = BTreeMap::<i64, f64>::new();
        for [run, reference] in &self.pairs {
            *seen.entry((run - reference) as i64).or_default() += 1.0;
        }
        Bets {
            seen: seen
                .into_iter()
                .map(|(difference, count)| (difference as f64, count))
                .collect(),
            most: self.most.max(1) as f64,
        }
    }
}

/// Counts of each paired difference, with the largest difference that is possible.
struct Bets {
    seen: Vec<(f64, f64)>,
    most: f64,
}

impl Bets {
    /// Exchanges run and reference.
    fn mirrored(&self) -> Self {
        Self {
            seen: self
                .seen
                .iter()
                .map(|&(difference, count)| (-difference, count))
                .collect(),
            most: self.most,
        }
    }

    /// Computes the larger p-value of the two one-sided tests of a difference as large as the margin.
    fn p_equivalence(&self, margin: f64, growth: f64) -> f64 {
        let lost = self.p_greater(-margin, growth);
        lost.max(self.mirrored().p_greater(-margin, growth))
    }

    /// Computes the smaller p-value of the two one-sided tests of a difference within the margin.
    fn p_beyond(&self, margin: f64) -> f64 {
        self.p_greater(margin, 1.0)
            .min(self.mirrored().p_greater(margin, 1.0))
    }

    /// Computes the p-value of the observed counts, multiplied by `growth`, under a mean of at most `bound`.
    fn p_greater(&self, bound: f64, growth: f64) -> f64 {
        // The worst pair then leaves nothing of the capital.
        let largest = 1.0 / (self.most + bound).max(f64::MIN_POSITIVE);
        let logarithm = |share: f64| {
            let factor = |x: f64| (share * largest * (x - bound)).max(-1.0).ln_1p();
            self.seen
                .iter()
                .map(|&(x, count)| count * growth * factor(x))
                .sum::<f64>()
        };
        let capitals = BETS.map(|(share, weight)| logarithm(share) + f64::ln(weight));
        let best = capitals.into_iter().fold(f64::NEG_INFINITY, f64::max);
        if best == f64::NEG_INFINITY {
            return 1.0;
        }
        let sum: f64 = capitals.iter().map(|capital| (capital - best).exp()).sum();
        (-(best + sum.ln())).exp().min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(pairs: &[(usize, usize, usize)]) -> Counts {
        let mut counts = Counts::default();
        for &(run, reference, times) in pairs {
            (0..times).for_each(|_| counts.add(run, reference, 4));
        }
        counts
    }

    #[test]
    fn counts_by_hand() {
        let few = counts(&[(4, 4, 2), (3, 4, 1), (2, 2, 1)]);
        assert_eq!(few.means(), [3.25, 3.5]);
        let (paired, unpaired) = (few.paired(0.1), few.unpaired(0.1));
        assert_eq!((paired.estimate, paired.equivalent), (-0.25, false));
        // Variances 0.6875 and 0.75, over three: error 0.692219.
        assert!((unpaired.interval.1 - (-0.25 + 1.959964 * 0.692219)).abs() < 1e-5);
        assert!(paired.interval.0 < -0.25 && -0.25 < paired.interval.1);
        assert!(
            paired.interval.0 <= paired.interval_90.0 && paired.interval_90.1 <= paired.interval.1
        );
    }

    /// Case: a loss of all four sub-tasks in 1 of 40 episodes is a loss of 0.1 and shows in none of 25 episodes with 53 %.
    #[test]
    fn a_few_identical_episodes_prove_nothing() {
        for n in [17, 25, 50, 100] {
            assert!(!counts(&[(4, 4, n)]).paired(0.1).equivalent, "{n}");
        }
        // Half the capital grows by 1 / 39 with each pair until there are 20: 145.7 pairs.
        let hundred = counts(&[(4, 4, 100)]).paired(0.1).growth_needed.unwrap();
        assert!((1.35..1.5).contains(&hundred), "{hundred}");
        assert!(counts(&[(4, 4, 146)]).paired(0.1).equivalent);
    }

    #[test]
    fn what_is_far_off_is_beyond() {
        let far = counts(&[(2, 4, 200), (4, 4, 100)]).paired(0.1);
        assert!(far.beyond_margin(1e-3) && !far.equivalent && far.growth_needed.is_none());
        let better = counts(&[(4, 2, 200), (4, 4, 100)]).paired(0.1);
        assert!(better.beyond_margin(1e-3));
    }

    #[test]
    fn nothing_seen_is_no_evidence() {
        let none = Counts::default().paired(0.1);
        assert!(!none.equivalent && !none.beyond_margin(0.5));
        assert_eq!(none.interval.1, 1.0);
    }
}
