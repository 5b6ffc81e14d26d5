//! Resizes an image `[rows, columns, channels]`: each output pixel is a mix of two rows and two
//! columns of the input.
//!
//! ```text
//! y[i][j] = mix(mix(x[r0][c0], x[r0][c1], wc), mix(x[r1][c0], x[r1][c1], wc), wr),  mix(a, b, w) = a + (b - a) * w
//! ```
//!
//! The rows and columns, and the weight of the second, are in tables that were made offline: the
//! nearest pixel is a mix with weight 0. Coordinates beyond the image are those of its last pixel,
//! so no table can cause a read elsewhere.

use crate::dispatch::{Isa, Kernel};
use crate::simd::Simd;

/// Numbers of a table for each row or column of the output: first input, second input, weight of
/// the second.
pub(crate) const TABLE_WIDTH: usize = 3;

/// Resizing of an image by tables. Sizes are given for rows, then columns; strides are elements
/// from a row to the next, then from a pixel to the next.
#[derive(Debug, Clone, Copy)]
pub struct Resize<'w> {
    /// Number of input pixels.
    pub size: [usize; 2],
    /// Number of channels.
    pub c: usize,
    /// Table `[output rows, 3]`: first row, second row, weight of the second.
    pub rows: &'w [f32],
    /// Table `[output columns, 3]`: first column, second column, weight of the second.
    pub cols: &'w [f32],
    /// Strides of the input, in elements.
    pub x_strides: [usize; 2],
    /// Strides of the output, in elements.
    pub y_strides: [usize; 2],
}

impl Resize<'_> {
    /// Computes `y` from `x`, both starting at their first pixel.
    pub fn run(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        isa.run(Mixes { resize: self, x, y });
    }
}

/// Operands of a running resize.
struct Mixes<'a> {
    resize: &'a Resize<'a>,
    x: &'a [f32],
    y: &'a mut [f32],
}

#[inline(always)]
fn mix(a: f32, b: f32, weight: f32) -> f32 {
    a + (b - a) * weight
}

impl Kernel for Mixes<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Resize {
            size,
            c,
            rows,
            cols,
            ..
        } = *self.resize;
        let [[x_row, x_col], [y_row, y_col]] = [self.resize.x_strides, self.resize.y_strides];
        let index = |number: f32, len: usize| (number as usize).min(len.saturating_sub(1));
        let (rows, _) = rows.as_chunks::<TABLE_WIDTH>();
        let (cols, _) = cols.as_chunks::<TABLE_WIDTH>();
        for (i, &[top, bottom, down]) in rows.iter().enumerate() {
            let lines = [top, bottom].map(|row| index(row, size[0]) * x_row);
            for (j, &[left, right, along]) in cols.iter().enumerate() {
                let places = [left, right].map(|col| index(col, size[1]) * x_col);
                let pixel = |line: usize, place: usize| {
                    let at = line + place;
                    self.x.get(at..at + c).unwrap_or(&[])
                };
                let at = i * y_row + j * y_col;
                let y = self.y.get_mut(at..at + c).unwrap_or(&mut []);
                let upper = pixel(lines[0], places[0])
                    .iter()
                    .zip(pixel(lines[0], places[1]));
                let lower = pixel(lines[1], places[0])
                    .iter()
                    .zip(pixel(lines[1], places[1]));
                for (y, ((&a, &b), (&c, &d))) in y.iter_mut().zip(upper.zip(lower)) {
                    *y = mix(mix(a, b, along), mix(c, d, along), down);
                }
            }
        }
    }
}
