//! Sums in sixteen lanes: element `i` goes to lane `i % 16`, then the lanes are added as a tree. One order on every target.

/// Number of lanes of a sum. Sixteen elements are one cache line, and fill vectors of four, eight
/// or sixteen.
pub const LANES: usize = 16;

/// One block of [`LANES`] elements.
pub type Block = [f32; LANES];

/// Returns the sum of the lanes: halves are added until one element is left.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "constant bounds; compilers vectorise this form best"
)]
pub fn tree(acc: &Block) -> f32 {
    let mut eight = [0.0; 8];
    for i in 0..8 {
        eight[i] = acc[i] + acc[i + 8];
    }
    let mut four = [0.0; 4];
    for i in 0..4 {
        four[i] = eight[i] + eight[i + 4];
    }
    (four[0] + four[2]) + (four[1] + four[3])
}

/// Returns the sum of `f(x[i])`.
#[inline(always)]
pub fn sum_of(x: &[f32], f: impl Fn(f32) -> f32) -> f32 {
    let mut acc = [0.0; LANES];
    let (blocks, tail) = x.as_chunks::<LANES>();
    for block in blocks {
        for (acc, &x) in acc.iter_mut().zip(block) {
            *acc += f(x);
        }
    }
    for (acc, &x) in acc.iter_mut().zip(tail) {
        *acc += f(x);
    }
    tree(&acc)
}

/// Returns the largest element, or negative infinity; NaNs are skipped.
#[inline(always)]
pub fn max_of(x: &[f32]) -> f32 {
    let larger = |a: f32, b: f32| if b > a { b } else { a };
    let mut acc = [f32::NEG_INFINITY; LANES];
    let (blocks, tail) = x.as_chunks::<LANES>();
    for block in blocks {
        for (acc, &x) in acc.iter_mut().zip(block) {
            *acc = larger(*acc, x);
        }
    }
    for (acc, &x) in acc.iter_mut().zip(tail) {
        *acc = larger(*acc, x);
    }
    acc.into_iter().fold(f32::NEG_INFINITY, larger)
}
