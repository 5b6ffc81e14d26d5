//! Layout of the key-value cache, in 32 bits or in 16.
//!
//! Keys are stored in blocks of sixteen tokens, each block transposed,
//! `[capacity / 16][width][16]`, the last block a whole one; values are stored one contiguous row
//! per token, `[capacity][width]`. Both are written once per token, by [`Append`], and read by
//! [`Attention`](crate::Attention) in every later control step; with half precision they take half
//! the memory and half the time to read, and are decoded in registers. Sums are always 32-bit
//! floats.
//!
//! Nothing here can fail: rows beyond a cache's end are not written, and a number that half
//! precision cannot hold becomes infinite (and results computed from it are not finite, which the
//! controller refuses to send to motors).

use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
use crate::lanes::{Block, LANES};
use crate::simd::{Portable, Simd};
use crate::stored::{self, F16, F32, Stored};

/// Storage format of the elements of a cache.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum CacheFormat {
    /// IEEE 754 single precision, without rounding.
    #[default]
    F32,
    /// IEEE 754 half precision, rounded to the nearest number of 11 bits.
    F16,
}

impl CacheFormat {
    /// All cache formats, the most exact first.
    pub const ALL: [Self; 2] = [Self::F32, Self::F16];

    /// Returns the size of an element in bytes.
    pub const fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 => 2,
        }
    }

    /// Returns the name of the format: `f32` or `f16`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
        }
    }

    /// Returns the number of elements in four bytes.
    pub const fn per_word(self) -> usize {
        match self {
            Self::F32 => 1,
            Self::F16 => 2,
        }
    }

    /// Returns the number of 4-byte words that `elements` elements take.
    pub const fn words(self, elements: usize) -> usize {
        elements.div_ceil(self.per_word())
    }
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
}

impl CacheMut<'_> {
    /// Borrows the cache for reading.
    pub fn as_ref(&self) -> Cache<'_> {
        match self {
            Self::F32 { keys, values } => Cache::F32 { keys, values },
            Self::F16 { keys, values } => Cache::F16 { keys, values },
        }
    }
}

/// A format that a cache may have.
pub(crate) trait Cached: Stored<Bits: Copy> {
    /// Converts sixteen numbers to the stored format.
    fn stored<S: Simd>(simd: S, from: &Block) -> [Self::Bits; LANES];
    /// Decodes one stored number.
    fn number(bits: Self::Bits) -> f32;
}

impl Cached for F32 {
    #[inline(always)]
    fn stored<S: Simd>(_: S, from: &Block) -> Block {
        *from
    }
    #[inline(always)]
    fn number(bits: f32) -> f32 {
        bits
    }
}

impl Cached for F16 {
    #[inline(always)]
    fn stored<S: Simd>(simd: S, from: &Block) -> [u16; LANES] {
        simd.round_to_f16(simd.load(from))
    }
    #[inline(always)]
    fn number(bits: u16) -> f32 {
        stored::from_f16(bits)
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
    /// Row of the cache for the first token.
    pub first: usize,
}

impl Append<'_> {
    /// Writes the keys and values of the new tokens to the cache.
    pub fn run(&self, isa: Isa, cache: &mut CacheMut) {
        match cache {
            // A mere copy.
            CacheMut::F32 { keys, values } => self.write::<F32, _>(Portable, keys, values),
            CacheMut::F16 { keys, values } => {
                if cfg!(feature = "half-cache") {
                    isa.run(Rounded {
                        append: self,
                        keys,
                        values,
                    });
                }
            }
        }
    }

    /// Writes keys and values row by row, sixteen elements at a time.
    #[inline(always)]
    fn write<C: Cached, S: Simd>(&self, simd: S, keys: &mut [C::Bits], values: &mut [C::Bits]) {
        let width = self.width.max(1);
        let rows = values
            .get_mut(self.first * width..)
            .unwrap_or(&mut [])
            .chunks_exact_mut(width);
        for (row, x) in rows.zip(self.v.chunks(self.v_stride.max(1))) {
            for (row, x) in row.chunks_mut(LANES).zip(x.chunks(LANES)) {
                let bits = C::stored(simd, &block(x));
                row.iter_mut().zip(bits).for_each(|(to, bits)| *to = bits);
            }
        }
        for (row, x) in (self.first..).zip(self.k.chunks(self.k_stride.max(1))) {
            let block_of_keys = keys
                .chunks_exact_mut(width.saturating_mul(LANES).max(1))
                .nth(row / LANES);
            let (lines, _) = block_of_keys.unwrap_or(&mut []).as_chunks_mut::<LANES>();
            for (lines, x) in lines.chunks_mut(LANES).zip(x.chunks(LANES)) {
                let bits = C::stored(simd, &block(x));
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

/// Kernel that rounds numbers to half precision.
struct Rounded<'a> {
    append: &'a Append<'a>,
    keys: &'a mut [u16],
    values: &'a mut [u16],
}

impl Kernel for Rounded<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.append.write::<F16, S>(simd, self.keys, self.values);
    }
}
