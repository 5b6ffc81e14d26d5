//! Panels of integer weights: products and sums of integers, which no instruction set rounds.
//!
//! ```text
//! for each part of up to 256 inputs:           x as integers of 14 bits, times one scale for the part
//!     for each sixteen inputs:                 as eight pairs
//!         integers[0..64] = sum over pairs of  x[2l] * panel[l][0..64][0] + x[2l + 1] * panel[l][0..64][1]
//!         sum[0..64] += integers
//!     y[0..64] += sum * scale of the part
//! ```
//!
//! A processor multiplies two pairs of 16-bit integers and adds the products in one instruction for each 32-bit lane: twice the weights
//! of a multiplication of floats, and nothing to decode. Sixteen products of 14 and 15 bits are the most that a 32-bit
//! sum holds, so nothing overflows; the sums go on as floats, in the order of the inputs.
//!
//! The integers of a part of `x` differ from `x * 8191 / largest` by half a unit: an error of an input of 2^-14 of the largest
//! magnitude in its part. If a part contains infinity or NaN, its sums are NaN; a part whose magnitudes are all below 2^-100 is
//! read as zero.

use core::hint::black_box;
use core::{array, slice};

use crate::elementwise::assign;
use crate::lanes::{Block, LANES};
use crate::linear::{PANEL_BLOCKS, Place, Sums};
use crate::simd::{Portable, Simd, prefetch_ahead};

/// Number of inputs that are converted to integers at a time.
pub(crate) const PART: usize = 256;

/// Pairs of inputs whose products are added before they become floats: `2 * PAIRS * 16383 * 8191 < 2^31`.
pub(crate) const PAIRS: usize = 8;

/// Largest magnitude of an input as an integer.
const LARGEST: f32 = 8191.0;

/// A pair of inputs as integers.
type Pair = [i16; 2];

/// Inputs whose products are added as integers before they become floats.
pub(crate) type Group = [Pair; PAIRS];

/// A storage format of integer weights.
pub(crate) trait Integer: Copy {
    /// Loads two weights of each of sixteen outputs, as 16-bit integers.
    fn load<S: Simd>(simd: S, from: &[Self; 2 * LANES]) -> S::Pairs;

    /// Computes the sums of a group of inputs, like [`Simd::group_of_bytes`].
    #[inline(always)]
    fn group<'w, S: Simd, const P: usize, const R: usize>(
        simd: S,
        w: impl Fn(usize, usize) -> &'w [Self; 2 * LANES],
        x: [&Group; R],
    ) -> [[S::V; P]; R]
    where
        Self: 'w,
    {
        by_pairs(simd, w, x)
    }
}

impl Integer for i16 {
    #[inline(always)]
    fn load<S: Simd>(simd: S, from: &[Self; 2 * LANES]) -> S::Pairs {
        simd.load_i16(from)
    }
}

impl Integer for i8 {
    #[inline(always)]
    fn load<S: Simd>(simd: S, from: &[Self; 2 * LANES]) -> S::Pairs {
        simd.load_i8(from)
    }

    #[inline(always)]
    fn group<'w, S: Simd, const P: usize, const R: usize>(
        simd: S,
        w: impl Fn(usize, usize) -> &'w [Self; 2 * LANES],
        x: [&Group; R],
    ) -> [[S::V; P]; R] {
        simd.group_of_bytes(w, x)
    }
}

/// Part of a row as integers, followed by zeros.
pub(crate) struct Part {
    pairs: [Pair; PART / 2],
    /// Value of an input per unit of its integer.
    scale: f32,
}

impl Part {
    /// A part that holds no inputs.
    pub const EMPTY: Self = Self {
        pairs: [[0; 2]; PART / 2],
        scale: 0.0,
    };

    /// Converts the first part of a row.
    #[inline(always)]
    pub fn take<S: Simd>(&mut self, simd: S, row: &[f32]) {
        let inputs = row.get(..PART).unwrap_or(row);
        let (blocks, rest) = inputs.as_chunks::<LANES>();
        let mut last = [0.0; LANES];
        assign(&mut last, rest);
        let (per_input, per_unit) = scales_of(simd, blocks, &last, LARGEST);
        self.scale = per_unit;
        let per_input = simd.splat(per_input);
        let (integers, _) = self.pairs.as_flattened_mut().as_chunks_mut::<LANES>();
        for (to, block) in integers.iter_mut().zip(blocks) {
            *to = simd.whole(simd.mul(simd.load(block), per_input));
        }
        if let Some(to) = integers.get_mut(blocks.len()) {
            *to = simd.whole(simd.mul(simd.load(&last), per_input));
        }
    }
}

/// Returns the factors from numbers, whole blocks and the rest, to integers and back: the largest
/// magnitude becomes `integer`.
#[inline(always)]
pub(crate) fn scales_of<S: Simd>(
    simd: S,
    blocks: &[Block],
    last: &Block,
    integer: f32,
) -> (f32, f32) {
    // A loop, because iterators that take closures are not compiled for the instruction set.
    let mut largest = simd.larger(simd.zeros(), simd.load(last));
    for block in blocks {
        largest = simd.larger(largest, simd.load(block));
    }
    scales(simd.largest(largest), integer)
}

/// Returns the factors from inputs to integers and back, from the bits of the largest magnitude of the
/// inputs and the integer that it becomes.
#[inline(always)]
pub(crate) fn scales(largest: u32, integer: f32) -> (f32, f32) {
    const INFINITE: u32 = f32::INFINITY.to_bits();
    /// Bits of 2^-100, below which magnitudes are read as zero.
    const SMALLEST: u32 = (127 - 100) << 23;
    // Masks, and before the divisions: a selection may be compiled to a branch, also one around a division.
    let all = |condition: bool| u32::from(condition).wrapping_neg();
    let (usable, finite) = (all(largest >= SMALLEST), all(largest < INFINITE));
    let (both, some) = (usable & finite, integer.to_bits());
    let per_input = f32::from_bits(some & both) / f32::from_bits(largest & both | some & !both);
    // All ones are NaN.
    let per_unit = f32::from_bits(largest & both | !finite) / integer;
    (per_input, per_unit)
}

/// Adds the sums of one part of `R` rows with one panel to those of the parts before, of which there
/// are `index`.
#[inline(always)]
pub(crate) fn panel<S: Simd, W: Integer, const R: usize>(
    simd: S,
    w: &[W],
    blocks: usize,
    parts: &[Part],
    index: usize,
    sums: &mut Sums,
) {
    let Some(rows) = parts.first_chunk::<R>() else {
        return;
    };
    let (pairs, _) = w.as_chunks::<{ 2 * LANES }>();
    let pairs = pairs.get(index * PART / 2 * blocks..).unwrap_or(&[]);
    let follows = index > 0;
    if S::SUMS < 4 {
        for (row, sums) in rows.iter().zip(sums) {
            one_row(pairs, blocks, row, follows, sums);
        }
        return;
    }
    let mut at = 0;
    while at < blocks {
        let (place, left) = (Place { at, blocks }, blocks - at);
        // Each sum takes two registers, one of integers and one of floats.
        at += if S::SUMS >= 2 * PANEL_BLOCKS * R {
            // Narrower panels are few, and code is not free either.
            if left >= PANEL_BLOCKS {
                sweep::<S, W, PANEL_BLOCKS, R>(simd, pairs, place, rows, follows, sums)
            } else {
                sweep::<S, W, 1, R>(simd, pairs, place, rows, follows, sums)
            }
        } else if S::SUMS >= 4 * R && left >= 2 {
            sweep::<S, W, 2, R>(simd, pairs, place, rows, follows, sums)
        } else {
            sweep::<S, W, 1, R>(simd, pairs, place, rows, follows, sums)
        };
    }
}

/// Adds the sums of a part of one row, block by block. Out of line, so that where registers are few
/// the code is compiled once for any number of rows.
#[inline(never)]
fn one_row<W: Integer>(
    w: &[[W; 2 * LANES]],
    blocks: usize,
    row: &Part,
    follows: bool,
    sums: &mut [Block; PANEL_BLOCKS],
) {
    for at in 0..blocks {
        let (place, rows) = (Place { at, blocks }, array::from_ref(row));
        let out = slice::from_mut(sums);
        sweep::<Portable, W, 1, 1>(Portable, w, place, rows, follows, out);
    }
}

/// Computes the sums of a part of `R` rows with `P` blocks of a panel, adds them to those in `out`
/// if the part `follows` others, else replaces those, and returns `P`.
#[inline(always)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn sweep<S: Simd, W: Integer, const P: usize, const R: usize>(
    simd: S,
    w: &[[W; 2 * LANES]],
    Place { at, blocks }: Place,
    rows: &[Part; R],
    follows: bool,
    out: &mut [[Block; PANEL_BLOCKS]],
) -> usize {
    if at + P > blocks {
        return P;
    }
    let groups_of_rows = rows.each_ref().map(|row| row.pairs.as_chunks::<PAIRS>().0);
    let groups_of_w = w.chunks_exact((PAIRS * blocks).max(1));
    let mut totals = [[simd.splat(0.0); P]; R];
    for (l, group) in groups_of_w.take(PART / 2 / PAIRS).enumerate() {
        // SAFETY: `l` is below the number of groups in a part, which is how many each row has.
        let x = groups_of_rows.map(|groups| unsafe { groups.get_unchecked(l) });
        let weights = |pair: usize, p: usize| {
            // SAFETY: `group` has `PAIRS * blocks` elements, `pair < PAIRS`, `at + P <= blocks`, as compared above, and `p < P`.
            let block = unsafe { group.get_unchecked(pair * blocks + at + p) };
            prefetch_ahead(p, block);
            block
        };
        let sums = W::group::<S, P, R>(simd, weights, x);
        for (total, sum) in totals
            .as_flattened_mut()
            .iter_mut()
            .zip(sums.as_flattened())
        {
            *total = simd.add(*total, *sum);
        }
    }
    for ((out, row), totals) in out.iter_mut().zip(rows).zip(totals) {
        let scale = simd.splat(row.scale);
        for (out, total) in out.iter_mut().skip(at).zip(totals) {
            let before = if follows {
                simd.load(out)
            } else {
                simd.splat(0.0)
            };
            simd.store(simd.add_product(before, total, scale), out);
        }
    }
    P
}

/// Computes the sums of a group, pair by pair.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
pub(crate) fn by_pairs<'w, S: Simd, W: Integer + 'w, const P: usize, const R: usize>(
    simd: S,
    w: impl Fn(usize, usize) -> &'w [W; 2 * LANES],
    x: [&Group; R],
) -> [[S::V; P]; R] {
    const { assert!(S::CHAINS == 1 || S::CHAINS == 2, "one sum, or two") };
    let mut chains = [[[simd.zeros(); P]; R]; 2];
    // The number of rounds is hidden from the compiler, which would unroll them: measured on a Xeon with AVX-512, with 256 x 256 weights
    // and two rows, 8-bit weights then take 2.1 instead of 1.6 us, 16-bit ones 2.0 instead of 1.8, and the code is 9 KB larger. If a
    // compiler sees through `black_box`, time and size change, nothing else.
    for round in 0..black_box(PAIRS / S::CHAINS) {
        for (chain, integers) in chains.iter_mut().take(S::CHAINS).enumerate() {
            let pair = round * S::CHAINS + chain;
            // SAFETY: `pair` is below `PAIRS`, the number in a group: rounds times chains are no more.
            let inputs = x.map(|x| simd.splat_pair(unsafe { x.get_unchecked(pair) }));
            for p in 0..P {
                let weights = W::load(simd, w(pair, p));
                for (sums, &input) in integers.iter_mut().zip(&inputs) {
                    sums[p] = simd.add_products(sums[p], weights, input);
                }
            }
        }
    }
    let [first, second] = chains;
    let mut floats = [[simd.splat(0.0); P]; R];
    for r in 0..R {
        for p in 0..P {
            // Sums of integers are exact, so chains change no bits.
            let sum = if S::CHAINS == 2 {
                simd.add_integers(first[r][p], second[r][p])
            } else {
                first[r][p]
            };
            floats[r][p] = simd.floats(sum);
        }
    }
    floats
}
