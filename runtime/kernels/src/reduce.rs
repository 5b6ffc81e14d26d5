//! Reductions of one axis, and the index of the smallest or largest element.

use crate::elementwise::assign;
use crate::lanes::{LANES, sum_of};
use crate::math;

/// Function that reduces an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReduceKind {
    /// Sum of the elements.
    Sum,
    /// Sum divided by the axis' length.
    Mean,
    /// Largest element; NaN if any element is NaN.
    Max,
    /// Smallest element; NaN if any element is NaN.
    Min,
    /// Product of the elements.
    Prod,
}

/// Axis to reduce: `x` is `[outer, len, inner]`, where `outer` follows from its length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Axis {
    /// Length of the axis.
    pub len: usize,
    /// Product of the dimensions after the axis.
    pub inner: usize,
}

/// Computes `y[o, i] = kind over a of x[o, a, i]`. Sums over the last axis run in sixteen lanes,
/// all others in the axis' order.
pub fn reduce(kind: ReduceKind, x: &[f32], axis: Axis, y: &mut [f32]) {
    if axis.len == 0 || axis.inner == 0 {
        return;
    }
    for (x, y) in x
        .chunks_exact((axis.len * axis.inner).max(1))
        .zip(y.chunks_exact_mut(axis.inner))
    {
        match kind {
            ReduceKind::Sum => sum(x, y),
            ReduceKind::Mean => {
                sum(x, y);
                for y in y {
                    *y /= axis.len as f32;
                }
            }
            ReduceKind::Max => fold(x, y, math::max),
            ReduceKind::Min => fold(x, y, math::min),
            ReduceKind::Prod => fold(x, y, |a, b| a * b),
        }
    }
}

fn sum(x: &[f32], y: &mut [f32]) {
    match y {
        [y] if x.len() > LANES => *y = sum_of(x, |x| x),
        _ => fold(x, y, |a, b| a + b),
    }
}

/// Combines the rows of `x`, each as long as `y`, starting at the first.
#[inline(always)]
fn fold(x: &[f32], y: &mut [f32], f: impl Fn(f32, f32) -> f32) {
    let mut rows = x.chunks_exact(y.len().max(1));
    if let Some(first) = rows.next() {
        assign(y, first);
    }
    for row in rows {
        for (y, &x) in y.iter_mut().zip(row) {
            *y = f(*y, x);
        }
    }
}

/// Returns the index of the largest element, the first of equal ones; NaNs are skipped. Returns 0
/// if there is no number.
pub fn arg_max(x: &[f32]) -> usize {
    first_largest(x, |rank| rank)
}

/// Returns the index of the smallest element, the first of equal ones; NaNs are skipped. Returns 0
/// if there is no number.
pub fn arg_min(x: &[f32]) -> usize {
    first_largest(x, |rank| -rank)
}

/// Returns the index of the element of highest rank, by integer arithmetic without a comparison,
/// which may be compiled to a branch: a decision executes the same instructions whichever plan is
/// the best.
#[inline(always)]
fn first_largest(x: &[f32], rank: impl Fn(i64) -> i64) -> usize {
    /// Rank below that of every number; so is its negation.
    const NONE: i64 = i64::MIN / 4;
    /// Returns all ones if `x` is negative, else zeros.
    #[inline(always)]
    fn negative(x: i64) -> i64 {
        x >> 63
    }
    let (mut found, mut largest) = (0, NONE);
    for (i, &x) in x.iter().enumerate() {
        // Zero has one sign now.
        let bits = i64::from((x + 0.0).to_bits());
        let magnitude = bits & 0x7fff_ffff;
        let sign = negative(0x7fff_ffff - bits);
        // Sign and magnitude as one number, in the order of the floats.
        let ordered = (magnitude ^ sign) - sign;
        let none = negative(i64::from(f32::INFINITY.to_bits()) - magnitude);
        let rank = rank(ordered) & !none | NONE & none;
        let larger = negative(largest - rank);
        largest = largest & !larger | rank & larger;
        found = found & !(larger as usize) | i & larger as usize;
    }
    found
}
