//! Storage formats of weights: 32-bit floats, shorter ones that are decoded in registers while they
//! are read, or integers, with which the inputs of a layer become integers too (see `integers`).
//!
//! | format | bits | error of a weight | error of an input |
//! |---|---|---|---|
//! | `F32` | 32 | none | none |
//! | `Int16` | 16, and one `f32` scale per output | half of the scale: the output's largest weight / 32766 | the largest of 256 inputs / 16382 |
//! | `F16` | 16 | half a unit of 11 bits (relative 2^-11), or 2^-25 below 2^-14; magnitudes up to 65504 | none |
//! | `Bf16` | 16 | half a unit of 8 bits (relative 2^-8) | none |
//! | `Int8` | 8, and one `f32` scale per output | half of the scale: the output's largest weight / 254 | the largest of 256 inputs / 16382 |
//!
//! Convolutions have `F32`, `Int16` and `Int8` weights, and all inputs of an image one step: the
//! errors are in `image_integers` and `conv_integers`.
//!
//! Conversions round to the nearest, ties to even, and are exact the other way, so every
//! instruction set decodes the same bits. Encoding is done offline and can fail: [`to_f16`] returns
//! `None` for numbers that are too large.

use crate::lanes::{Block, LANES};
use crate::simd::Simd;

/// Storage format of the weights of a dense layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum WeightFormat {
    /// IEEE 754 single precision.
    #[default]
    F32,
    /// IEEE 754 half precision.
    F16,
    /// Brain float, the upper half of single precision.
    Bf16,
    /// Integers from -127 to 127, times a scale per output.
    Int8,
    /// Integers from -16383 to 16383, times a scale per output.
    Int16,
}

impl WeightFormat {
    /// All weight formats, the most exact first.
    pub const ALL: [Self; 5] = [Self::F32, Self::Int16, Self::F16, Self::Bf16, Self::Int8];

    /// Returns the size of a weight in bytes.
    pub const fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 | Self::Bf16 | Self::Int16 => 2,
            Self::Int8 => 1,
        }
    }

    /// Returns whether weights are integers, times a scale per output.
    pub const fn is_scaled(self) -> bool {
        matches!(self, Self::Int8 | Self::Int16)
    }

    /// Returns the name of the format: `f32`, `int16`, `f16`, `bf16` or `int8`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
            Self::Int8 => "int8",
            Self::Int16 => "int16",
        }
    }
}

/// Weights of a dense layer in panels, as [`pack`](crate::pack) orders them.
#[derive(Debug, Clone, Copy)]
pub enum Panels<'w> {
    /// Weights in [`WeightFormat::F32`].
    F32(&'w [f32]),
    /// Weights in [`WeightFormat::F16`].
    F16(&'w [u16]),
    /// Weights in [`WeightFormat::Bf16`].
    Bf16(&'w [u16]),
    /// Weights in [`WeightFormat::Int8`].
    Int8 {
        /// Integers of the panels.
        panels: &'w [i8],
        /// Factor of each output's sum, `[n]`.
        scales: &'w [f32],
    },
    /// Weights in [`WeightFormat::Int16`].
    Int16 {
        /// Integers of the panels.
        panels: &'w [i16],
        /// Factor of each output's sum, `[n]`.
        scales: &'w [f32],
    },
}

/// A float format that decodes sixteen stored weights to a vector.
pub(crate) trait Stored {
    /// One weight in its stored form.
    type Bits;
    /// Decodes sixteen weights.
    fn load<S: Simd>(simd: S, from: &[Self::Bits; LANES]) -> S::V;
}

pub(crate) struct F32;
pub(crate) struct F16;
pub(crate) struct Bf16;
/// Integers that are read as floats; their scale is applied elsewhere.
pub(crate) struct Int8;

impl Stored for F32 {
    type Bits = f32;
    #[inline(always)]
    fn load<S: Simd>(simd: S, from: &Block) -> S::V {
        simd.load(from)
    }
}

impl Stored for F16 {
    type Bits = u16;
    #[inline(always)]
    fn load<S: Simd>(simd: S, from: &[u16; LANES]) -> S::V {
        simd.load_f16(from)
    }
}

impl Stored for Bf16 {
    type Bits = u16;
    #[inline(always)]
    fn load<S: Simd>(simd: S, from: &[u16; LANES]) -> S::V {
        simd.load_bf16(from)
    }
}

impl Stored for Int8 {
    type Bits = i8;
    #[inline(always)]
    fn load<S: Simd>(simd: S, from: &[i8; LANES]) -> S::V {
        simd.load_bytes(from)
    }
}

/// Decodes a half-precision number; exact. It uses integer arithmetic, and one subtraction of
/// normal numbers for those below the normal range, so that the result does not depend on how the
/// processor treats subnormal numbers.
#[inline(always)]
pub fn from_f16(bits: u16) -> f32 {
    // What the exponents' biases, 127 and 15, differ by, and the exponent 2^-14 of the smallest normal number.
    const REBIAS: u32 = (127 - 15) << 23;
    const SMALLEST: u32 = (127 - 14) << 23;
    let magnitude = u32::from(bits & 0x7fff) << 13;
    let normal = magnitude + REBIAS;
    let subnormal = (f32::from_bits(magnitude + SMALLEST) - f32::from_bits(SMALLEST)).to_bits();
    // Infinity and what is not a number keep an exponent of ones.
    let special = magnitude + 2 * REBIAS;
    // Selections of computed numbers, so that compilers vectorise loops over this.
    let found = if magnitude < 1 << 23 {
        subnormal
    } else {
        normal
    };
    let found = if magnitude >= 31 << 23 {
        special
    } else {
        found
    };
    f32::from_bits(found | u32::from(bits & 0x8000) << 16)
}

/// Decodes sixteen half-precision numbers; compiled once, because the code is long and a call is
/// not.
#[inline(never)]
pub(crate) fn all_from_f16(bits: &[u16; LANES]) -> Block {
    bits.map(from_f16)
}

/// Rounds to the nearest half-precision number, ties to even; infinite from 65520 on, the midpoint
/// between 65504 and the next number.
#[inline(always)]
pub fn round_to_f16(x: f32) -> u16 {
    const INFINITE: u32 = 0x7c00;
    const SMALLEST: f32 = f32::from_bits((127 - 14) << 23);
    let sign = (x.to_bits() >> 16) as u16 & 0x8000;
    let magnitude = x.abs();
    let bits = magnitude.to_bits();
    // Steps of 2^-24: adding 0.5, whose last place has that value, rounds there.
    let subnormal = (magnitude + 0.5).to_bits().wrapping_sub(0.5_f32.to_bits());
    // Half a unit of what is dropped, less one where the kept part is even; the carry may go into the exponent.
    let rounded = bits.wrapping_add(0xfff + (bits >> 13 & 1));
    let normal = rounded.wrapping_sub((127 - 15) << 23) >> 13;
    // Selections of computed numbers, so that compilers vectorise loops over this.
    let found = if magnitude < SMALLEST {
        subnormal
    } else {
        normal
    };
    let found = if magnitude < 65520.0 { found } else { INFINITE };
    // As processors do: quiet, with what fits of its payload.
    let found = if magnitude.is_nan() {
        INFINITE | 0x200 | bits >> 13 & 0x1ff
    } else {
        found
    };
    sign | found as u16
}

/// Rounds sixteen numbers to half precision; compiled once, because the code is long and a control
/// step needs it for the new tokens only.
#[inline(never)]
pub(crate) fn round_all_to_f16(x: &Block) -> [u16; LANES] {
    x.map(round_to_f16)
}

/// Rounds to the nearest half-precision number, ties to even; `None` if `x` is not finite or rounds
/// to infinity.
pub fn to_f16(x: f32) -> Option<u16> {
    (x.abs() < 65520.0).then(|| round_to_f16(x))
}

/// Decodes a brain float; exact.
#[inline(always)]
pub fn from_bf16(bits: u16) -> f32 {
    f32::from_bits(u32::from(bits) << 16)
}

/// Rounds to the nearest brain float, ties to even; `None` if `x` is not finite or rounds to
/// infinity.
pub fn to_bf16(x: f32) -> Option<u16> {
    let bits = x.to_bits();
    let rounded = bits.checked_add(0x7fff + (bits >> 16 & 1))? >> 16;
    (x.is_finite() && rounded & 0x7f80 != 0x7f80).then_some(rounded as u16)
}

/// Largest quantised `Int16` magnitude.
const INT16_LARGEST: f32 = 16383.0;

/// Largest quantised `Int8` magnitude.
pub(crate) const INT8_LARGEST: f32 = 127.0;

/// Returns the scale of one output's weights in `Int8`: their largest magnitude / 127; 1 if all are
/// zero.
pub fn int8_scale(weights: impl Iterator<Item = f32>) -> f32 {
    scale(weights, INT8_LARGEST)
}

/// Returns the scale of one output's weights in `Int16`: their largest magnitude / 16383; 1 if all
/// are zero.
pub fn int16_scale(weights: impl Iterator<Item = f32>) -> f32 {
    scale(weights, INT16_LARGEST)
}

fn scale(weights: impl Iterator<Item = f32>, steps: f32) -> f32 {
    let largest = weights.fold(0.0, |largest: f32, w| largest.max(w.abs()));
    // A scale below the normal numbers would lose digits, and be flushed in a control step.
    if largest / steps < f32::MIN_POSITIVE {
        1.0
    } else {
        largest / steps
    }
}

/// Quantises a weight to the nearest multiple of the scale, ties to even; between -127 and 127.
pub fn to_int8(x: f32, scale: f32) -> i8 {
    libm::rintf(x / scale).clamp(-INT8_LARGEST, INT8_LARGEST) as i8
}

/// Quantises a weight to the nearest multiple of the scale, ties to even; between -16383 and 16383.
pub fn to_int16(x: f32, scale: f32) -> i16 {
    libm::rintf(x / scale).clamp(-INT16_LARGEST, INT16_LARGEST) as i16
}
