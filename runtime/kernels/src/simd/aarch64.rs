//! Vectors of aarch64: NEON, its baseline, and NEON with the dot product of bytes.
//!
//! A block takes four registers of thirty-two. Integers of 16 bits are multiplied and added four at a time (`smlal`): pairs are not
//! taken apart, so even and odd lanes of a register hold the sums of either input of a pair until [`Simd::floats`] adds
//! them. With the dot product, bytes are multiplied sixteen at a time (`sdot`): an input of 14 bits is split into two of 7,
//! `128 * high + low`, and each takes its own sums. All of it is exact, or wraps around as the other instruction sets do.
//!
//! Instructions without a stable intrinsic (half precision, `sdot`) are assembly.
//!
//! Invariant: `dispatch` alone makes a [`Dot`], inside a function that is compiled for its instructions.

use core::arch::aarch64::{
    float32x4_t, int8x16_t, int16x8_t, int32x4_t, uint16x4_t, uint16x8_t, vaddq_f32, vaddq_s32,
    vandq_s32, vbslq_f32, vcltq_f32, vcltzq_f32, vcombine_s8, vcombine_s16, vcvtq_f32_s32,
    vdupq_n_f32, vdupq_n_s32, vget_high_s8, vget_high_s16, vget_high_u16, vget_low_s8,
    vget_low_s16, vget_low_u16, vld1q_f32, vld1q_s8, vld1q_s16, vld1q_u16, vmaxq_s32, vmaxvq_s32,
    vmlal_s16, vmovl_high_s8, vmovl_high_s16, vmovl_s8, vmovl_s16, vmovl_u16, vmovn_s16, vmovn_s32,
    vmulq_f32, vpaddq_s32, vreinterpretq_f32_u32, vreinterpretq_s8_s16, vreinterpretq_s16_s8,
    vreinterpretq_s32_f32, vrshrn_n_s16, vshlq_n_s8, vshlq_n_s32, vshlq_n_u32, vshrq_n_s8,
    vst1q_f32, vst1q_s16, vst1q_u16, vzip1q_s16, vzip2q_s16,
};
use core::arch::asm;

use super::{MAGNITUDE, ROUND, Simd};
use crate::integers::{self, Group, PAIRS};
use crate::lanes::{Block, LANES};

/// A block in four registers. `DOT` is true if the CPU has the dot product of bytes.
#[derive(Clone, Copy)]
pub(crate) struct Neon<const DOT: bool>(());

/// NEON alone, which every CPU of the target has.
pub(crate) type Plain = Neon<false>;
/// NEON with the dot product of bytes (FEAT_DotProd).
pub(crate) type Dot = Neon<true>;

impl Plain {
    #[inline(always)]
    pub(crate) fn new() -> Self {
        Self(())
    }
}

impl Dot {
    /// Makes the value that proves FEAT_DotProd.
    ///
    /// # Safety
    /// The CPU has FEAT_DotProd.
    #[inline(always)]
    pub(crate) unsafe fn new() -> Self {
        Self(())
    }
}

impl<const DOT: bool> Simd for Neon<DOT> {
    type V = [float32x4_t; 4];
    type Pairs = [int16x8_t; 4];
    /// Sums whose even and odd lanes are added by [`Simd::floats`].
    type Integers = [int32x4_t; 8];

    const SUMS: usize = 4;
    const CHAINS: usize = 1;
    const PIXELS: usize = 6;
    const PANELS: usize = 1;
    const INTEGER_TILE: [usize; 2] = [1, 3];

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        // SAFETY: NEON is part of the target.
        [unsafe { vdupq_n_f32(x) }; 4]
    }

    #[inline(always)]
    fn load(self, from: &Block) -> Self::V {
        let from = from.as_ptr();
        // SAFETY: NEON is part of the target; all quarters lie inside the block.
        unsafe {
            [
                vld1q_f32(from),
                vld1q_f32(from.add(4)),
                vld1q_f32(from.add(8)),
                vld1q_f32(from.add(12)),
            ]
        }
    }

    #[inline(always)]
    fn store(self, v: Self::V, to: &mut Block) {
        let to = to.as_mut_ptr();
        // SAFETY: NEON is part of the target; all quarters lie inside the block.
        unsafe {
            vst1q_f32(to, v[0]);
            vst1q_f32(to.add(4), v[1]);
            vst1q_f32(to.add(8), v[2]);
            vst1q_f32(to.add(12), v[3]);
        }
    }

    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: NEON is part of the target.
        both(a, b, |a, b| unsafe { vaddq_f32(a, b) })
    }

    #[inline(always)]
    fn where_negative(self, x: Self::V, other: Self::V) -> Self::V {
        // SAFETY: NEON is part of the target.
        both(x, other, |x, other| unsafe {
            vbslq_f32(vcltzq_f32(x), other, x)
        })
    }

    #[inline(always)]
    fn at_most(self, x: Self::V, bound: Self::V) -> Self::V {
        // SAFETY: NEON is part of the target.
        both(x, bound, |x, bound| unsafe {
            vbslq_f32(vcltq_f32(bound, x), bound, x)
        })
    }

    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: NEON is part of the target.
        both(a, b, |a, b| unsafe { vmulq_f32(a, b) })
    }

    #[inline(always)]
    fn add_product(self, sum: Self::V, a: Self::V, b: Self::V) -> Self::V {
        self.add(sum, self.mul(a, b))
    }

    #[inline(always)]
    fn load_f16(self, from: &[u16; LANES]) -> Self::V {
        let [low, high] = eights(from);
        let ([a, b], [c, d]) = (from_f16(low), from_f16(high));
        [a, b, c, d]
    }

    #[inline(always)]
    fn round_to_f16(self, [a, b, c, d]: Self::V) -> [u16; LANES] {
        let mut to = [0; LANES];
        let at: *mut u16 = to.as_mut_ptr();
        // SAFETY: NEON is part of the target; both halves lie inside the array.
        unsafe {
            vst1q_u16(at, to_f16(a, b));
            vst1q_u16(at.add(8), to_f16(c, d));
        }
        to
    }

    #[inline(always)]
    fn load_bf16(self, from: &[u16; LANES]) -> Self::V {
        let [low, high] = eights(from);
        // SAFETY: NEON is part of the target.
        let wide =
            |x: uint16x4_t| unsafe { vreinterpretq_f32_u32(vshlq_n_u32::<16>(vmovl_u16(x))) };
        // SAFETY: NEON is part of the target.
        unsafe {
            [
                wide(vget_low_u16(low)),
                wide(vget_high_u16(low)),
                wide(vget_low_u16(high)),
                wide(vget_high_u16(high)),
            ]
        }
    }

    #[inline(always)]
    fn load_bytes(self, from: &[i8; LANES]) -> Self::V {
        // SAFETY: NEON is part of the target; a block is sixteen bytes.
        unsafe {
            let bytes = vld1q_s8(from.as_ptr());
            let [low, high] = [vmovl_s8(vget_low_s8(bytes)), vmovl_high_s8(bytes)];
            [
                vcvtq_f32_s32(vmovl_s16(vget_low_s16(low))),
                vcvtq_f32_s32(vmovl_high_s16(low)),
                vcvtq_f32_s32(vmovl_s16(vget_low_s16(high))),
                vcvtq_f32_s32(vmovl_high_s16(high)),
            ]
        }
    }

    #[inline(always)]
    fn splat_pair(self, pair: &[i16; 2]) -> Self::Pairs {
        let pairs: int16x8_t;
        // By name, because compilers load both integers apart and put them together again.
        // SAFETY: NEON is part of the target; four bytes are read, which a pair is, wherever they lie.
        unsafe {
            asm!(
                "ld1r {{{pairs:v}.4s}}, [{pair}]",
                pairs = lateout(vreg) pairs,
                pair = in(reg) pair,
                options(pure, readonly, nostack, preserves_flags),
            );
        }
        [pairs; 4]
    }

    #[inline(always)]
    fn load_i16(self, from: &[i16; 2 * LANES]) -> Self::Pairs {
        let from = from.as_ptr();
        // SAFETY: NEON is part of the target; all quarters, of eight integers each, lie inside the array.
        unsafe {
            [
                vld1q_s16(from),
                vld1q_s16(from.add(8)),
                vld1q_s16(from.add(16)),
                vld1q_s16(from.add(24)),
            ]
        }
    }

    #[inline(always)]
    fn load_i8(self, from: &[i8; 2 * LANES]) -> Self::Pairs {
        let [low, high] = sixteens(from);
        // SAFETY: NEON is part of the target.
        unsafe {
            [
                vmovl_s8(vget_low_s8(low)),
                vmovl_s8(vget_high_s8(low)),
                vmovl_s8(vget_low_s8(high)),
                vmovl_s8(vget_high_s8(high)),
            ]
        }
    }

    #[inline(always)]
    fn zeros(self) -> Self::Integers {
        // SAFETY: NEON is part of the target.
        [unsafe { vdupq_n_s32(0) }; 8]
    }

    #[inline(always)]
    fn add_products(self, sum: Self::Integers, a: Self::Pairs, b: Self::Pairs) -> Self::Integers {
        // SAFETY: NEON is part of the target.
        let low = |sum, a, b| unsafe { vmlal_s16(sum, vget_low_s16(a), vget_low_s16(b)) };
        // SAFETY: NEON is part of the target.
        let high = |sum, a, b| unsafe { vmlal_s16(sum, vget_high_s16(a), vget_high_s16(b)) };
        [
            low(sum[0], a[0], b[0]),
            high(sum[1], a[0], b[0]),
            low(sum[2], a[1], b[1]),
            high(sum[3], a[1], b[1]),
            low(sum[4], a[2], b[2]),
            high(sum[5], a[2], b[2]),
            low(sum[6], a[3], b[3]),
            high(sum[7], a[3], b[3]),
        ]
    }

    #[inline(always)]
    fn add_integers(self, mut a: Self::Integers, b: Self::Integers) -> Self::Integers {
        for (a, b) in a.iter_mut().zip(b) {
            // SAFETY: NEON is part of the target.
            *a = unsafe { vaddq_s32(*a, b) };
        }
        a
    }

    #[inline(always)]
    fn floats(self, sum: Self::Integers) -> Self::V {
        // SAFETY: NEON is part of the target.
        let added = |a, b| unsafe { vcvtq_f32_s32(vpaddq_s32(a, b)) };
        [
            added(sum[0], sum[1]),
            added(sum[2], sum[3]),
            added(sum[4], sum[5]),
            added(sum[6], sum[7]),
        ]
    }

    #[inline(always)]
    fn whole(self, v: Self::V) -> [i16; LANES] {
        let mut to = [0; LANES];
        let at: *mut i16 = to.as_mut_ptr();
        // SAFETY: NEON is part of the target; both halves lie inside the array.
        unsafe {
            let rounded = |v| vmovn_s32(vreinterpretq_s32_f32(vaddq_f32(v, vdupq_n_f32(ROUND))));
            vst1q_s16(at, vcombine_s16(rounded(v[0]), rounded(v[1])));
            vst1q_s16(at.add(8), vcombine_s16(rounded(v[2]), rounded(v[3])));
        }
        to
    }

    #[inline(always)]
    fn larger(self, mut largest: Self::Integers, v: Self::V) -> Self::Integers {
        for (largest, v) in largest.iter_mut().zip(v) {
            // SAFETY: NEON is part of the target.
            unsafe {
                let magnitude = vandq_s32(vreinterpretq_s32_f32(v), vdupq_n_s32(MAGNITUDE));
                *largest = vmaxq_s32(*largest, magnitude);
            }
        }
        largest
    }

    #[inline(always)]
    fn largest(self, [a, b, c, d, ..]: Self::Integers) -> u32 {
        // SAFETY: NEON is part of the target.
        unsafe { vmaxvq_s32(vmaxq_s32(vmaxq_s32(a, b), vmaxq_s32(c, d))) }.cast_unsigned()
    }

    #[inline(always)]
    fn group_of_bytes<'w, const P: usize, const R: usize>(
        self,
        w: impl Fn(usize, usize) -> &'w [i8; 2 * LANES],
        x: [&Group; R],
    ) -> [[Self::V; P]; R] {
        if DOT {
            // SAFETY: the constructor of `self` guarantees FEAT_DotProd.
            unsafe { dot_products(w, x) }
        } else {
            integers::by_pairs(self, w, x)
        }
    }
}

/// Applies `f` to each quarter of a block.
#[inline(always)]
fn both<T: Copy>(a: [T; 4], b: [T; 4], f: impl Fn(T, T) -> T) -> [T; 4] {
    [f(a[0], b[0]), f(a[1], b[1]), f(a[2], b[2]), f(a[3], b[3])]
}

/// Loads sixteen words as two halves.
#[inline(always)]
fn eights(from: &[u16; LANES]) -> [uint16x8_t; 2] {
    let from = from.as_ptr();
    // SAFETY: NEON is part of the target; both halves lie inside the array.
    unsafe { [vld1q_u16(from), vld1q_u16(from.add(8))] }
}

/// Loads thirty-two bytes as two halves.
#[inline(always)]
fn sixteens(from: &[i8; 2 * LANES]) -> [int8x16_t; 2] {
    let from = from.as_ptr();
    // SAFETY: NEON is part of the target; both halves lie inside the array.
    unsafe { [vld1q_s8(from), vld1q_s8(from.add(16))] }
}

/// Decodes eight half-precision numbers.
#[inline(always)]
fn from_f16(bits: uint16x8_t) -> [float32x4_t; 2] {
    let (low, high): (float32x4_t, float32x4_t);
    // SAFETY: conversions between registers, which NEON has in any case; they depend on nothing else but the rounding mode, which
    // Rust leaves as it is.
    unsafe {
        asm!(
            "fcvtl {low:v}.4s, {bits:v}.4h",
            "fcvtl2 {high:v}.4s, {bits:v}.8h",
            bits = in(vreg) bits,
            low = out(vreg) low,
            high = lateout(vreg) high,
            options(pure, nomem, nostack, preserves_flags),
        );
    }
    [low, high]
}

/// Rounds eight numbers to half precision.
#[inline(always)]
fn to_f16(low: float32x4_t, high: float32x4_t) -> uint16x8_t {
    let bits: uint16x8_t;
    // SAFETY: as in `from_f16`.
    unsafe {
        asm!(
            "fcvtn {bits:v}.4h, {low:v}.4s",
            "fcvtn2 {bits:v}.8h, {high:v}.4s",
            low = in(vreg) low,
            high = in(vreg) high,
            bits = out(vreg) bits,
            options(pure, nomem, nostack, preserves_flags),
        );
    }
    bits
}

/// Implements [`Simd::group_of_bytes`] by dot products: four inputs at a time, so two rows of pairs
/// are interleaved.
///
/// # Safety
/// The CPU has FEAT_DotProd.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
unsafe fn dot_products<'w, const P: usize, const R: usize>(
    w: impl Fn(usize, usize) -> &'w [i8; 2 * LANES],
    x: [&Group; R],
) -> [[[float32x4_t; 4]; P]; R] {
    // SAFETY: NEON is part of the target.
    let zero = unsafe { vdupq_n_s32(0) };
    let mut halves = [[zero; 2]; R].map(|_| [zero_bytes(); 2]);
    for r in 0..R {
        halves[r] = split(x[r]);
    }
    let mut highs = [[[zero; 4]; P]; R];
    let mut lows = highs;
    // Written out, because an instruction names its four inputs by a constant.
    macro_rules! four_inputs {
        ($at:literal) => {
            for p in 0..P {
                let w = quads(w(2 * $at, p), w(2 * $at + 1, p));
                for r in 0..R {
                    for q in 0..4 {
                        // SAFETY: the caller promises FEAT_DotProd.
                        unsafe {
                            sdot::<$at>(&mut highs[r][p][q], w[q], halves[r][0]);
                            sdot::<$at>(&mut lows[r][p][q], w[q], halves[r][1]);
                        }
                    }
                }
            }
        };
    }
    const { assert!(PAIRS == 8, "four times two pairs") };
    four_inputs!(0);
    four_inputs!(1);
    four_inputs!(2);
    four_inputs!(3);
    // SAFETY: NEON is part of the target.
    let whole = |high, low| unsafe { vcvtq_f32_s32(vaddq_s32(vshlq_n_s32::<7>(high), low)) };
    // SAFETY: NEON is part of the target.
    let mut sums = [[[unsafe { vdupq_n_f32(0.0) }; 4]; P]; R];
    for r in 0..R {
        for p in 0..P {
            for q in 0..4 {
                sums[r][p][q] = whole(highs[r][p][q], lows[r][p][q]);
            }
        }
    }
    sums
}

/// Returns sixteen bytes of zero.
#[inline(always)]
fn zero_bytes() -> int8x16_t {
    // SAFETY: NEON is part of the target; sixteen bytes are read of sixteen.
    unsafe { vld1q_s8([0; 16].as_ptr()) }
}

/// Splits sixteen inputs `x` into bytes `high`, from -64 to 64, and `low`, from -64 to 63, with
/// `x = 128 * high + low`; an input with more than 14 bits, which only a part that is not finite
/// has, gives any bytes.
#[inline(always)]
fn split(x: &Group) -> [int8x16_t; 2] {
    let x = x.as_flattened().as_ptr();
    // SAFETY: NEON is part of the target; both halves, of eight integers each, lie inside the group.
    unsafe {
        let (a, b) = (vld1q_s16(x), vld1q_s16(x.add(8)));
        let high = vcombine_s8(vrshrn_n_s16::<7>(a), vrshrn_n_s16::<7>(b));
        let bytes = vcombine_s8(vmovn_s16(a), vmovn_s16(b));
        [high, vshrq_n_s8::<1>(vshlq_n_s8::<1>(bytes))]
    }
}

/// Interleaves two inputs and the next two of sixteen outputs to groups of four.
#[inline(always)]
fn quads(first: &[i8; 2 * LANES], next: &[i8; 2 * LANES]) -> [int8x16_t; 4] {
    let (a, b) = (sixteens(first), sixteens(next));
    // SAFETY: NEON is part of the target.
    let zipped = |a, b| unsafe {
        let (a, b) = (vreinterpretq_s16_s8(a), vreinterpretq_s16_s8(b));
        [
            vreinterpretq_s8_s16(vzip1q_s16(a, b)),
            vreinterpretq_s8_s16(vzip2q_s16(a, b)),
        ]
    };
    let ([q0, q1], [q2, q3]) = (zipped(a[0], b[0]), zipped(a[1], b[1]));
    [q0, q1, q2, q3]
}

/// Computes `sum[i] += w[4 * i] * x[4 * AT] + ... + w[4 * i + 3] * x[4 * AT + 3]`.
///
/// # Safety
/// The CPU has FEAT_DotProd.
#[target_feature(enable = "dotprod")]
#[inline]
unsafe fn sdot<const AT: usize>(sum: &mut int32x4_t, w: int8x16_t, x: int8x16_t) {
    // SAFETY: registers alone, and the caller promises the instruction.
    unsafe {
        asm!(
            "sdot {sum:v}.4s, {w:v}.16b, {x:v}.4b[{at}]",
            sum = inout(vreg) *sum,
            w = in(vreg) w,
            x = in(vreg) x,
            at = const AT,
            options(pure, nomem, nostack, preserves_flags),
        );
    }
}
