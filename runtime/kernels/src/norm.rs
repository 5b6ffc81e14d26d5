//! Layer norm and softmax, row by row.

use crate::lanes::{max_of, sum_of};
use crate::math;

/// `y = (x - mean) / sqrt(variance + eps) * gamma + beta` for each row of `gamma.len()` elements; population variance, taken
/// in a second pass over the differences from the mean.
pub fn layer_norm(x: &[f32], gamma: &[f32], beta: &[f32], eps: f32, y: &mut [f32]) {
    let cols = gamma.len();
    if cols == 0 {
        return;
    }
    for (x, y) in x.chunks_exact(cols).zip(y.chunks_exact_mut(cols)) {
        let mean = sum_of(x, |x| x) / cols as f32;
        let variance = sum_of(x, |x| (x - mean) * (x - mean)) / cols as f32;
        let scale = 1.0 / math::sqrt(variance + eps);
        for (((y, &x), &gamma), &beta) in y.iter_mut().zip(x).zip(gamma).zip(beta) {
            *y = (x - mean) * scale * gamma + beta;
        }
    }
}

/// `y = exp(x - max) / sum(exp(x - max))` for each row of `cols` elements.
pub fn softmax(x: &[f32], cols: usize, y: &mut [f32]) {
    if cols == 0 {
        return;
    }
    for (x, y) in x.chunks_exact(cols).zip(y.chunks_exact_mut(cols)) {
        y.copy_from_slice(x);
        let scale = 1.0 / exponentials(y);
        for y in y {
            *y *= scale;
        }
    }
}

/// Replaces a row by `exp(x - max)` and returns the sum of the new elements.
#[inline(always)]
pub fn exponentials(row: &mut [f32]) -> f32 {
    let max = max_of(row);
    for x in &mut *row {
        *x = math::exp(*x - max);
    }
    sum_of(row, |x| x)
}
