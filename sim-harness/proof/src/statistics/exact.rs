//! Exact tests of a difference of paired proportions, and Tango's score statistic that they rest on.
//!
//! The pairs that differ are two cells of a multinomial distribution. Where the difference is known, one parameter stays unknown: how many
//! pairs differ in all. The p-value is the largest probability, over that parameter, of a statistic at least as large as the one seen; the
//! parameter is looked for inside a confidence set that misses it with `MISSED`, which is added (Berger and Boos 1994, *JASA* 89:1012). So the
//! test holds its level at any number of pairs. Nothing here can fail.

use statrs::distribution::{Beta, Binomial, ContinuousCDF as _, DiscreteCDF as _};
use statrs::function::factorial::ln_binomial;

use super::{crossing, quantile};
use crate::metrics::Interval;

/// Chance that the confidence set of the unknown parameter misses it.
const MISSED: f64 = 1e-5;
/// Number of places in the confidence set at which the p-value is computed.
const PLACES: usize = 48;
/// Probability below which a cell's count is left out of a p-value.
const NEVER: f64 = 1e-11;

/// Computes Tango's score statistic of `run_only` against `reference_only` among `n` pairs, under the difference `delta`: standard normal
/// for many pairs, the larger, the larger the observed difference.
pub fn score(run_only: usize, reference_only: usize, n: usize, delta: f64) -> f64 {
    let [b, c, n] = [run_only, reference_only, n].map(|count| count as f64);
    // The likeliest share of `reference_only` where the difference is `delta`: the larger root of a quadratic.
    let first = 2.0 * n;
    let second = -b - c + (2.0 * n - b + c) * delta;
    let third = -c * delta * (1.0 - delta);
    let root = (second * second - 4.0 * first * third).max(0.0).sqrt();
    let share = (root - second) / (2.0 * first);
    let variance = n * (2.0 * share + delta * (1.0 - delta));
    let excess = b - c - n * delta;
    if excess.abs() < 1e-12 {
        0.0
    } else if variance <= 0.0 {
        excess.signum() * f64::INFINITY
    } else {
        excess / variance.sqrt()
    }
}

/// Computes Tango's score interval of the difference: where the statistic is at most `z`.
pub fn interval(run_only: usize, reference_only: usize, n: usize, z: f64) -> Interval {
    if n == 0 {
        return Interval(-1.0, 1.0);
    }
    let estimate = (run_only as f64 - reference_only as f64) / n as f64;
    let at = |delta: f64| score(run_only, reference_only, n, delta);
    let low = if estimate <= -1.0 {
        -1.0
    } else {
        crossing(at, z, -1.0, estimate)
    };
    let high = if estimate >= 1.0 {
        1.0
    } else {
        crossing(at, -z, estimate, 1.0)
    };
    Interval(low, high)
}

/// Computes the p-value of the observed difference, or a larger one, under a difference run minus reference of at most `delta`.
pub fn p_greater(run_only: usize, reference_only: usize, n: usize, delta: f64) -> f64 {
    if n == 0 {
        return 1.0;
    }
    let seen = score(run_only, reference_only, n, delta) - 1e-9;
    let Interval(few, many) = clopper_pearson(run_only + reference_only, n);
    // Both cells are shares, and their difference is `delta`.
    let (few, many) = (few.max(delta.abs()), many.max(delta.abs()).min(1.0));
    let share = |at: usize| {
        let differing = few + (many - few) * at as f64 / (PLACES - 1) as f64;
        f64::midpoint(differing, -delta).max(0.0)
    };
    let (from, to) = (counts(share(0), n).0, counts(share(PLACES - 1), n).1);
    // The least `run_only` for each `reference_only` whose statistic is as large; beyond all counts where there is none.
    let least: Vec<usize> = (from..=to)
        .map(|reference_only| {
            let (mut low, mut high) = (0, n - reference_only + 1);
            while low < high {
                let middle = usize::midpoint(low, high);
                if score(middle, reference_only, n, delta) >= seen {
                    high = middle;
                } else {
                    low = middle + 1;
                }
            }
            low
        })
        .collect();
    let least = |count: usize| {
        count
            .checked_sub(from)
            .and_then(|at| least.get(at))
            .copied()
    };
    let chances = (0..PLACES).map(|at| tail(least, n, share(at), delta));
    (chances.fold(0.0, f64::max) + MISSED).min(1.0)
}

/// Range of counts that a share of `n` can plausibly give; others are too unlikely to matter.
fn counts(share: f64, n: usize) -> (usize, usize) {
    let (mean, deviation) = (
        n as f64 * share,
        (n as f64 * share * (1.0 - share)).max(0.0).sqrt(),
    );
    let from = (mean - 7.5 * deviation - 2.0).max(0.0) as usize;
    (from, ((mean + 7.5 * deviation + 12.0) as usize).min(n))
}

/// Computes the probability that `run_only` is at least `least`, where its share is `delta` more than that of `reference_only`.
fn tail(least: impl Fn(usize) -> Option<usize>, n: usize, share: f64, delta: f64) -> f64 {
    let other = ((share + delta) / (1.0 - share).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    let (from, to) = counts(share, n);
    (from..=to)
        .map(|count| {
            let chance = likelihood(count, n, share);
            let Some(needed) = least(count) else {
                return 0.0;
            };
            if chance < NEVER || needed > n - count {
                0.0
            } else if needed == 0 {
                chance
            } else {
                let more = Binomial::new(other, (n - count) as u64);
                chance * more.map_or(1.0, |more| more.sf(needed as u64 - 1))
            }
        })
        .sum()
}

/// Computes the binomial probability of a count.
pub(super) fn likelihood(count: usize, n: usize, share: f64) -> f64 {
    if share <= 0.0 {
        return f64::from(u8::from(count == 0));
    }
    if share >= 1.0 {
        return f64::from(u8::from(count == n));
    }
    let (done, left) = (count as f64, (n - count) as f64);
    (ln_binomial(n as u64, count as u64) + done * share.ln() + left * (-share).ln_1p()).exp()
}

/// Computes the exact interval of a proportion, which misses it with probability `MISSED` (Clopper and Pearson 1934).
fn clopper_pearson(count: usize, n: usize) -> Interval {
    let at = |first: usize, second: usize, chance: f64| {
        Beta::new(first as f64, second as f64).map_or(chance, |beta| beta.inverse_cdf(chance))
    };
    let low = if count == 0 {
        0.0
    } else {
        at(count, n - count + 1, MISSED / 2.0)
    };
    let high = if count == n {
        1.0
    } else {
        at(count + 1, n - count, 1.0 - MISSED / 2.0)
    };
    Interval(low, high)
}

/// Computes Tango's interval at a confidence.
pub fn interval_at(run_only: usize, reference_only: usize, n: usize, confidence: f64) -> Interval {
    interval(run_only, reference_only, n, quantile(confidence))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Published value, by Fagerland, Lydersen and Laake 2014 (*Statistics in Medicine* 33:2850): Tango's interval of Bentur's airway data.
    #[test]
    fn the_interval_is_the_published_one() {
        let Interval(low, high) = interval_at(1, 7, 21, 0.95);
        assert!(
            (low + 0.517).abs() < 5e-4 && (high + 0.026).abs() < 5e-4,
            "{low} {high}"
        );
    }

    #[test]
    fn the_interval_has_a_width_where_no_pair_differs() {
        // Without differing pairs the limit is where n·d = z²·(1 - d) holds: z² / (n + z²).
        let z2 = quantile(0.95).powi(2);
        let Interval(low, high) = interval_at(0, 0, 44, 0.95);
        assert!((high - z2 / (44.0 + z2)).abs() < 1e-9 && (low + high).abs() < 1e-9);
        assert_eq!(interval_at(0, 0, 0, 0.95), Interval(-1.0, 1.0));
        assert_eq!(interval_at(9, 0, 9, 0.95).1, 1.0);
    }

    #[test]
    fn the_statistic_grows_with_what_speaks_for_the_run() {
        for delta in [-0.05, 0.05, -0.2] {
            for n in [25, 60] {
                for c in 0..=n {
                    let row: Vec<f64> = (0..=n - c).map(|b| score(b, c, n, delta)).collect();
                    assert!(row.is_sorted(), "{delta} {n} {c}");
                }
            }
        }
    }

    /// Case of no differing pair: only a share of `margin` lost in none of n pairs could hide, and its chance is the p-value.
    #[test]
    fn no_differing_pair_proves_what_it_can() {
        for n in [32, 45, 58, 59] {
            let p = p_greater(0, 0, n, -0.05);
            assert!(
                (p - 0.95_f64.powi(n as i32) - MISSED).abs() < 1e-9,
                "{n}: {p}"
            );
        }
        // With more, tables with differing pairs count as much and add to it.
        let p = p_greater(0, 0, 120, -0.05);
        assert!((0.95_f64.powi(120)..0.01).contains(&p), "{p}");
        assert_eq!(p_greater(0, 0, 0, -0.05), 1.0);
    }

    /// Sums over all tables of 12 pairs: whatever the parameter, the test at 5 % rejects in at most 5 % of them, at differences at and
    /// below the bound.
    #[test]
    fn it_holds_its_level_exactly() {
        let n = 12;
        let rejects: Vec<Vec<bool>> = (0..=n)
            .map(|b| {
                (0..=n - b)
                    .map(|c| p_greater(b, c, n, -0.2) <= 0.05)
                    .collect()
            })
            .collect();
        for delta in [-0.2, -0.3] {
            for at in 0..=100 {
                let run = f64::from(at) / 100.0 * (1.0 + delta) / 2.0;
                let reference = run - delta;
                let same = (1.0 - run - reference).max(0.0);
                let mut chance = 0.0;
                for (b, row) in rejects.iter().enumerate() {
                    for (c, _) in row.iter().enumerate().filter(|(_, rejected)| **rejected) {
                        let ways =
                            ln_binomial(n as u64, b as u64) + ln_binomial((n - b) as u64, c as u64);
                        let powers = run.powi(b as i32)
                            * reference.powi(c as i32)
                            * same.powi((n - b - c) as i32);
                        chance += ways.exp() * powers;
                    }
                }
                assert!(chance <= 0.05, "{delta} {run}: {chance}");
            }
        }
    }
}
