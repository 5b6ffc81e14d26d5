//! Pooling: maximum and mean of windows of an image `[rows, columns, channels]`.
//!
//! ```text
//! for each output pixel:  y[c] = max or sum over the window's pixels inside the image of x[pixel][c]; a sum is divided by their number,
//!                         or by that of the window's pixels inside image and padding
//! ```
//!
//! Windows are cut at the edge, so `x` needs no border. Each output is one chain in the order of the window's rows and columns; an
//! output whose window lies outside the image as a whole is negative infinity, or zero.

use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
use crate::math;
use crate::simd::Simd;

/// Function of the elements of a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoolKind {
    /// Largest element; NaN if any element is NaN.
    Max,
    /// Mean of the elements inside the image.
    Mean,
    /// Sum of the elements inside the image, divided by the number of the window's pixels inside
    /// image and padding.
    PaddedMean,
}

/// Pooling of windows over an image. Sizes are given for rows, then columns; strides are elements
/// from a row to the next, then from a pixel to the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pool {
    /// Function to compute.
    pub kind: PoolKind,
    /// Number of input pixels.
    pub size: [usize; 2],
    /// Number of output pixels.
    pub out: [usize; 2],
    /// Number of channels.
    pub c: usize,
    /// Size of the window.
    pub kernel: [usize; 2],
    /// Input pixels from one window to the next.
    pub stride: [usize; 2],
    /// Input pixels from one element of a window to the next.
    pub dilation: [usize; 2],
    /// Padding: rows above the image, columns left of it.
    pub before: [usize; 2],
    /// Padding: rows below the image, columns right of it.
    pub after: [usize; 2],
    /// Strides of the input, in elements.
    pub x_strides: [usize; 2],
    /// Strides of the output, in elements.
    pub y_strides: [usize; 2],
}

/// One axis of a window: its first element inside the image, the number inside, and the number
/// inside image and padding.
struct Cut {
    first: usize,
    inside: usize,
    padded: usize,
}

impl Pool {
    /// Computes `y` from `x`, both starting at their first pixel.
    pub fn run(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        isa.run(Windows { pool: self, x, y });
    }

    #[inline(always)]
    #[expect(
        clippy::indexing_slicing,
        reason = "arrays of two, one for each axis, whose index is written out"
    )]
    fn cut(&self, axis: usize, output: usize) -> Cut {
        let step = self.dilation[axis].max(1);
        // From the padding's first element.
        let start = output * self.stride[axis];
        let (image, padded) = (
            self.before[axis] + self.size[axis],
            self.before[axis] + self.size[axis] + self.after[axis],
        );
        let elements = |end: usize| {
            let until = end.saturating_sub(start).div_ceil(step);
            until.min(self.kernel[axis])
        };
        let skipped = elements(self.before[axis]);
        Cut {
            first: (start + skipped * step).saturating_sub(self.before[axis]),
            inside: elements(image) - skipped,
            padded: elements(padded),
        }
    }
}

/// Operands of a running pooling.
struct Windows<'a> {
    pool: &'a Pool,
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Kernel for Windows<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let pool = self.pool;
        for row in 0..pool.out[0] {
            let down = pool.cut(0, row);
            for col in 0..pool.out[1] {
                let right = pool.cut(1, col);
                let at = row * pool.y_strides[0] + col * pool.y_strides[1];
                let y = self.y.get_mut(at..at + pool.c).unwrap_or(&mut []);
                match pool.kind {
                    PoolKind::Max => {
                        pool.window(self.x, [&down, &right], y, f32::NEG_INFINITY, math::max);
                    }
                    PoolKind::Mean | PoolKind::PaddedMean => {
                        pool.window(self.x, [&down, &right], y, 0.0, |a, b| a + b);
                        let count = if pool.kind == PoolKind::Mean {
                            down.inside * right.inside
                        } else {
                            down.padded * right.padded
                        };
                        let count = count.max(1) as f32;
                        for y in y {
                            *y /= count;
                        }
                    }
                }
            }
        }
    }
}

impl Pool {
    /// Combines the pixels of a window, starting at the first.
    #[inline(always)]
    fn window(
        &self,
        x: &[f32],
        [down, right]: [&Cut; 2],
        y: &mut [f32],
        nothing: f32,
        combine: impl Fn(f32, f32) -> f32,
    ) {
        let mut empty = true;
        for i in 0..down.inside {
            for j in 0..right.inside {
                let row = (down.first + i * self.dilation[0]) * self.x_strides[0];
                let at = row + (right.first + j * self.dilation[1]) * self.x_strides[1];
                let x = x.get(at..at + self.c).unwrap_or(&[]);
                if empty {
                    assign(y, x);
                } else {
                    for (y, &x) in y.iter_mut().zip(x) {
                        *y = combine(*y, x);
                    }
                }
                empty = false;
            }
        }
        if empty {
            y.fill(nothing);
        }
    }
}
