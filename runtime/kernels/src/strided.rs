//! Operations over four dimensions with strides: broadcasting arithmetic and copies.

use crate::elementwise::{assign, combine};
use crate::lanes::{Block, LANES};
use crate::math;

/// Functions of two elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BinaryKind {
    /// Sum, `a + b`.
    Add,
    /// Difference, `a - b`.
    Sub,
    /// Product, `a * b`.
    Mul,
    /// Quotient, `a / b`.
    Div,
    /// Larger element; NaN if either is NaN.
    Max,
    /// Smaller element; NaN if either is NaN.
    Min,
    /// Power, `a` to the power of `b`.
    Pow,
    /// Comparison: 1 where `a > b`, else 0.
    Greater,
    /// Selection by a condition: `a` where `b` is not zero, else 0.
    Keep,
}

/// An operand of [`binary`].
#[derive(Debug, Clone, Copy)]
pub enum Input<'x> {
    /// Elements, and the distance between neighbours in each dimension; 0 broadcasts.
    Strided(&'x [f32], [usize; 4]),
    /// Previous content of the result, element by element: the operation is in place.
    Output,
}

/// One row, along the last dimension, of an operand.
#[derive(Clone, Copy)]
enum Row<'x> {
    Strided(&'x [f32], usize),
    Output,
}

impl<'x> Input<'x> {
    fn row(self, at: [usize; 3]) -> Row<'x> {
        match self {
            Self::Strided(x, [s0, s1, s2, s3]) => {
                let [i0, i1, i2] = at;
                Row::Strided(x.get(i0 * s0 + i1 * s1 + i2 * s2..).unwrap_or(&[]), s3)
            }
            Self::Output => Row::Output,
        }
    }
}

impl Row<'_> {
    /// Copies sixteen elements from `at` on, `y` being those of the result; what is beyond the row is zero.
    fn block(self, at: usize, y: &[f32]) -> Block {
        let mut block = [0.0; LANES];
        match self {
            Self::Strided(x, stride) => {
                let x = x.get(at.saturating_mul(stride)..).unwrap_or(&[]);
                gather(x, stride, &mut block);
            }
            Self::Output => assign(&mut block, y),
        }
        block
    }
}

/// Computes `y[i] = kind(a[i], b[i])` over `dims`; `y` is contiguous.
pub fn binary(kind: BinaryKind, a: Input, b: Input, dims: [usize; 4], y: &mut [f32]) {
    let mut ys = y.chunks_exact_mut(dims[3].max(1));
    for_each_row(dims, |at| {
        if let Some(y) = ys.next() {
            binary_row(kind, a.row(at), b.row(at), y);
        }
    });
}

fn binary_row(kind: BinaryKind, a: Row, b: Row, y: &mut [f32]) {
    // Block by block, operands first: each function is compiled once, not once for each layout of its operands.
    for (number, y) in y.chunks_mut(LANES).enumerate() {
        let [mut of, b] = [a, b].map(|row| row.block(number * LANES, y));
        match kind {
            BinaryKind::Add => combine(&mut of, &b, |a, b| a + b),
            BinaryKind::Sub => combine(&mut of, &b, |a, b| a - b),
            BinaryKind::Mul => combine(&mut of, &b, |a, b| a * b),
            BinaryKind::Div => combine(&mut of, &b, |a, b| a / b),
            BinaryKind::Max => combine(&mut of, &b, math::max),
            BinaryKind::Min => combine(&mut of, &b, math::min),
            BinaryKind::Pow => powers(&mut of, &b),
            BinaryKind::Greater => combine(&mut of, &b, math::greater),
            BinaryKind::Keep => combine(&mut of, &b, math::keep),
        }
        assign(y, &of);
    }
}

/// Computes `a[i] = a[i]^b[i]` in a loop of calls, which unrolled would be long.
#[inline(never)]
fn powers(a: &mut [f32], b: &[f32]) {
    for (a, &b) in a.iter_mut().zip(b) {
        *a = math::pow(*a, b);
    }
}

/// Copies `y[i] = x[i * stride]`.
fn gather(x: &[f32], stride: usize, y: &mut [f32]) {
    match (stride, x.first()) {
        (0, Some(&x)) => y.fill(x),
        (1, _) => assign(y, x),
        (_, Some(_)) => {
            for (y, &x) in y.iter_mut().zip(x.iter().step_by(stride)) {
                *y = x;
            }
        }
        (_, None) => {}
    }
}

/// A copy between two strided layouts.
#[derive(Debug, Clone, Copy)]
pub struct StridedCopy {
    /// Shape of the copy.
    pub dims: [usize; 4],
    /// Elements from one index to the next in each dimension of the source; 0 broadcasts.
    pub x_strides: [usize; 4],
    /// Elements from one index to the next in each dimension of the destination; not 0 where the dimension is longer than one.
    pub y_strides: [usize; 4],
}

impl StridedCopy {
    /// Copies `y[i] = x[i]`; elements of `y` that the strides do not reach keep their value.
    pub fn run(&self, x: &[f32], y: &mut [f32]) {
        let [x0, x1, x2, x3] = self.x_strides;
        let [y0, y1, y2, y3] = self.y_strides;
        let len = self.dims[3];
        for_each_row(self.dims, |[i0, i1, i2]| {
            let x = x.get(i0 * x0 + i1 * x1 + i2 * x2..).unwrap_or(&[]);
            let y = y.get_mut(i0 * y0 + i1 * y1 + i2 * y2..).unwrap_or(&mut []);
            if y3 == 1 {
                let len = len.min(y.len());
                gather(x, x3, y.get_mut(..len).unwrap_or(&mut []));
            } else {
                let ys = y.iter_mut().step_by(y3.max(1)).take(len);
                if let (0, Some(&x)) = (x3, x.first()) {
                    ys.for_each(|y| *y = x);
                } else {
                    ys.zip(x.iter().step_by(x3.max(1)))
                        .for_each(|(y, &x)| *y = x);
                }
            }
        });
    }
}

/// Calls `f` with every index of the first three dimensions, in order.
fn for_each_row(dims: [usize; 4], mut f: impl FnMut([usize; 3])) {
    for i0 in 0..dims[0] {
        for i1 in 0..dims[1] {
            for i2 in 0..dims[2] {
                f([i0, i1, i2]);
            }
        }
    }
}
