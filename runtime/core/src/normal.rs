//! Standard normal random numbers: the noise of diffusion policies and of plans that are drawn.
//!
//! ```text
//! PCG64 → 52 random bits k → u = (2k + 1) / 2^53, in (0, 1) → inverse of the normal distribution function → f32
//! ```
//!
//! The inverse is Wichura's algorithm AS 241, PPND16 (Applied Statistics 37, 1988, 477-484), good to about one part in 10^16.
//!
//! Invariants:
//! - The same bits on every target, and in `lads_exporter/normals.py`: additions, multiplications, divisions and square roots of f64,
//!   each correctly rounded and none fused, in one fixed order, and a logarithm made of these. `tests/normals.txt` is the table
//!   that both sides are tested against.
//! - One number takes one output of the generator and always the same operations: nothing is rejected and drawn again. AS 241
//!   is three quotients of polynomials for three ranges; all have the same degree, so the range selects arguments and
//!   coefficients, by masks, and one quotient is computed. Logarithm and root are computed also where they are not used. No
//!   number decides a branch, an address or how often a loop runs. (A processor may still take longer to divide some numbers,
//!   and one without f64 does all of this in software.)
//! - Every number is finite and at most 8.3 in magnitude, and none is zero or subnormal.
//!
//! Nothing here can fail.

use core::hint::black_box;

use rand_pcg::Pcg64;
use rand_pcg::rand_core::Rng;

/// Stream of the generator, the first 128 bits of pi after the point; it differs from the stream
/// that plans are sampled from, so that both may have the same seed.
const STREAM: u128 = 0x243f_6a88_85a3_08d3_1319_8a2e_0370_7344;

/// A stream of standard normal random numbers.
#[derive(Debug, Clone)]
pub(crate) struct Normals {
    random: Pcg64,
}

impl Normals {
    /// Makes the stream of a seed, from its beginning.
    pub fn new(seed: u64) -> Self {
        Self {
            random: Pcg64::new(u128::from(seed), STREAM),
        }
    }

    /// Fills `out` with the stream's next numbers.
    pub fn fill(&mut self, out: &mut [f32]) {
        for x in out {
            *x = quantile(self.uniform()) as f32;
        }
    }

    /// Returns an odd multiple of 2^-53 in (0, 1), all equally likely: never 0 or 1, and symmetric
    /// about one half.
    fn uniform(&mut self) -> f64 {
        // As digits of a number in [1, 2), because processors without f64 convert integers by branches; the difference is exact.
        let digits = self.random.next_u64() >> 12;
        f64::from_bits(1.0_f64.to_bits() | digits) - (1.0 - f64::EPSILON / 2.0)
    }
}

/// Coefficients of a polynomial, highest power first, for each of three ranges: |u - 1/2| up to
/// 0.425; root up to 5; beyond.
type Polynomial = [[f64; 3]; 8];

/// Numerator coefficients a, c, e of AS 241.
#[rustfmt::skip]
const ABOVE: Polynomial = [
    [2.5090809287301226727e+3, 7.74545014278341407640e-4, 2.01033439929228813265e-7],
    [3.3430575583588128105e+4, 2.27238449892691845833e-2, 2.71155556874348757815e-5],
    [6.7265770927008700853e+4, 2.41780725177450611770e-1, 1.24266094738807843860e-3],
    [4.5921953931549871457e+4, 1.27045825245236838258e+0, 2.65321895265761230930e-2],
    [1.3731693765509461125e+4, 3.64784832476320460504e+0, 2.96560571828504891230e-1],
    [1.9715909503065514427e+3, 5.76949722146069140550e+0, 1.78482653991729133580e+0],
    [1.3314166789178437745e+2, 4.63033784615654529590e+0, 5.46378491116411436990e+0],
    [3.3871328727963666080e+0, 1.42343711074968357734e+0, 6.65790464350110377720e+0],
];

/// Denominator coefficients b, d, f and 1 of AS 241.
#[rustfmt::skip]
const BELOW: Polynomial = [
    [5.2264952788528545610e+3, 1.05075007164441684324e-9, 2.04426310338993978564e-15],
    [2.8729085735721942674e+4, 5.47593808499534494600e-4, 1.42151175831644588870e-7],
    [3.9307895800092710610e+4, 1.51986665636164571966e-2, 1.84631831751005468180e-5],
    [2.1213794301586595867e+4, 1.48103976427480074590e-1, 7.86869131145613259100e-4],
    [5.3941960214247511077e+3, 6.89767334985100004550e-1, 1.48753612908506148525e-2],
    [6.8718700749205790830e+2, 1.67638483018380384940e+0, 1.36929880922735805310e-1],
    [4.2313330701600911252e+1, 2.05319162663775882187e+0, 5.99832206555887937690e-1],
    [1.0, 1.0, 1.0],
];

/// Returns all ones if `x > bound`, else zeros, as a mask.
///
/// The comparison is hidden from the compiler, which would otherwise turn the mask into a branch
/// around a polynomial.
fn all_above(x: f64, bound: f64) -> u64 {
    black_box(u64::from(x > bound).wrapping_neg())
}

/// Returns the number below which a standard normal one lies with probability `u`, a multiple of
/// 2^-53 between 0 and 1.
fn quantile(u: f64) -> f64 {
    let q = u - 0.5;
    // The smaller of `u` and `1 - u`, without a choice; both differences are exact.
    let root = libm::sqrt(-ln(0.5 - q.abs()));

    let far = all_above(root, 5.0);
    let central = !all_above(q.abs(), 0.425);
    let middle = !(central | far);
    let of_range = |[c, m, f]: [f64; 3]| {
        f64::from_bits(c.to_bits() & central | m.to_bits() & middle | f.to_bits() & far)
    };
    let x = of_range([0.180625 - q * q, root - 1.6, root - 5.0]);
    let sign = 1.0_f64.copysign(q);
    let factor = of_range([q, sign, sign]);
    let at = |polynomial: &Polynomial| {
        let coefficients = polynomial.iter().map(|&row| of_range(row));
        coefficients.fold(0.0, |sum, coefficient| sum * x + coefficient)
    };
    at(&ABOVE) * factor / at(&BELOW)
}

/// Returns the natural logarithm of a normal positive number, within one unit in the last place.
///
/// `ln(x) = k ln 2 + ln(1 + f)` with `1 + f` between the roots of 1/2 and 2, and with
/// `s = f / (2 + f)` an odd polynomial in `s`. Method and coefficients are those of FreeBSD's
/// `e_log.c` (Sun Microsystems), without its special cases; the results are the same bits.
fn ln(x: f64) -> f64 {
    const LN2_HIGH: f64 = 6.93147180369123816490e-01;
    const LN2_LOW: f64 = 1.90821492927058770002e-10;
    /// The root of 1/2, to the digits that the method uses.
    const ROOT_HALF: u64 = 0x3fe6_a09e << 32;
    const ONE: u64 = 1.0_f64.to_bits();
    const MANTISSA: u64 = (1 << 52) - 1;

    let shifted = x.to_bits().wrapping_add(ONE - ROOT_HALF);
    let k = f64::from(((shifted >> 52) as i32).wrapping_sub(1023));
    let f = f64::from_bits((shifted & MANTISSA).wrapping_add(ROOT_HALF)) - 1.0;

    let half_square = 0.5 * f * f;
    let s = f / (2.0 + f);
    let z = s * s;
    let w = z * z;
    let even = w
        * (3.999999999940941908e-01
            + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01));
    let odd = z
        * (6.666666666666735130e-01
            + w * (2.857142874366239149e-01
                + w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01)));
    s * (half_square + (odd + even)) + k * LN2_LOW - half_square + f + k * LN2_HIGH
}

#[cfg(test)]
mod tests {
    use std::vec;
    use std::vec::Vec;

    use super::*;
    use crate::decision;

    /// Table of expected values: rows `quantile N EXACT BITS` and `draws SEED BITS ..`, described
    /// at the head of the file.
    const TABLE: &str = include_str!("../tests/normals.txt");

    /// Returns the words of the table's rows of one kind.
    fn rows(kind: &'static str) -> impl Iterator<Item = Vec<&'static str>> {
        TABLE.lines().filter_map(move |line| {
            let mut words = line.split(' ');
            (words.next() == Some(kind)).then(|| words.collect())
        })
    }

    fn hex(word: &str) -> u64 {
        u64::from_str_radix(word, 16).unwrap()
    }

    fn sample(seed: u64, len: usize) -> Vec<f32> {
        let mut sample = vec![0.0; len];
        Normals::new(seed).fill(&mut sample);
        sample
    }

    /// Returns the quantile of the uniform number `n * 2^-53`.
    fn quantile_of(n: u64) -> f64 {
        quantile(n as f64 / (1_u64 << 53) as f64)
    }

    /// Evaluates the normal distribution function, by the `libm` crate.
    fn distribution(x: f64) -> f64 {
        0.5 * libm::erfc(-x / core::f64::consts::SQRT_2)
    }

    /// Returns the largest distance between a sample's distribution and the normal one (Kolmogorov
    /// and Smirnov).
    fn distance(mut sample: Vec<f32>) -> f64 {
        sample.sort_by(f32::total_cmp);
        let n = sample.len() as f64;
        let distances = sample.iter().enumerate().map(|(i, &x)| {
            let expected = distribution(f64::from(x));
            (expected - i as f64 / n).max((i + 1) as f64 / n - expected)
        });
        distances.fold(0.0, f64::max)
    }

    #[test]
    fn quantiles_have_the_bits_of_the_table_and_the_accuracy_of_the_paper() {
        let mut compared = 0;
        for row in rows("quantile") {
            let (n, exact, bits) = (
                row[0].parse().unwrap(),
                f64::from_bits(hex(row[1])),
                hex(row[2]),
            );
            let got = quantile_of(n);
            assert_eq!(got.to_bits(), bits, "{n}: {got}");
            // The paper's accuracy and the roundings of some thirty operations.
            assert!(
                ((got - exact) / exact).abs() < 1e-15,
                "{n}: {got}, exactly {exact}"
            );
            compared += 1;
        }
        assert!(compared > 200, "{compared}");
    }

    #[test]
    fn draws_have_the_bits_of_the_table() {
        let mut compared = 0;
        for row in rows("draws") {
            let seed = row[0].parse().unwrap();
            let expected: Vec<u32> = row[1..].iter().map(|word| hex(word) as u32).collect();
            let got: Vec<u32> = sample(seed, expected.len())
                .iter()
                .map(|x| x.to_bits())
                .collect();
            assert_eq!(got, expected, "seed {seed}");
            compared += got.len();
        }
        assert!(compared > 200, "{compared}");
    }

    #[test]
    fn quantiles_invert_the_distribution_and_are_symmetric() {
        let mut random = Pcg64::new(3, 5);
        for i in 0..50_000_u32 {
            // All magnitudes of tails, down to 2^-53.
            let n = (random.next_u64() >> (12 + i % 52)) << 1 | 1;
            let (x, u) = (quantile_of(n), n as f64 / (1_u64 << 53) as f64);
            // An error of x is multiplied by x there, relative to u; erfc has one of its own of that kind.
            let error = (distribution(x) - u).abs() / u;
            assert!(error < 1e-15 * (2.0 + x * x), "{n}: {x} {error}");
            assert_eq!(quantile_of((1 << 53) - n).to_bits(), (-x).to_bits(), "{n}");
        }
    }

    #[test]
    fn the_logarithm_has_the_bits_of_libm() {
        let mut random = Pcg64::new(1, 2);
        for i in 0..100_000_u64 {
            let exponent = 1023 - 1 - i % 53;
            let x = f64::from_bits(exponent << 52 | random.next_u64() >> 12);
            assert_eq!(ln(x).to_bits(), libm::log(x).to_bits(), "{x}");
        }
    }

    #[test]
    fn a_sample_is_standard_normal() {
        let n = 200_000;
        let sample = sample(11, n);
        let moment = |power: i32| {
            sample
                .iter()
                .map(|&x| f64::from(x).powi(power))
                .sum::<f64>()
                / n as f64
        };
        // Moments and five standard deviations of their estimates: variances 1, 2, 15, 96 over n.
        for (power, expected, variance) in
            [(1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)]
        {
            let bound = 5.0 * (variance / n as f64).sqrt();
            let got = moment(power);
            assert!((got - expected).abs() < bound, "moment {power}: {got}");
        }
        // Exceeded by one sample in a thousand that is normal.
        assert!(distance(sample) < 1.95 / (n as f64).sqrt());
    }

    #[test]
    fn neighbouring_seeds_are_unrelated() {
        let n = 20_000_u32;
        // One episode after another has the next seed.
        let first: Vec<[f32; 2]> = (0..n)
            .map(|seed| sample(u64::from(seed), 2).try_into().unwrap())
            .collect();
        for i in [0, 1] {
            let of_all_seeds = first.iter().map(|draws| draws[i]).collect();
            assert!(distance(of_all_seeds) < 1.95 / f64::from(n).sqrt());
        }
        let products = first.windows(2).map(|two| f64::from(two[0][0] * two[1][0]));
        let correlation = products.sum::<f64>() / f64::from(n);
        assert!(
            correlation.abs() < 5.0 / f64::from(n).sqrt(),
            "{correlation}"
        );
    }

    #[test]
    fn plans_of_the_same_seed_are_sampled_from_other_numbers() {
        let n = 20_000_u32;
        let (mut noise, mut plans) = (Normals::new(7), Pcg64::new(7, decision::STREAM));
        let products = (0..n).map(|_| {
            let digits = plans.next_u64() >> 12 << 1 | 1;
            quantile(noise.uniform()) * quantile_of(digits)
        });
        let correlation = products.sum::<f64>() / f64::from(n);
        assert!(
            correlation.abs() < 5.0 / f64::from(n).sqrt(),
            "{correlation}"
        );
    }

    #[test]
    fn one_number_takes_one_output_of_the_generator() {
        for seed in 0..200 {
            let mut normals = Normals::new(seed);
            let mut clone = normals.clone();
            let mut out = [0.0; 100];
            normals.fill(&mut out);
            clone.random.advance(100);
            assert_eq!(normals.random, clone.random);
            assert!(out.iter().all(|x| x.is_normal() && x.abs() < 8.3));
        }
        for n in [1, (1 << 52) - 1, (1 << 52) + 1, (1 << 53) - 1] {
            let x = quantile_of(n) as f32;
            assert!(x.is_normal() && x.abs() < 8.3, "{n}: {x}");
        }
    }

    /// Environment variable that names the case to the program under `callgrind`.
    #[cfg(target_os = "linux")]
    const CHILD: &str = "LADS_NORMALS_UNDER_CALLGRIND";

    /// Runs the code under count: a fill of the stream `seed`, and quantiles.
    #[cfg(target_os = "linux")]
    #[inline(never)]
    fn counted_normals(seed: u64, uniform: &[f64]) -> ([f32; 500], f64) {
        let mut out = [0.0; 500];
        Normals::new(seed).fill(&mut out);
        (out, uniform.iter().map(|&u| quantile(black_box(u))).sum())
    }

    /// Compares the instruction counts of all cases: numbers of the middle, of the tails, of the
    /// outermost tails, and of all of these, each beside a fill of another seed. Without `valgrind`
    /// there is nothing to compare.
    #[cfg(target_os = "linux")]
    #[test]
    fn every_number_takes_the_same_number_of_instructions() {
        let unit = 1.0 / (1_u64 << 53) as f64;
        let cases = [
            [0.3, 0.5 - unit, 0.5 + unit, 0.9],
            [0.074, 0.01, 0.95, 1e-9],
            [unit, 3.0 * unit, 1.0 - unit, 1e-12],
            [0.0749999, 0.0750001, unit, 0.5 + unit],
        ];
        if let Some(case) = std::env::var_os(CHILD) {
            let case: usize = case.to_str().unwrap().parse().unwrap();
            black_box(counted_normals(case as u64, black_box(&cases[case])));
            return;
        }
        let mut counts = Vec::new();
        for case in 0..cases.len() {
            let output = std::process::Command::new("valgrind")
                .args([
                    "--tool=callgrind",
                    "--callgrind-out-file=/dev/null",
                    "--toggle-collect=*counted_normals*",
                ])
                .arg(std::env::current_exe().unwrap())
                .args([
                    "--exact",
                    "normal::tests::every_number_takes_the_same_number_of_instructions",
                ])
                .env(CHILD, std::format!("{case}"))
                .output();
            let Ok(output) = output else {
                std::println!("skipped: valgrind is not installed");
                return;
            };
            assert!(output.status.success(), "{output:?}");
            let errors = std::string::String::from_utf8(output.stderr).unwrap();
            let (_, count) = errors.split_once("Collected : ").expect("what was counted");
            let count: u64 = count.lines().next().unwrap().trim().parse().unwrap();
            counts.push(count);
        }
        std::println!("instructions: {counts:?}");
        assert!(counts[0] > 50_000, "{counts:?}");
        assert!(counts.iter().all(|&count| count == counts[0]), "{counts:?}");
    }

    #[test]
    fn a_fill_goes_on_where_the_last_one_ended() {
        let (mut whole, mut parts) = ([0.0; 10], [0.0; 10]);
        Normals::new(4).fill(&mut whole);
        let mut normals = Normals::new(4);
        normals.fill(&mut []);
        normals.fill(&mut parts[..3]);
        normals.fill(&mut parts[3..]);
        assert_eq!(whole, parts);
        assert_ne!(sample(4, 4), sample(5, 4));
    }
}
