//! Tests layers of integer weights where their arithmetic is exact, where it nearly overflows, and
//! where inputs are extreme.

use lads_kernels::{Activation, Isa, Linear, Panels, WeightFormat, pack, packed_len};
use proptest::prelude::*;

/// Largest magnitude of an input as an integer.
const LARGEST: i16 = 8191;

/// Largest magnitude of a weight as an integer.
const WEIGHT: i16 = 16383;

/// Computes `x·W` on every instruction set; the bits have to be the same.
#[track_caller]
fn product(x: &[f32], w: &[i16], [k, n]: [usize; 2]) -> Vec<f32> {
    let mut panels = vec![0; packed_len(WeightFormat::Int16, [k, n])];
    pack(WeightFormat::Int16, w, [k, n], &mut panels);
    let layer = Linear {
        k,
        n,
        w: Panels::Int16 {
            panels: &panels,
            scales: &vec![1.0; n],
        },
        bias: &[],
        activation: Activation::None,
        accumulate: false,
    };
    let run = |isa| {
        let mut y = vec![f32::NAN; x.len() / k * n];
        layer.run(isa, x, &mut y);
        y
    };
    let portable = run(Isa::portable());
    for isa in Isa::all() {
        let got = run(isa);
        for (got, expected) in got.iter().zip(&portable) {
            let same = got.to_bits() == expected.to_bits() || got.is_nan() && expected.is_nan();
            assert!(same, "{isa:?}: {got:e} against {expected:e}");
        }
    }
    portable
}

proptest! {
    /// Inputs that are whole numbers, one of each part as large as the largest integer, are
    /// multiplied exactly; results below 2^24 are exact as floats.
    #[test]
    fn whole_numbers_are_multiplied_exactly(
        (rows, k, n) in (1_usize..4, 1_usize..600, 1_usize..100),
        seed in any::<u64>(),
    ) {
        let mut state = seed;
        let mut next = |largest: i64| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 33) as i64 % (2 * largest + 1) - largest
        };
        let mut x: Vec<i64> = (0..rows * k).map(|_| next(900)).collect();
        for row in x.chunks_mut(k) {
            for part in row.chunks_mut(256) {
                let at = next(1 << 20).unsigned_abs() as usize % part.len();
                part[at] = i64::from(LARGEST) * next(1).signum().abs().max(1);
            }
        }
        let w: Vec<i64> = (0..k * n).map(|_| next(30)).collect();
        let floats: Vec<f32> = x.iter().map(|&x| x as f32).collect();
        let integers: Vec<i16> = w.iter().map(|&w| w as i16).collect();
        let y = product(&floats, &integers, [k, n]);
        for (i, &y) in y.iter().enumerate() {
            let (row, col) = (i / n, i % n);
            let sum: i64 = (0..k).map(|l| x[row * k + l] * w[l * n + col]).sum();
            prop_assert_eq!(y, sum as f32);
        }
    }
}

/// Sixteen products of the largest magnitudes just fit a sum of integers.
#[test]
fn the_largest_sums_do_not_overflow() {
    for (x, w) in [(1, 1), (1, -1), (-1, -1)] {
        let (x, w) = (f32::from(x * LARGEST), w * WEIGHT);
        let y = product(&[x; 40], &[w; 40 * 17], [40, 17]);
        let exact = f64::from(x) * f64::from(w) * 40.0;
        for y in y {
            assert!(
                (f64::from(y) - exact).abs() <= exact.abs() * 1e-6,
                "{y:e} against {exact:e}"
            );
        }
    }
}

/// Integers of an untrusted image may be larger than a compiler's, and still give the same bits.
#[test]
fn integers_that_overflow_have_the_same_bits_on_every_instruction_set() {
    let y = product(&[1.0; 64], &[i16::MIN; 64 * 70], [64, 70]);
    assert!(y.iter().all(|y| y.is_finite()));
}

#[test]
fn what_is_no_number_or_infinite_is_never_lost() {
    for bad in [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for at in [0, 15, 255, 256, 299] {
            let mut x = [0.5; 300];
            x[at] = bad;
            // Of two rows the other is not touched.
            let rows = [x, [0.5; 300]].concat();
            let y = product(&rows, &[3; 300 * 5], [300, 5]);
            assert!(y[..5].iter().all(|y| y.is_nan()), "{bad} at {at}");
            assert!(y[5..].iter().all(|y| y.is_finite()), "{bad} at {at}");
        }
    }
}

#[test]
fn inputs_of_any_size_keep_their_digits_and_the_tiniest_are_zero() {
    let exact = |x: f32| f64::from(x) * f64::from(WEIGHT) * 3.0;
    for exponent in -99..=125 {
        let x = f32::powi(2.0, exponent) * 1.37;
        let y = product(&[x, -x, x, x, x], &[WEIGHT; 5], [5, 1])[0];
        let expected = exact(x);
        if expected < f64::from(f32::MAX) {
            assert!((f64::from(y) / expected - 1.0).abs() < 1e-6, "{x:e}: {y:e}");
        }
    }
    for tiny in [0.0, -0.0, f32::from_bits(1), 7e-31] {
        assert_eq!(product(&[tiny; 20], &[WEIGHT; 20], [20, 1]), [0.0]);
    }
}
