//! Success rates, their intervals, and latency percentiles.
//!
//! The measures of the LADS paper (section 5.1), over episodes whose instruction commands `C` sub-tasks (four in the kitchen):
//!
//! - **N-rate**: the mean number of commanded sub-tasks completed within the episode;
//! - **K-rate** `k`: the share of episodes in which at least `k` of them were completed, `k` = 1..4;
//! - **full success**: the share of episodes that carried out the instruction: all `C` were completed, in some environments at one time.
//!
//! Invariants: a rate is in `0..=1` and inside its own interval; K-rates never grow with `k`. Nothing here can fail: over no
//! episodes a rate is `None` and its interval is `[0, 1]`, which is what no evidence means.

use std::fmt::{self, Display, Formatter};

use serde::{Deserialize, Serialize};

/// The K-rates that are reported: at least 1, 2, 3 and 4 commanded sub-tasks completed.
pub const K_RATES: usize = 4;

/// The 0.975 quantile of the standard normal distribution, for two-sided 95 % intervals; exact to f64.
const Z_95: f64 = 1.959963984540054;

/// Difference of two rates that is rounding.
const ROUNDING: f64 = 1e-9;

/// A two-sided 95 % confidence interval of a proportion, written to JSON as `[low, high]`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval(pub f64, pub f64);

impl Display for Interval {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "[{:.2}, {:.2}]", self.0, self.1)
    }
}

/// Computes the Wilson score interval at 95 % of `successes` out of `trials` (Wilson 1927; method 3 of Newcombe 1998), no continuity
/// correction.
///
/// Over no trials it is `[0, 1]`.
pub fn wilson(successes: usize, trials: usize) -> Interval {
    wilson_at(successes, trials, Z_95)
}

/// Computes the Wilson score interval whose limits are `z` standard errors away.
pub fn wilson_at(successes: usize, trials: usize, z: f64) -> Interval {
    if trials == 0 {
        return Interval(0.0, 1.0);
    }
    let n = trials as f64;
    let p = successes as f64 / n;
    let z2 = z * z;
    let centre = p + z2 / (2.0 * n);
    let half = z * (p * (1.0 - p) / n + z2 / (4.0 * n * n)).sqrt();
    let scale = 1.0 + z2 / n;
    // At 0 and at n successes the limit is exactly 0 or 1; rounding must not move it past the rate.
    let low = if successes == 0 {
        0.0
    } else {
        (centre - half) / scale
    };
    let high = if successes == trials {
        1.0
    } else {
        (centre + half) / scale
    };
    Interval(low, high)
}

/// A share of episodes with its interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Rate {
    /// Number of episodes in which the event happened.
    pub count: usize,
    /// Number of episodes in which the event could happen.
    pub episodes: usize,
    /// `count` over `episodes`; `None` without episodes.
    pub rate: Option<f64>,
    /// Wilson 95 % interval of `rate`.
    pub interval: Interval,
}

impl Rate {
    /// Makes the rate `count` out of `episodes`.
    pub fn new(count: usize, episodes: usize) -> Self {
        Self {
            count,
            episodes,
            rate: share(count, episodes),
            interval: wilson(count, episodes),
        }
    }
}

/// Scores of a set of episodes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Number of episodes.
    pub episodes: usize,
    /// Mean number of commanded sub-tasks completed; `None` without episodes.
    pub n_rate: Option<f64>,
    /// Standard error of `n_rate` (sample deviation over the root of the number of episodes); `None` below two episodes.
    pub n_rate_standard_error: Option<f64>,
    /// Share of episodes with at least 1, 2, 3 and 4 commanded sub-tasks completed.
    pub k_rate: [Option<f64>; K_RATES],
    /// Wilson 95 % intervals of `k_rate`.
    pub k_rate_interval: [Interval; K_RATES],
    /// Share of episodes that carried out the instruction.
    pub full_success: Option<f64>,
    /// Wilson 95 % interval of `full_success`.
    pub full_success_interval: Interval,
    /// Number of episodes that carried out the instruction.
    pub full_success_count: usize,
    /// Sub-tasks completed though the instruction did not command them, summed over the episodes.
    pub un_instructed: usize,
}

/// Outcome of one episode, as the rates need it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outcome {
    /// Number of commanded sub-tasks completed within the episode.
    pub completed: usize,
    /// Number of other sub-tasks completed within the episode.
    pub un_instructed: usize,
    /// Whether the instruction was carried out: that all were completed, unless the environment asks for more.
    pub success: bool,
}

impl Score {
    /// Scores a set of episodes.
    pub fn of(outcomes: impl IntoIterator<Item = Outcome>) -> Self {
        let (mut episodes, mut full, mut un_instructed) = (0, 0, 0);
        let (mut sum, mut sum_of_squares) = (0_usize, 0_usize);
        let mut at_least = [0_usize; K_RATES];
        for outcome in outcomes {
            episodes += 1;
            sum += outcome.completed;
            sum_of_squares += outcome.completed * outcome.completed;
            un_instructed += outcome.un_instructed;
            full += usize::from(outcome.success);
            for (k, count) in at_least.iter_mut().enumerate() {
                *count += usize::from(outcome.completed > k);
            }
        }
        Self {
            episodes,
            n_rate: share(sum, episodes),
            n_rate_standard_error: standard_error(sum, sum_of_squares, episodes),
            k_rate: at_least.map(|count| share(count, episodes)),
            k_rate_interval: at_least.map(|count| wilson(count, episodes)),
            full_success: share(full, episodes),
            full_success_interval: wilson(full, episodes),
            full_success_count: full,
            un_instructed,
        }
    }
}

impl Score {
    /// Scores episodes without commanded sub-tasks: counts, but no rates.
    pub fn unasked(episodes: usize, completions: usize) -> Self {
        Self {
            episodes,
            un_instructed: completions,
            ..Self::of([])
        }
    }

    /// Checks that episodes can have these scores, which those of a file may not; the error names the first field that is wrong.
    pub fn check(&self) -> Result<(), String> {
        let Self {
            episodes,
            full_success_count: count,
            ..
        } = *self;
        if count > episodes {
            return Err(format!("{count} successes in {episodes} episodes"));
        }
        let rates = [self.n_rate, self.full_success]
            .into_iter()
            .chain(self.k_rate);
        let (known, all) = (rates.flatten().count(), 2 + K_RATES);
        // Without commanded sub-tasks there are episodes and no rates.
        if known > 0 && (known < all || episodes == 0) {
            return Err(format!("{known} of {all} rates of {episodes} episodes"));
        }
        let amounts = [
            ("n_rate", self.n_rate),
            ("n_rate_standard_error", self.n_rate_standard_error),
        ];
        for (name, amount) in amounts {
            if let Some(amount) = amount.filter(|it| !(it.is_finite() && *it >= 0.0)) {
                return Err(format!("{name} is {amount}"));
            }
        }
        let success = (self.full_success, self.full_success_interval);
        let k_rates = self.k_rate.into_iter().zip(self.k_rate_interval);
        let rates = [("full_success", success)].into_iter();
        for (name, (rate, Interval(low, high))) in rates.chain(k_rates.map(|it| ("k_rate", it))) {
            if !(0.0 <= low && low <= high && high <= 1.0) {
                return Err(format!("the interval of {name} is {low} to {high}"));
            }
            let inside = |rate: &f64| (low - ROUNDING..=high + ROUNDING).contains(rate);
            if let Some(rate) = rate.filter(|rate| !inside(rate)) {
                return Err(format!(
                    "{name} is {rate}, outside its interval of {low} to {high}"
                ));
            }
        }
        let (n_rate, success) = (self.n_rate.unwrap_or(0.0), self.full_success.unwrap_or(0.0));
        let of_count = share(count, episodes).unwrap_or(0.0);
        let at_least: f64 = self.k_rate.iter().flatten().sum();
        if known > 0 && (success - of_count).abs() > ROUNDING {
            return Err(format!(
                "full_success is {success} and {count} of {episodes} are {of_count}"
            ));
        }
        if !self.k_rate.is_sorted_by(|a, b| a >= b) {
            let rates = self.k_rate.map(Option::unwrap_or_default);
            return Err(format!("k_rate grows with K: {rates:?}"));
        }
        if n_rate < at_least - ROUNDING {
            return Err(format!(
                "n_rate is {n_rate}, below the sum of k_rate, {at_least}"
            ));
        }
        Ok(())
    }
}

fn share(count: usize, episodes: usize) -> Option<f64> {
    (episodes > 0).then(|| count as f64 / episodes as f64)
}

/// Computes the standard error of a mean of whole numbers: `sqrt(Σ(x - mean)² / (n - 1) / n)`.
fn standard_error(sum: usize, sum_of_squares: usize, episodes: usize) -> Option<f64> {
    if episodes < 2 {
        return None;
    }
    let n = episodes as f64;
    // Exact: n·Σx² - (Σx)² of whole numbers, so no cancellation.
    let n_times_deviations = (episodes * sum_of_squares - sum * sum) as f64;
    Some((n_times_deviations / n / (n - 1.0) / n).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(interval: Interval, low: f64, high: f64) {
        assert!(
            (interval.0 - low).abs() < 5e-5,
            "{interval:?} against low {low}"
        );
        assert!(
            (interval.1 - high).abs() < 5e-5,
            "{interval:?} against high {high}"
        );
    }

    #[test]
    fn wilson_agrees_with_newcombe_1998_table_i() {
        close(wilson(81, 263), 0.2553, 0.3662);
        close(wilson(15, 148), 0.0624, 0.1605);
        close(wilson(0, 20), 0.0, 0.1611);
        close(wilson(1, 29), 0.0061, 0.1718);
    }

    #[test]
    fn wilson_is_symmetric_and_holds_its_rate() {
        for trials in 1..60_usize {
            for successes in 0..=trials {
                let rate = successes as f64 / trials as f64;
                let Interval(low, high) = wilson(successes, trials);
                let mirrored = wilson(trials - successes, trials);
                assert!(
                    0.0 <= low && low <= rate && rate <= high && high <= 1.0,
                    "{successes}/{trials}"
                );
                assert!(
                    (low - (1.0 - mirrored.1)).abs() < 1e-12
                        && (high - (1.0 - mirrored.0)).abs() < 1e-12
                );
            }
        }
        assert_eq!(wilson(0, 0), Interval(0.0, 1.0));
    }

    #[test]
    fn scores_that_no_episodes_have_are_named() {
        type Change = fn(&mut Score);
        let score = Score::of([episode(4, 0), episode(2, 1), episode(0, 0)]);
        let unasked = Score::unasked(3, 7);
        for possible in [&score, &unasked, &Score::of([])] {
            assert_eq!(possible.check(), Ok(()));
        }
        let changes: [(&str, Change); 12] = [
            ("5 of 6 rates of 3 episodes", |it| it.full_success = None),
            ("6 of 6 rates of 0 episodes", |it| {
                (it.episodes, it.full_success_count) = (0, 0);
            }),
            ("n_rate is 0.5, below the sum", |it| it.n_rate = Some(0.5)),
            ("4 successes in 3", |it| it.full_success_count = 4),
            ("n_rate is -1", |it| it.n_rate = Some(-1.0)),
            ("n_rate_standard_error is NaN", |it| {
                it.n_rate_standard_error = Some(f64::NAN);
            }),
            ("full_success is 7", |it| it.full_success = Some(7.0)),
            ("full_success is 0.5 and 1 of 3", |it| {
                it.full_success = Some(0.5);
            }),
            ("interval of full_success is NaN", |it| {
                it.full_success_interval = Interval(f64::NAN, 1.0);
            }),
            ("interval of k_rate is 0.5 to 2", |it| {
                it.k_rate_interval[0] = Interval(0.5, 2.0);
            }),
            ("k_rate is 0, outside", |it| it.k_rate[0] = Some(0.0)),
            ("k_rate grows", |it| it.k_rate.swap(0, 3)),
        ];
        for (said, change) in changes {
            let mut changed = score.clone();
            change(&mut changed);
            let error = changed.check().unwrap_err();
            assert!(error.contains(said), "'{said}' is not in: {error}");
        }
    }

    fn episode(completed: usize, un_instructed: usize) -> Outcome {
        Outcome {
            completed,
            un_instructed,
            success: completed == 4,
        }
    }

    #[test]
    fn score_by_hand() {
        // Completed 4, 2, 3, 4, 0: sum 13, so N-rate 2.6; at least 1: 4/5, 2: 4/5, 3: 3/5, 4: 2/5.
        let score = Score::of([
            episode(4, 0),
            episode(2, 1),
            episode(3, 0),
            episode(4, 0),
            episode(0, 2),
        ]);
        assert_eq!(score.episodes, 5);
        assert_eq!(score.n_rate, Some(2.6));
        assert_eq!(score.k_rate, [Some(0.8), Some(0.8), Some(0.6), Some(0.4)]);
        assert_eq!(
            (score.full_success, score.full_success_count),
            (Some(0.4), 2)
        );
        assert_eq!(score.full_success_interval, wilson(2, 5));
        assert_eq!(score.un_instructed, 3);
        // Squares 16+4+9+16+0 = 45; sample variance (45 - 5·2.6²)/4 = 2.8; standard error sqrt(2.8/5).
        let error = score.n_rate_standard_error.unwrap();
        assert!((error - 0.56_f64.sqrt()).abs() < 1e-15, "{error}");
    }

    #[test]
    fn full_success_is_the_environments_verdict() {
        let of_two = |completed, success| Outcome {
            completed,
            un_instructed: 0,
            success,
        };
        let score = Score::of([of_two(2, true), of_two(1, false)]);
        assert_eq!(score.full_success, Some(0.5));
        assert_eq!(score.k_rate, [Some(1.0), Some(0.5), Some(0.0), Some(0.0)]);
    }

    #[test]
    fn no_episodes_no_rates() {
        let score = Score::of([]);
        assert_eq!(
            (
                score.episodes,
                score.n_rate,
                score.full_success,
                score.n_rate_standard_error
            ),
            (0, None, None, None)
        );
        assert_eq!(score.k_rate, [None; K_RATES]);
        assert_eq!(score.full_success_interval, Interval(0.0, 1.0));
    }
}
