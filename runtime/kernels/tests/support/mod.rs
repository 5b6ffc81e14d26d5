//! Shared helpers of the kernels' tests.

use lads_kernels::Isa;

/// Returns values in -1..1 from a seed: long vectors would make proptest slow, and shrinking their
/// elements says nothing.
pub fn values(len: usize, seed: u64) -> Vec<f32> {
    let mut state = seed;
    let next = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    };
    std::iter::repeat_with(next).take(len).collect()
}

/// Asserts equality up to `bound` times the expected magnitude, at least 1, and up to an error of
/// each element.
#[track_caller]
pub fn close_up_to(got: &[f32], expected: &[f32], bound: f32, errors: &[f32]) {
    assert_eq!([got.len(), errors.len()], [expected.len(); 2]);
    for (i, (&got, &expected)) in got.iter().zip(expected).enumerate() {
        let equal = got == expected || got.is_nan() && expected.is_nan();
        let near = (got - expected).abs() <= bound * expected.abs().max(1.0) + errors[i];
        assert!(equal || near, "element {i}: {got} against {expected}");
    }
}

/// Runs a kernel on every instruction set and returns its results, which must have the same bits,
/// and NaN in the same places.
#[track_caller]
pub fn on_all<const N: usize>(kernel: impl Fn(Isa) -> [Vec<f32>; N]) -> [Vec<f32>; N] {
    let portable = kernel(Isa::portable());
    for isa in Isa::all() {
        for (got, expected) in kernel(isa).iter().zip(&portable) {
            assert_eq!(got.len(), expected.len());
            for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
                // Which of its bit patterns not a number has is left open by Rust.
                let same = got.to_bits() == expected.to_bits() || got.is_nan() && expected.is_nan();
                assert!(same, "{isa:?}, element {i}: {got:e} against {expected:e}");
            }
        }
    }
    portable
}

/// Returns a hash that two results with different bits do not share by chance.
pub fn digest(x: &[f32]) -> u64 {
    x.iter().fold(0xcbf2_9ce4_8422_2325, |hash, x| {
        (hash ^ u64::from(x.to_bits())).wrapping_mul(0x0100_0000_01b3)
    })
}
