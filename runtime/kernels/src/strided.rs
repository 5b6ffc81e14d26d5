//! Operations over four dimensions with strides: broadcasting arithmetic and copies.

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
    // Of two operands the first goes to `y`, and the second is combined with it there.
    let a = match (a, b) {
        (Row::Strided(x, stride), Row::Strided(..)) => {
            combine(y, x, stride, |_, x| x);
            Row::Output
        }
        _ => a,
    };
    match kind {
        BinaryKind::Add => apply(a, b, y, |a, b| a + b),
        BinaryKind::Sub => apply(a, b, y, |a, b| a - b),
        BinaryKind::Mul => apply(a, b, y, |a, b| a * b),
        BinaryKind::Div => apply(a, b, y, |a, b| a / b),
        BinaryKind::Max => apply(a, b, y, math::max),
        BinaryKind::Min => apply(a, b, y, math::min),
        BinaryKind::Pow => apply(a, b, y, math::pow),
        BinaryKind::Greater => apply(a, b, y, math::greater),
        BinaryKind::Keep => apply(a, b, y, math::keep),
    }
}

/// Computes `y = f(a, b)`, where at least one of them is in `y` already.
#[inline(always)]
fn apply(a: Row, b: Row, y: &mut [f32], f: impl Fn(f32, f32) -> f32) {
    match (a, b) {
        (Row::Strided(a, stride), _) => combine(y, a, stride, |b, a| f(a, b)),
        (Row::Output, Row::Strided(b, stride)) => combine(y, b, stride, f),
        (Row::Output, Row::Output) => {
            for y in y {
                *y = f(*y, *y);
            }
        }
    }
}

/// Computes `y[i] = f(y[i], x[i * stride])`.
#[inline(always)]
fn combine(y: &mut [f32], x: &[f32], stride: usize, f: impl Fn(f32, f32) -> f32) {
    match (stride, x.first()) {
        (0, Some(&x)) => {
            for y in y {
                *y = f(*y, x);
            }
        }
        (1, _) => {
            for (y, &x) in y.iter_mut().zip(x) {
                *y = f(*y, x);
            }
        }
        (_, Some(_)) => {
            for (y, &x) in y.iter_mut().zip(x.iter().step_by(stride)) {
                *y = f(*y, x);
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
                combine(y.get_mut(..len).unwrap_or(&mut []), x, x3, |_, x| x);
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
