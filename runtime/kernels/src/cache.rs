//! Layout of the key-value cache, in 32 bits, in 16 or in 8.
//!
//! Keys are stored in blocks of sixteen tokens, each block transposed,
//! `[capacity / 16][width][16]`, the last block a whole one; values are stored one contiguous row
//! per token, `[capacity][width]`. Both are written once per token, by [`Append`], and read by
//! [`Attention`](crate::Attention) in every later control step; with half precision they take half
//! the memory and half the time to read, as integers a quarter, and are decoded in registers.
//! Integers have a scale for each row and head, `[heads][capacity / 16][16]`. Sums are always 32-bit
//! floats.
//!
//! Nothing here can fail: rows beyond a cache's last block are not written, and a number that the format
//! cannot hold makes infinite or NaN what is computed from it, which the controller refuses to send
//! to motors.

use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
use crate::integers::scales_of;
use crate::lanes::{Block, LANES};
use crate::simd::Simd;
use crate::stored::{self, F16, F32, INT8_LARGEST, Int8, Stored};

/// Storage format of the elements of a cache.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum CacheFormat {
    /// IEEE 754 single precision, without rounding.
    #[default]
    F32,
    /// IEEE 754 half precision, rounded to the nearest number of 11 bits.
    F16,
    /// 8-bit integers -127 to 127, with a 32-bit float as scale for each row and head: the largest
    /// magnitude becomes 127, the others the nearest integers.
    Int8,
}

impl CacheFormat {
    /// All cache formats, the most exact first.
    pub const ALL: [Self; 3] = [Self::F32, Self::F16, Self::Int8];

    /// Returns the size of an element in bytes.
    pub const fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 => 2,
            Self::Int8 => 1,
        }
    }

    /// Returns the name of the format: `f32`, `f16` or `int8`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Int8 => "int8",
        }
    }

    /// Returns the number of elements in four bytes.
    pub const fn per_word(self) -> usize {
        size_of::<f32>() / self.bytes()
    }

    /// Returns the number of 4-byte words of the keys and of the values of a cache of `capacity`
    /// rows of `heads` heads, elements and scales; `None` beyond the address space.
    pub fn words(self, capacity: usize, [heads, head_dim]: [usize; 2]) -> Option<[usize; 2]> {
        let width = heads.checked_mul(head_dim)?;
        let rows = capacity.checked_next_multiple_of(LANES)?;
        let words = |rows: usize| {
            let elements = rows.checked_mul(width)?.div_ceil(self.per_word());
            elements.checked_add(self.scales(capacity, heads))
        };
        Some([words(rows)?, words(capacity)?])
    }

    /// Returns the number of scales of the keys of a cache, and of its values.
    pub const fn scales(self, capacity: usize, heads: usize) -> usize {
        match self {
            Self::F32 | Self::F16 => 0,
            Self::Int8 => keys_len(capacity, heads),
        }
    }
}

/// Integers with their scales, to read.
#[derive(Debug, Clone, Copy)]
pub struct Scaled<'c> {
    /// The elements.
    pub integers: &'c [i8],
    /// Scale of each row and head, `[heads][capacity / 16][16]`.
    pub scales: &'c [f32],
}

/// Integers with their scales, to write.
#[derive(Debug)]
pub struct ScaledMut<'c> {
    /// The elements.
    pub integers: &'c mut [i8],
    /// Scale of each row and head, `[heads][capacity / 16][16]`.
    pub scales: &'c mut [f32],
}

/// A key-value cache to read: keys, [`keys_len`] elements, and values, `[capacity, width]`.
#[derive(Debug, Clone, Copy)]
pub enum Cache<'c> {
    /// A cache in [`CacheFormat::F32`].
    F32 {
        /// Keys, [`keys_len`] elements.
        keys: &'c [f32],
        /// Values, `[capacity, width]`.
        values: &'c [f32],
    },
    /// A cache in [`CacheFormat::F16`].
    F16 {
        /// Keys, [`keys_len`] elements.
        keys: &'c [u16],
        /// Values, `[capacity, width]`.
        values: &'c [u16],
    },
    /// A cache in [`CacheFormat::Int8`].
    Int8 {
        /// Keys, [`keys_len`] elements.
        keys: Scaled<'c>,
        /// Values, `[capacity, width]`.
        values: Scaled<'c>,
    },
}

/// A key-value cache to write.
#[derive(Debug)]
pub enum CacheMut<'c> {
    /// A cache in [`CacheFormat::F32`].
    F32 {
        /// Keys, [`keys_len`] elements.
        keys: &'c mut [f32],
        /// Values, `[capacity, width]`.
        values: &'c mut [f32],
    },
    /// A cache in [`CacheFormat::F16`].
    F16 {
        /// Keys, [`keys_len`] elements.
        keys: &'c mut [u16],
        /// Values, `[capacity, width]`.
        values: &'c mut [u16],
    },
    /// A cache in [`CacheFormat::Int8`].
    Int8 {
        /// Keys, [`keys_len`] elements.
        keys: ScaledMut<'c>,
        /// Values, `[capacity, width]`.
        values: ScaledMut<'c>,
    },
}

impl CacheMut<'_> {
    /// Borrows the cache for reading.
    pub fn as_ref(&self) -> Cache<'_> {
        match self {
            Self::F32 { keys, values } => Cache::F32 { keys, values },
            Self::F16 { keys, values } => Cache::F16 { keys, values },
            Self::Int8 { keys, values } => Cache::Int8 {
                keys: keys.as_ref(),
                values: values.as_ref(),
            },
        }
    }
}

impl ScaledMut<'_> {
    fn as_ref(&self) -> Scaled<'_> {
        Scaled {
            integers: self.integers,
            scales: self.scales,
        }
    }
}

/// A format that a cache may have.
pub(crate) trait Cached: Stored<Bits: Copy> {
    /// Decodes one stored number, but for its scale.
    fn number(bits: Self::Bits) -> f32;
}

impl Cached for F32 {
    #[inline(always)]
    fn number(bits: f32) -> f32 {
        bits
    }
}

impl Cached for F16 {
    #[inline(always)]
    fn number(bits: u16) -> f32 {
        stored::from_f16(bits)
    }
}

impl Cached for Int8 {
    #[inline(always)]
    fn number(bits: i8) -> f32 {
        bits.into()
    }
}

/// Returns the number of elements of the keys of a cache of `capacity` rows, the last block a whole
/// one.
pub const fn keys_len(capacity: usize, width: usize) -> usize {
    capacity.next_multiple_of(LANES).saturating_mul(width)
}

/// Keys and values of new tokens, one row each.
#[derive(Debug, Clone, Copy)]
pub struct Append<'x> {
    /// Keys of the first token; each later token's keys start `k_stride` elements further.
    pub k: &'x [f32],
    /// Elements from one token's keys to the next, at least `width`.
    pub k_stride: usize,
    /// Values of the first token; each later token's values start `v_stride` elements further.
    pub v: &'x [f32],
    /// Elements from one token's values to the next, at least `width`.
    pub v_stride: usize,
    /// Number of elements of a row.
    pub width: usize,
    /// Number of heads that share a row.
    pub heads: usize,
    /// Row of the cache for the first token.
    pub first: usize,
}

impl Append<'_> {
    /// Writes the keys and values of the new tokens to the cache.
    pub fn run(&self, isa: Isa, cache: &mut CacheMut) {
        match cache {
            CacheMut::F32 { keys, values } => self.copy(keys, values),
            CacheMut::F16 { keys, values } => {
                if cfg!(feature = "half-cache") {
                    isa.run(Rounded {
                        append: self,
                        keys,
                        values,
                    });
                }
            }
            CacheMut::Int8 { keys, values } => {
                if cfg!(feature = "integer-cache") {
                    let append = self;
                    isa.run(Quantised {
                        append,
                        keys,
                        values,
                    });
                }
            }
        }
    }

    /// Copies keys and values row by row.
    fn copy(&self, keys: &mut [f32], values: &mut [f32]) {
        let width = self.width.max(1);
        let rows = values.chunks_exact_mut(width).skip(self.first);
        for (row, x) in rows.zip(self.v.chunks(self.v_stride.max(1))) {
            assign(row, x);
        }
        for (row, x) in (self.first..).zip(self.k.chunks(self.k_stride.max(1))) {
            let first = (row / LANES).saturating_mul(width).saturating_mul(LANES) + row % LANES;
            let keys = keys.get_mut(first..).unwrap_or(&mut []);
            for (to, &x) in keys.iter_mut().step_by(LANES).zip(x.iter().take(width)) {
                *to = x;
            }
        }
    }

    /// Rounds keys and values to half precision row by row, sixteen elements at a time.
    #[inline(always)]
    fn round<S: Simd>(&self, simd: S, keys: &mut [u16], values: &mut [u16]) {
        let width = self.width.max(1);
        let rows = values
            .get_mut(self.first * width..)
            .unwrap_or(&mut [])
            .chunks_exact_mut(width);
        for (row, x) in rows.zip(self.v.chunks(self.v_stride.max(1))) {
            for (row, x) in row.chunks_mut(LANES).zip(x.chunks(LANES)) {
                let bits = simd.round_to_f16(simd.load(&block(x)));
                row.iter_mut().zip(bits).for_each(|(to, bits)| *to = bits);
            }
        }
        for (row, x) in (self.first..).zip(self.k.chunks(self.k_stride.max(1))) {
            let block_of_keys = keys
                .chunks_exact_mut(width.saturating_mul(LANES).max(1))
                .nth(row / LANES);
            let (lines, _) = block_of_keys.unwrap_or(&mut []).as_chunks_mut::<LANES>();
            for (lines, x) in lines.chunks_mut(LANES).zip(x.chunks(LANES)) {
                let bits = simd.round_to_f16(simd.load(&block(x)));
                for (line, bits) in lines.iter_mut().zip(bits) {
                    if let Some(to) = line.get_mut(row % LANES) {
                        *to = bits;
                    }
                }
            }
        }
    }
}

/// Returns sixteen elements; missing ones are zero.
#[inline(always)]
fn block(x: &[f32]) -> Block {
    let mut block = [0.0; LANES];
    assign(&mut block, x);
    block
}

/// Kernel that quantises numbers to 8 bits, head by head.
struct Quantised<'a, 'c> {
    append: &'a Append<'a>,
    keys: &'a mut ScaledMut<'c>,
    values: &'a mut ScaledMut<'c>,
}

impl Kernel for Quantised<'_, '_> {
    // A row or two in a step.
    const BRIEF: bool = true;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Append {
            k,
            k_stride,
            v,
            v_stride,
            width,
            heads,
            first,
        } = *self.append;
        let head_dim = width.checked_div(heads).unwrap_or(0).max(1);
        let rows = self.keys.scales.len().checked_div(heads).unwrap_or(0);
        let tokens = k.chunks(k_stride.max(1)).zip(v.chunks(v_stride.max(1)));
        for (row, (k, v)) in (first..rows).zip(tokens) {
            // Beyond the heads lies what is between a row and the next.
            let of_heads = k.chunks_exact(head_dim).zip(v.chunks_exact(head_dim));
            for (head, (k, v)) in of_heads.take(heads).enumerate() {
                let (column, scale) = (head * head_dim, head * rows + row);
                let key = (row / LANES * width + column) * LANES + row % LANES;
                let value = row * width + column;
                // A loop, so that its long body is compiled once.
                let both = [
                    (&mut *self.keys, k, [key, LANES]),
                    (&mut *self.values, v, [value, 1]),
                ];
                for (to, x, places) in both {
                    to.set(simd, x, places, scale);
                }
            }
        }
    }
}

impl ScaledMut<'_> {
    /// Writes the elements of a head, from position `first` on, `step` apart, and their scale.
    #[inline(always)]
    fn set<S: Simd>(&mut self, simd: S, x: &[f32], [first, step]: [usize; 2], scale: usize) {
        let (blocks, rest) = x.as_chunks::<LANES>();
        let last = block(rest);
        let (per_number, per_unit) = scales_of(simd, blocks, &last, INT8_LARGEST);
        let per_number = simd.splat(per_number);
        let whole = blocks.len() * LANES;
        let all = blocks.iter().chain([&last]);
        for (from, block) in (0..x.len()).step_by(LANES).zip(all) {
            let integers = simd.whole(simd.mul(simd.load(block), per_number));
            let len = if from < whole { LANES } else { rest.len() };
            self.put(
                first + from * step,
                step,
                integers.get(..len).unwrap_or(&[]),
            );
        }
        if let Some(to) = self.scales.get_mut(scale) {
            *to = per_unit;
        }
    }

    /// Writes elements from position `first` on, `step` apart, in code that all instruction sets share.
    #[inline(never)]
    fn put(&mut self, first: usize, step: usize, from: &[i16]) {
        let to = self.integers.get_mut(first..).unwrap_or(&mut []);
        for (to, &integer) in to.iter_mut().step_by(step.max(1)).zip(from) {
            *to = integer as i8;
        }
    }
}

/// Kernel that rounds numbers to half precision.
struct Rounded<'a> {
    append: &'a Append<'a>,
    keys: &'a mut [u16],
    values: &'a mut [u16],
}

impl Kernel for Rounded<'_> {
    // A row or two in a step.
    const BRIEF: bool = true;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.append.round(simd, self.keys, self.values);
    }
}
