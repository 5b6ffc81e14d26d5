//! Picking an index from scores.

use lads_kernels::{arg_max, math};
use rand_pcg::Pcg64;
use rand_pcg::rand_core::Rng;

use crate::contract::Decision;

/// A decision rule with the state of its random generator.
#[derive(Debug, Clone)]
pub(crate) struct Decider {
    rule: Decision,
    random: Pcg64,
}

/// Stream of the generator: the default of PCG's reference implementation.
pub(crate) const STREAM: u128 = 0x0a02_bdbf_7bb3_c0a7_ac28_fa16_a64a_bf96;

impl Decider {
    pub fn new(rule: Decision) -> Self {
        let seed = match rule {
            Decision::Sample { seed, .. } => seed,
            Decision::Argmax => 0,
        };
        Self {
            rule,
            random: Pcg64::new(u128::from(seed), STREAM),
        }
    }

    pub fn rule(&self) -> Decision {
        self.rule
    }

    /// Picks an index; the scores are finite and there is at least one.
    pub fn pick(&mut self, scores: &[f32]) -> u32 {
        match self.rule {
            Decision::Sample { temperature, .. } if temperature > 0.0 => {
                self.sample(scores, temperature)
            }
            _ => arg_max(scores) as u32,
        }
    }

    /// Samples index `i` with probability `exp(l_i / T) / sum over j of exp(l_j / T)`: the first
    /// index at which the running sum of the weights passes a uniform share of the whole.
    fn sample(&mut self, scores: &[f32], temperature: f32) -> u32 {
        let best = arg_max(scores);
        let max = scores.get(best).copied().unwrap_or(0.0);
        let weight = |score: f32| f64::from(math::exp((score - max) / temperature));
        let total: f64 = scores.iter().map(|&score| weight(score)).sum();
        // 53 random bits: every double in [0, 1) of that spacing is equally likely.
        let uniform = (self.random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
        let mut left = uniform * total;
        let mut passed = 0;
        for &score in scores {
            // To the end, so that the time does not depend on the index: once passed, always passed.
            left -= weight(score);
            passed = usize::from(left < 0.0).saturating_add(passed);
        }
        let index = scores.len().saturating_sub(passed);
        (if passed == 0 { best } else { index }) as u32
    }
}

/// Returns the largest score minus the second largest; infinite for a single one.
pub(crate) fn margin(scores: &[f32]) -> f32 {
    let (mut first, mut second) = (f32::NEG_INFINITY, f32::NEG_INFINITY);
    for &score in scores {
        // No branch that depends on the scores.
        second = second.max(first.min(score));
        first = first.max(score);
    }
    first - second
}

#[cfg(test)]
mod tests {
    use super::*;

    const SAMPLE: Decision = Decision::Sample {
        temperature: 1.0,
        seed: 7,
    };

    #[test]
    fn argmax_takes_the_first_of_equal_logits() {
        let mut decider = Decider::new(Decision::Argmax);
        assert_eq!(decider.pick(&[0.5, 2.0, -1.0, 2.0]), 1);
        assert_eq!(decider.pick(&[3.0]), 0);
    }

    #[test]
    fn the_margin_is_between_the_two_largest() {
        assert_eq!(margin(&[1.0, 4.0, 2.5]), 1.5);
        assert_eq!(margin(&[2.0, 2.0]), 0.0);
        assert_eq!(margin(&[2.0]), f32::INFINITY);
    }

    #[test]
    fn sampling_follows_the_softmax() {
        let logits = [0.0, 1.0, 2.0, -1.0];
        let draws = 20_000;
        for temperature in [0.5_f32, 1.0, 3.0] {
            let mut decider = Decider::new(Decision::Sample {
                temperature,
                seed: 1,
            });
            let mut counts = [0_u32; 4];
            for _ in 0..draws {
                counts[decider.pick(&logits) as usize] += 1;
            }
            let weights = logits.map(|l: f32| f64::from(l / temperature).exp());
            let total: f64 = weights.iter().sum();
            for (count, weight) in counts.iter().zip(weights) {
                let p = weight / total;
                let expected = p * f64::from(draws);
                // Five standard deviations of a binomial count.
                let spread = 5.0 * (expected * (1.0 - p)).sqrt();
                assert!(
                    (f64::from(*count) - expected).abs() < spread,
                    "{counts:?} at {temperature}"
                );
            }
        }
    }

    #[test]
    fn a_seed_fixes_the_draws() {
        let logits = [0.1, 0.2, 0.3, 0.2, 0.1];
        let draw = |rule| {
            let mut decider = Decider::new(rule);
            core::array::from_fn::<u32, 64, _>(|_| decider.pick(&logits))
        };
        assert_eq!(draw(SAMPLE), draw(SAMPLE));
        assert_ne!(
            draw(SAMPLE),
            draw(Decision::Sample {
                temperature: 1.0,
                seed: 8
            })
        );
    }

    #[test]
    fn a_temperature_that_means_nothing_is_argmax() {
        for temperature in [0.0, -1.0, f32::NAN] {
            let mut decider = Decider::new(Decision::Sample {
                temperature,
                seed: 3,
            });
            assert!((0..50).all(|_| decider.pick(&[1.0, 1.5, 1.2]) == 1));
        }
    }
}
