//! Random streams that numpy reproduces bit for bit: `numpy.random.default_rng(entropy)`.
//!
//! Two published algorithms make such a stream: numpy's `SeedSequence` (M. E. O'Neill's `seed_seq_fe` with a pool of four words) turns the
//! entropy into 256 bits, and PCG64 (XSL-RR 128/64) draws from them. Nothing here can fail.

use rand_pcg::Pcg64;
use rand_pcg::rand_core::Rng;

const POOL_LEN: usize = 4;
// Constants of numpy's bit_generator.pyx.
const INIT_A: u32 = 0x43b0_d7e5;
const MULT_A: u32 = 0x931e_8875;
const INIT_B: u32 = 0x8b51_f9dd;
const MULT_B: u32 = 0x58f3_8ded;
const MIX_MULT_L: u32 = 0xca01_f9dd;
const MIX_MULT_R: u32 = 0x4973_f715;
const XSHIFT: u32 = 16;

/// numpy's `SeedSequence(entropy)` with an empty spawn key.
struct SeedSequence {
    pool: [u32; POOL_LEN],
}

impl SeedSequence {
    fn new(entropy: &[u64]) -> Self {
        let words: Vec<u32> = entropy
            .iter()
            .flat_map(|&number| words_of(number))
            .collect();
        let mut constant = INIT_A;
        let mut hash = |value: u32| {
            let value = value ^ constant;
            constant = constant.wrapping_mul(MULT_A);
            let value = value.wrapping_mul(constant);
            value ^ (value >> XSHIFT)
        };
        let mut pool = [0; POOL_LEN];
        for (index, slot) in pool.iter_mut().enumerate() {
            *slot = hash(words.get(index).copied().unwrap_or(0));
        }
        for source in 0..POOL_LEN {
            for target in 0..POOL_LEN {
                if source != target {
                    pool[target] = mix(pool[target], hash(pool[source]));
                }
            }
        }
        for &word in words.iter().skip(POOL_LEN) {
            for slot in &mut pool {
                *slot = mix(*slot, hash(word));
            }
        }
        Self { pool }
    }

    /// Generates four words like numpy's `generate_state(4, uint64)`.
    fn state(&self) -> [u64; 4] {
        let mut constant = INIT_B;
        let mut words = self.pool.iter().cycle().map(|&word| {
            let value = word ^ constant;
            constant = constant.wrapping_mul(MULT_B);
            let value = value.wrapping_mul(constant);
            u64::from(value ^ (value >> XSHIFT))
        });
        std::array::from_fn(|_| {
            let low = words.next().unwrap_or(0);
            let high = words.next().unwrap_or(0);
            low | (high << 32)
        })
    }
}

/// Splits a number into numpy's entropy words: the low half, and the high half unless it is zero.
fn words_of(number: u64) -> impl Iterator<Item = u32> {
    let high = (number >> 32) as u32;
    std::iter::once(number as u32).chain((high != 0).then_some(high))
}

fn mix(x: u32, y: u32) -> u32 {
    let value = x
        .wrapping_mul(MIX_MULT_L)
        .wrapping_sub(y.wrapping_mul(MIX_MULT_R));
    value ^ (value >> XSHIFT)
}

/// numpy's `Generator` with its default bit generator.
#[derive(Clone, Debug)]
pub struct Stream {
    bits: Pcg64,
}

impl Stream {
    /// Makes the stream of `numpy.random.default_rng(entropy)`.
    pub fn new(entropy: &[u64]) -> Self {
        let [state_high, state_low, stream_high, stream_low] =
            SeedSequence::new(entropy).state().map(u128::from);
        Self {
            bits: Pcg64::new(
                (state_high << 64) | state_low,
                (stream_high << 64) | stream_low,
            ),
        }
    }

    /// Draws uniformly from `[0, 1)` with 53 random bits, like numpy's `random()`.
    pub fn unit(&mut self) -> f64 {
        (self.bits.next_u64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Draws uniformly from `[low, high)`, like numpy's `uniform(low, high)`.
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Draws a standard normal number by Box and Muller's transform. Not numpy's `normal`, which uses a ziggurat.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seed_sequence_matches_numpy() {
        // numpy 2.4: np.random.SeedSequence(entropy).generate_state(4, np.uint64)
        assert_eq!(
            SeedSequence::new(&[0, 0, 0]).state(),
            [
                0xdb2cd7e7b0f478be,
                0xabf4641a2c71ba49,
                0x20c6ed6d9d7b8d41,
                0x2c4099de223c39d4
            ]
        );
        assert_eq!(
            SeedSequence::new(&[7, 3, 12]).state(),
            [
                0x601210cb6a16bbef,
                0xa33a0a9d12cfa6cc,
                0x30dc93458baf6116,
                0x915a20bd6edca5df
            ]
        );
        let five_words = SeedSequence::new(&[(1 << 40) + 5, 1, 0, 9, 4]).state();
        assert_eq!(
            five_words,
            [
                0x2af45e85c0b54156,
                0xf5bf225c1de29a1e,
                0xc72a6f7b5e0d406e,
                0x4bce682d8220d34c
            ]
        );
    }

    #[test]
    fn uniform_matches_numpy_bit_for_bit() {
        // numpy 2.4: np.random.default_rng(entropy).uniform(-1, 1, 30)[[0, 1, 2, 29]]
        for (entropy, expected) in [
            (
                [0, 0, 0],
                [
                    0.2739233746429086,
                    -0.4604265724722594,
                    -0.9180529521276106,
                    0.3009185525356326,
                ],
            ),
            (
                [7, 3, 12],
                [
                    0.5221160795644448,
                    -0.9178741835687165,
                    0.7577625468132307,
                    0.3003482417218437,
                ],
            ),
            (
                [(1 << 40) + 5, 1, 0],
                [
                    -0.18113414692560714,
                    0.17089816289322157,
                    -0.73798347744804,
                    0.43624502295431844,
                ],
            ),
        ] {
            let mut stream = Stream::new(&entropy);
            let draws: Vec<f64> = (0..30).map(|_| stream.uniform(-1.0, 1.0)).collect();
            assert_eq!([draws[0], draws[1], draws[2], draws[29]], expected);
        }
    }

    #[test]
    fn normal_has_zero_mean_and_unit_variance() {
        let mut stream = Stream::new(&[1]);
        let draws: Vec<f64> = (0..20_000).map(|_| stream.normal()).collect();
        let mean = draws.iter().sum::<f64>() / draws.len() as f64;
        let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / draws.len() as f64;
        // Four standard errors of each estimate.
        assert!(mean.abs() < 0.029, "{mean}");
        assert!((variance - 1.0).abs() < 0.04, "{variance}");
    }
}
