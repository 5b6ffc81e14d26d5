//! Images as 16-bit integers, one scale for all pixels and channels, for convolutions with integer weights.
//!
//! ```text
//! largest = the largest magnitude of the image;  scale = largest / 16383;  y = x / scale, to the nearest
//! ```
//!
//! A number differs by half a unit: 2^-15 of the largest magnitude. If the image contains infinity or NaN, the scale is NaN, and so
//! is every output; an image whose magnitudes are all below 2^-100 is read as zero.

use crate::conv::Sweep;
use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
use crate::integers::scales;
use crate::lanes::LANES;
use crate::linear::INTEGERS;
use crate::simd::Simd;

/// Largest magnitude of an input as an integer.
const LARGEST: f32 = 16383.0;

/// Conversion of an image to integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageIntegers {
    /// Number of rows and columns.
    pub size: [usize; 2],
    /// Number of channels.
    pub c: usize,
    /// Strides of the image, in elements: from a row to the next, then from a pixel to the next.
    pub x_strides: [usize; 2],
}

impl ImageIntegers {
    /// Writes the integers of the image `x`, row after row, and zeros behind them, to `y`, and returns
    /// the value of an input per unit of its integer. If a view is too short, `y` is unchanged and
    /// the result NaN.
    pub fn run(&self, isa: Isa, x: &[f32], y: &mut [i16]) -> f32 {
        let one = Sweep {
            out: self.size,
            kernel: [1; 2],
            stride: [1; 2],
            dilation: [1; 2],
            x_strides: self.x_strides,
            y_strides: [0; 2],
        };
        let there = one.reach(self.c).is_some_and(|reach| reach <= x.len());
        let [rows, cols] = self.size;
        let len = (rows.checked_mul(cols)).and_then(|pixels| pixels.checked_mul(self.c));
        let mut scale = f32::NAN;
        if INTEGERS && there && len.is_some_and(|len| 0 < len && len <= y.len()) {
            isa.run(Converted {
                lines: Lines::of(self),
                x,
                y,
                scale: &mut scale,
            });
        }
        scale
    }
}

/// Numbers that lie one after the other: two nested counts, their distances, and the length of a
/// line.
#[derive(Clone, Copy)]
struct Lines {
    times: [usize; 2],
    apart: [usize; 2],
    len: usize,
}

impl Lines {
    fn of(image: &ImageIntegers) -> Self {
        let ([rows, cols], [down, along]) = (image.size, image.x_strides);
        let (times, len) = if cols > 1 && along != image.c {
            ([rows, cols], image.c)
        } else if rows > 1 && down != cols * image.c {
            ([rows, 1], cols * image.c)
        } else {
            ([1, 1], rows * cols * image.c)
        };
        Self {
            times,
            apart: [down, along],
            len,
        }
    }

    /// Returns line `[row, column]` of `x`.
    #[inline(always)]
    fn get(self, x: &[f32], [row, col]: [usize; 2]) -> &[f32] {
        let first = row * self.apart[0] + col * self.apart[1];
        x.get(first..first + self.len).unwrap_or(&[])
    }
}

/// Operands of a running conversion; `x` and `y` are long enough.
struct Converted<'a> {
    lines: Lines,
    x: &'a [f32],
    y: &'a mut [i16],
    scale: &'a mut f32,
}

impl Kernel for Converted<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let [rows, cols] = self.lines.times;
        let mut largest = [simd.zeros(); 4];
        for row in 0..rows {
            for col in 0..cols {
                let (fours, rest) = self.lines.get(self.x, [row, col]).as_chunks::<LANES>();
                let (fours, blocks) = fours.as_chunks::<4>();
                for four in fours {
                    for (largest, x) in largest.iter_mut().zip(four) {
                        *largest = simd.larger(*largest, simd.load(x));
                    }
                }
                let [first, ..] = &mut largest;
                for x in blocks {
                    *first = simd.larger(*first, simd.load(x));
                }
                if !rest.is_empty() {
                    let mut last = [0.0; LANES];
                    assign(&mut last, rest);
                    *first = simd.larger(*first, simd.load(&last));
                }
            }
        }
        let [a, b, c, d] = largest.map(|largest| simd.largest(largest));
        let (inverse, scale) = scales(a.max(b).max(c.max(d)), LARGEST);
        *self.scale = scale;
        let inverse = simd.splat(inverse);
        let mut y = self.y;
        for row in 0..rows {
            for col in 0..cols {
                let line = self.lines.get(self.x, [row, col]);
                let Some((to, others)) = y.split_at_mut_checked(line.len()) else {
                    return;
                };
                y = others;
                let (blocks, rest) = line.as_chunks::<LANES>();
                let (to, to_rest) = to.as_chunks_mut::<LANES>();
                for (to, x) in to.iter_mut().zip(blocks) {
                    *to = simd.whole(simd.mul(simd.load(x), inverse));
                }
                if !rest.is_empty() {
                    let mut last = [0.0; LANES];
                    assign(&mut last, rest);
                    let last = simd.whole(simd.mul(simd.load(&last), inverse));
                    for (to, x) in to_rest.iter_mut().zip(last) {
                        *to = x;
                    }
                }
            }
        }
        y.fill(0);
    }
}
