//! Vectors of sixteen lanes, one implementation per instruction set; the bits of every operation are those of [`Portable`].
//!
//! Loops that compilers vectorise by themselves are written over arrays; the loops in which a
//! control step spends its time, over weights and over the KV cache, are written with these
//! vectors, so that their machine code does not depend on the compiler's choices.
//!
//! Invariant: a value that implements [`Simd`] is the proof that its instructions exist. Only
//! `dispatch` makes the value of an instruction set beyond the target's baseline, inside a function
//! that is compiled for it.
#![allow(unsafe_code)]

#[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
pub(crate) mod aarch64;
#[cfg(target_arch = "x86_64")]
pub(crate) mod x86_64;

use crate::integers::{self, Group};
use crate::lanes::{Block, LANES};
use crate::stored;

/// Vectors of one instruction set.
pub(crate) trait Simd: Copy {
    /// Vector of sixteen lanes of `f32`.
    type V: Copy;
    /// Vector of sixteen lanes of two 16-bit integers.
    type Pairs: Copy;
    /// Vector of sixteen lanes of a 32-bit integer.
    type Integers: Copy;

    /// Number of sums of sixteen lanes that stay in registers, beside the operands.
    const SUMS: usize;
    /// Number of sums of products that alternate, one or two: two if the next product would wait
    /// for the sum, though two take more code.
    const CHAINS: usize;
    /// Number of pixels of an image whose sums stay in registers, beside the weights of
    /// [`PANELS`](Self::PANELS) panels.
    const PIXELS: usize;
    /// Number of panels of sixteen outputs that share the pixels that are read, one or two.
    const PANELS: usize;
    /// Number of panels and of pixels whose sums of integers stay in registers, beside the operands:
    /// one, two or four panels, three or six pixels.
    const INTEGER_TILE: [usize; 2];

    /// Returns the same number in every lane.
    fn splat(self, x: f32) -> Self::V;
    /// Loads sixteen numbers from memory.
    fn load(self, from: &Block) -> Self::V;
    /// Stores sixteen numbers to memory.
    fn store(self, v: Self::V, to: &mut Block);
    /// Returns `a + b`.
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// Returns `other` in the lanes where `x < 0`, else `x`.
    fn where_negative(self, x: Self::V, other: Self::V) -> Self::V;
    /// Returns `bound` in the lanes where it is less than `x`, else `x`.
    fn at_most(self, x: Self::V, bound: Self::V) -> Self::V;
    /// Returns `a * b`.
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// Returns `sum + a * b`, rounded twice: never fused.
    fn add_product(self, sum: Self::V, a: Self::V, b: Self::V) -> Self::V;
    /// Loads sixteen half-precision numbers, see [`stored::from_f16`].
    fn load_f16(self, from: &[u16; LANES]) -> Self::V;
    /// Rounds sixteen numbers to half precision, see [`stored::round_to_f16`].
    fn round_to_f16(self, v: Self::V) -> [u16; LANES];
    /// Loads sixteen brain floats, see [`stored::from_bf16`].
    fn load_bf16(self, from: &[u16; LANES]) -> Self::V;
    /// Loads sixteen 8-bit integers as floats.
    fn load_bytes(self, from: &[i8; LANES]) -> Self::V;
    /// Returns the same two integers in every lane.
    #[expect(
        clippy::trivially_copy_pass_by_ref,
        reason = "where it lies, it can be read into every lane at once"
    )]
    fn splat_pair(self, pair: &[i16; 2]) -> Self::Pairs;
    /// Loads sixteen pairs from memory.
    fn load_i16(self, from: &[i16; 2 * LANES]) -> Self::Pairs;
    /// Loads sixteen pairs of 8-bit integers from memory and widens them.
    fn load_i8(self, from: &[i8; 2 * LANES]) -> Self::Pairs;
    /// Returns sums of zero.
    fn zeros(self) -> Self::Integers;
    /// Returns `sum + a[0] * b[0] + a[1] * b[1]`; overflow wraps around.
    fn add_products(self, sum: Self::Integers, a: Self::Pairs, b: Self::Pairs) -> Self::Integers;
    /// Returns `a + b`; overflow wraps around.
    fn add_integers(self, a: Self::Integers, b: Self::Integers) -> Self::Integers;
    /// Converts integers to the nearest floats, ties to even.
    fn floats(self, integers: Self::Integers) -> Self::V;
    /// Rounds magnitudes up to 32767 to the nearest integers, ties to even; larger ones and NaN
    /// give any integers.
    fn whole(self, v: Self::V) -> [i16; LANES];
    /// Returns the larger of each integer, not negative, and the bits of a float without its sign.
    fn larger(self, largest: Self::Integers, v: Self::V) -> Self::Integers;
    /// Returns the largest of sixteen integers that are not negative.
    fn largest(self, integers: Self::Integers) -> u32;
    /// Computes the sums of a group of inputs of `R` rows with `P` blocks of 8-bit weights, as
    /// floats; `w(pair, block)` are the weights of a pair of inputs. Overflow wraps around.
    #[inline(always)]
    fn group_of_bytes<'w, const P: usize, const R: usize>(
        self,
        w: impl Fn(usize, usize) -> &'w [i8; 2 * LANES],
        x: [&Group; R],
    ) -> [[Self::V; P]; R] {
        integers::by_pairs(self, w, x)
    }
}

/// Constant that rounds when added: the low bits of the float sum are the nearest integer, ties to
/// even; 3 * 2^22.
const ROUND: f32 = 12_582_912.0;

/// All bits of a float but its sign.
const MAGNITUDE: i32 = i32::MAX;

/// Prefetches the cache line that will be read [`AHEAD`] bytes after the `i`th of consecutive
/// blocks, once for each line, where the target has an instruction for it. It is a hint: the
/// address need not be valid.
///
/// Weights and KV cache are read strictly in order, so the processor's own prefetcher follows them;
/// but it stops at the end of a page, and does not request as many lines at a time as memory could
/// deliver.
#[inline(always)]
pub(crate) fn prefetch_ahead<T>(i: usize, block: &T) {
    #[cfg(target_arch = "x86_64")]
    if (i * size_of::<T>()).is_multiple_of(LINE) {
        let at = (&raw const *block).wrapping_byte_add(AHEAD);
        // SAFETY: part of SSE, which every x86-64 CPU has; it reads nothing.
        unsafe {
            use core::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
            _mm_prefetch::<_MM_HINT_T0>(at.cast());
        }
    }
    #[cfg(target_arch = "aarch64")]
    if (i * size_of::<T>()).is_multiple_of(LINE) {
        // SAFETY: part of every aarch64 CPU; it reads nothing.
        unsafe {
            core::arch::asm!(
                "prfm pldl1keep, [{block}, #{ahead}]",
                block = in(reg) block,
                ahead = const AHEAD,
                options(nomem, nostack, preserves_flags),
            );
        }
    }
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let _ = (i, block);
}

/// Size of a cache line in bytes.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
const LINE: usize = 64;

/// Distance of the prefetch in bytes, far enough for memory to answer, near enough for the
/// first-level cache: of 0.5 to 64 KiB, a Xeon took least time with 8, and on it and another
/// generation a control step takes a quarter less than without where memory is far, and an action
/// up to a tenth less where it is near.
#[cfg(target_arch = "x86_64")]
const AHEAD: usize = 8192;

/// Distance of the prefetch in bytes, which memory delivers during one access, 10 GB/s for 200 ns:
/// boards have smaller first-level caches and narrower memory. Computed, not measured.
#[cfg(target_arch = "aarch64")]
const AHEAD: usize = 2048;

/// Baseline of the build's target: arrays, which compilers put into its registers.
#[derive(Clone, Copy)]
pub(crate) struct Portable;

impl Simd for Portable {
    type V = Block;
    type Pairs = [i16; 2 * LANES];
    type Integers = [i32; LANES];

    const SUMS: usize = 2;
    const CHAINS: usize = 1;
    const PIXELS: usize = 3;
    const PANELS: usize = 1;
    const INTEGER_TILE: [usize; 2] = [1, 3];

    #[inline(always)]
    fn splat(self, x: f32) -> Block {
        [x; LANES]
    }

    #[inline(always)]
    fn load(self, from: &Block) -> Block {
        *from
    }

    #[inline(always)]
    fn store(self, v: Block, to: &mut Block) {
        *to = v;
    }

    #[inline(always)]
    fn add(self, mut a: Block, b: Block) -> Block {
        for (a, b) in a.iter_mut().zip(b) {
            *a += b;
        }
        a
    }

    #[inline(always)]
    fn where_negative(self, mut x: Block, other: Block) -> Block {
        for (x, other) in x.iter_mut().zip(other) {
            *x = if *x < 0.0 { other } else { *x };
        }
        x
    }

    #[inline(always)]
    fn at_most(self, mut x: Block, bound: Block) -> Block {
        for (x, bound) in x.iter_mut().zip(bound) {
            *x = if bound < *x { bound } else { *x };
        }
        x
    }

    #[inline(always)]
    fn mul(self, mut a: Block, b: Block) -> Block {
        for (a, b) in a.iter_mut().zip(b) {
            *a *= b;
        }
        a
    }

    #[inline(always)]
    fn add_product(self, mut sum: Block, a: Block, b: Block) -> Block {
        for (sum, (a, b)) in sum.iter_mut().zip(a.into_iter().zip(b)) {
            *sum += a * b;
        }
        sum
    }

    #[inline(always)]
    fn load_f16(self, from: &[u16; LANES]) -> Block {
        stored::all_from_f16(from)
    }

    #[inline(always)]
    fn round_to_f16(self, v: Block) -> [u16; LANES] {
        stored::round_all_to_f16(&v)
    }

    #[inline(always)]
    fn load_bf16(self, from: &[u16; LANES]) -> Block {
        from.map(stored::from_bf16)
    }

    #[inline(always)]
    fn load_bytes(self, from: &[i8; LANES]) -> Block {
        let mut to = [0.0; LANES];
        for (to, &from) in to.iter_mut().zip(from) {
            *to = from.into();
        }
        to
    }

    #[inline(always)]
    fn splat_pair(self, pair: &[i16; 2]) -> Self::Pairs {
        let mut pairs = [0; 2 * LANES];
        pairs.as_chunks_mut().0.fill(*pair);
        pairs
    }

    #[inline(always)]
    fn load_i16(self, from: &[i16; 2 * LANES]) -> Self::Pairs {
        *from
    }

    #[inline(always)]
    fn load_i8(self, from: &[i8; 2 * LANES]) -> Self::Pairs {
        // A loop: mapped arrays are not always compiled in line.
        let mut to = [0; 2 * LANES];
        for (to, &from) in to.iter_mut().zip(from) {
            *to = i16::from(from);
        }
        to
    }

    #[inline(always)]
    fn zeros(self) -> Self::Integers {
        [0; LANES]
    }

    #[inline(always)]
    fn add_products(self, sum: Self::Integers, a: Self::Pairs, b: Self::Pairs) -> Self::Integers {
        #[cfg(target_arch = "x86_64")]
        return x86_64::add_products(sum, a, b);
        #[cfg(not(target_arch = "x86_64"))]
        return add_products(sum, a, b);
    }

    #[inline(always)]
    fn add_integers(self, mut a: Self::Integers, b: Self::Integers) -> Self::Integers {
        for (a, b) in a.iter_mut().zip(b) {
            *a = a.wrapping_add(b);
        }
        a
    }

    #[inline(always)]
    fn floats(self, integers: Self::Integers) -> Block {
        integers.map(|integer| integer as f32)
    }

    #[inline(always)]
    fn whole(self, v: Block) -> [i16; LANES] {
        v.map(|x| (x + ROUND).to_bits() as i16)
    }

    #[inline(always)]
    fn larger(self, mut largest: Self::Integers, v: Block) -> Self::Integers {
        for (largest, x) in largest.iter_mut().zip(v) {
            *largest = (x.to_bits().cast_signed() & MAGNITUDE).max(*largest);
        }
        largest
    }

    #[inline(always)]
    fn largest(self, integers: Self::Integers) -> u32 {
        integers.into_iter().fold(0, i32::max).cast_unsigned()
    }
}

/// Implements [`Simd::add_products`] for arrays.
#[cfg(any(test, not(target_arch = "x86_64")))]
#[inline(always)]
fn add_products(mut sum: [i32; LANES], a: [i16; 2 * LANES], b: [i16; 2 * LANES]) -> [i32; LANES] {
    let pairs = a.as_chunks().0.iter().zip(b.as_chunks().0);
    for (sum, (&[a0, a1], &[b0, b1])) in sum.iter_mut().zip(pairs) {
        let product = |a, b| i32::from(a) * i32::from(b);
        *sum = sum.wrapping_add(product(a0, b0).wrapping_add(product(a1, b1)));
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::{LANES, Portable, Simd, add_products};

    #[test]
    fn products_of_pairs_wrap_around_and_are_the_same_by_name_and_by_arrays() {
        let extremes = [i16::MIN, -16_383, -1, 0, 1, 8191, i16::MAX];
        for first in 0..extremes.len() {
            let number = |i: usize, step: usize| {
                let at = (first + i * step) % extremes.len();
                extremes.get(at).copied().unwrap_or(0)
            };
            let a = core::array::from_fn::<_, { 2 * LANES }, _>(|i| number(i, 1));
            let b = core::array::from_fn::<_, { 2 * LANES }, _>(|i| number(i, 3));
            for sum in [0, i32::MAX, i32::MIN] {
                let sums = [sum; LANES];
                let products = Portable.add_products(sums, a, b);
                assert_eq!(products, add_products(sums, a, b));
                let in_64_bits = |i: usize| {
                    i64::from(sum)
                        + (0..2)
                            .map(|j| {
                                i64::from(number(2 * i + j, 1)) * i64::from(number(2 * i + j, 3))
                            })
                            .sum::<i64>()
                };
                assert_eq!(products, core::array::from_fn(|i| in_64_bits(i) as i32));
            }
        }
    }
}
