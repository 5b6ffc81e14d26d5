//! Layer norm and softmax, row by row.

use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
use crate::lanes::{max_of, sum_of};
use crate::math;
use crate::simd::Simd;

/// Layer norm with the weights of one layer.
#[derive(Debug, Clone, Copy)]
pub struct LayerNorm<'w> {
    /// Scale of each normalised element; its length is that of a row.
    pub gamma: &'w [f32],
    /// Shift, added last; as long as `gamma`.
    pub beta: &'w [f32],
    /// Constant added to the variance.
    pub eps: f32,
}

impl LayerNorm<'_> {
    /// Computes `y = (x - mean) / sqrt(variance + eps) * gamma + beta` for each row of
    /// `gamma.len()` elements; population variance, taken in a second pass over the differences
    /// from the mean.
    pub fn run(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        if !self.gamma.is_empty() {
            isa.run(LayerNormRows { norm: *self, x, y });
        }
    }
}

/// Operands of a running layer norm.
struct LayerNormRows<'a> {
    norm: LayerNorm<'a>,
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Kernel for LayerNormRows<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let LayerNorm { gamma, beta, eps } = self.norm;
        let cols = gamma.len().max(1);
        let rows = self.x.chunks_exact(cols);
        for (x, y) in rows.zip(self.y.chunks_exact_mut(cols)) {
            let mean = sum_of(x, |x| x) / cols as f32;
            let variance = sum_of(x, |x| (x - mean) * (x - mean)) / cols as f32;
            let scale = 1.0 / math::sqrt(variance + eps);
            for (((y, &x), &gamma), &beta) in y.iter_mut().zip(x).zip(gamma).zip(beta) {
                *y = (x - mean) * scale * gamma + beta;
            }
        }
    }
}

/// Computes `y = exp(x - max) / sum(exp(x - max))` for each row of `cols` elements.
pub fn softmax(isa: Isa, x: &[f32], cols: usize, y: &mut [f32]) {
    if cols > 0 {
        isa.run(SoftmaxRows { x, cols, y });
    }
}

/// Operands of a running softmax.
struct SoftmaxRows<'a> {
    x: &'a [f32],
    cols: usize,
    y: &'a mut [f32],
}

impl Kernel for SoftmaxRows<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let cols = self.cols.max(1);
        let rows = self.x.chunks_exact(cols);
        for (x, y) in rows.zip(self.y.chunks_exact_mut(cols)) {
            assign(y, x);
            let scale = 1.0 / exponentials(y);
            for y in y {
                *y *= scale;
            }
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
