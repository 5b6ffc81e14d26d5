//! Panels of float weights: short formats are decoded, then products and sums are 32-bit floats.

use crate::lanes::LANES;
use crate::linear::{PANEL_BLOCKS, Place, Sums};
use crate::simd::{Simd, prefetch_ahead};
use crate::stored::Stored;

/// Computes one panel for `R` rows, in as many parts as the registers require.
#[inline(always)]
pub(crate) fn panel<S: Simd, W: Stored, const R: usize>(
    simd: S,
    w: &[W::Bits],
    blocks: usize,
    x: [&[f32]; R],
    sums: &mut Sums,
) {
    let mut at = 0;
    while at < blocks {
        let (place, left) = (Place { at, blocks }, blocks - at);
        at += if S::SUMS >= PANEL_BLOCKS * R && left >= PANEL_BLOCKS {
            sweep::<S, W, PANEL_BLOCKS, R>(simd, w, place, x, sums)
        } else if S::SUMS >= 2 * R && left >= 2 {
            sweep::<S, W, 2, R>(simd, w, place, x, sums)
        } else {
            sweep::<S, W, 1, R>(simd, w, place, x, sums)
        };
    }
}

/// Computes the sums of `R` rows of `k` elements with `P` blocks of a panel, and returns `P`.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn sweep<S: Simd, W: Stored, const P: usize, const R: usize>(
    simd: S,
    w: &[W::Bits],
    Place { at, blocks }: Place,
    x: [&[f32]; R],
    out: &mut Sums,
) -> usize {
    let (w, _) = w.as_chunks::<LANES>();
    let w = w.chunks_exact(blocks.max(1));
    if x.iter().any(|x| x.len() != w.len()) || at + P > blocks {
        return P;
    }
    let mut sums = [[simd.splat(0.0); P]; R];
    for (l, row) in w.enumerate() {
        // SAFETY: each `x[r]` is as long as `w`, as compared above, and `l` is an index of `w`.
        let x: [S::V; R] = x.map(|x| simd.splat(unsafe { *x.get_unchecked(l) }));
        for p in 0..P {
            // SAFETY: `row` has `blocks` elements, `at + P <= blocks`, as compared above, and `p < P`.
            let w = unsafe { row.get_unchecked(at + p) };
            prefetch_ahead(p, w);
            let w = W::load(simd, w);
            for (sums, &x) in sums.iter_mut().zip(&x) {
                sums[p] = simd.add_product(sums[p], x, w);
            }
        }
    }
    for (out, sums) in out.iter_mut().zip(sums) {
        for (out, sum) in out.iter_mut().skip(at).zip(sums) {
            simd.store(sum, out);
        }
    }
    P
}
