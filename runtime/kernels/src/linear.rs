//! Dense layers over packed weights: `y = (accumulate ? y : 0) + activation(x·W + b)`.
//!
//! The weights lie in panels of sixteen outputs, `[ceil(n / 16)][k][16]`, so that one sweep over a panel reads memory strictly
//! in order and keeps sixteen sums in registers. Rows of `x` go through a panel in pairs: the two tokens of a control step
//! read each weight once. Each output is one sum in the order of `k`, then the bias, whatever the number of rows.

use crate::lanes::{Block, LANES, add_scaled};
use crate::math;

/// Outputs of one weight panel.
pub const PANEL: usize = LANES;

/// Elements of a `[k, n]` weight matrix in panels: `ceil(n / 16) * k * 16`.
pub const fn packed_len(k: usize, n: usize) -> usize {
    n.div_ceil(PANEL) * k * PANEL
}

/// Packs `w`, `[k, n]` row-major, into panels `[ceil(n / 16)][k][16]`, the last one padded with zeros. Offline work.
///
/// # Panics
/// When `w` is not `k * n` or `out` not [`packed_len`] elements long.
pub fn pack(w: &[f32], k: usize, n: usize, out: &mut [f32]) {
    assert_eq!(w.len(), k * n, "w is [k, n]");
    assert_eq!(out.len(), packed_len(k, n), "out is packed_len(k, n)");
    out.fill(0.0);
    for (i, row) in w.chunks_exact(n.max(1)).enumerate() {
        for (p, part) in row.chunks(PANEL).enumerate() {
            let start = (p * k + i) * PANEL;
            if let Some(panel) = out.get_mut(start..start + part.len()) {
                panel.copy_from_slice(part);
            }
        }
    }
}

/// The non-linearity of a dense layer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Activation {
    /// `x`
    None,
    /// `max(x, 0)`
    Relu,
    /// `x` where `x >= 0`, else `alpha * x`.
    LeakyRelu(f32),
    /// Hyperbolic tangent.
    Tanh,
    /// `1 / (1 + exp(-x))`
    Sigmoid,
}

impl Activation {
    #[inline(always)]
    fn apply(self, block: &mut Block) {
        fn each(block: &mut Block, f: impl Fn(f32) -> f32) {
            for x in block {
                *x = f(*x);
            }
        }
        match self {
            Self::None => {}
            Self::Relu => each(block, math::relu),
            Self::LeakyRelu(alpha) => each(block, |x| math::leaky_relu(x, alpha)),
            Self::Tanh => each(block, math::tanh),
            Self::Sigmoid => each(block, math::sigmoid),
        }
    }
}

/// A dense layer of `k` inputs and `n` outputs.
#[derive(Debug, Clone, Copy)]
pub struct Linear<'w> {
    /// Inputs.
    pub k: usize,
    /// Outputs.
    pub n: usize,
    /// [`packed_len`]`(k, n)` elements, written by [`pack`].
    pub w: &'w [f32],
    /// `[n]`, or empty for none.
    pub bias: &'w [f32],
    /// Applied to `x·W + b`.
    pub activation: Activation,
    /// Whether the result is added to `y` or replaces it.
    pub accumulate: bool,
}

impl Linear<'_> {
    /// Computes `y`, `[m, n]`, from `x`, `[m, k]`; `m` is `x.len() / k`.
    pub fn run(&self, x: &[f32], y: &mut [f32]) {
        let (k, n) = (self.k, self.n);
        if k == 0 || n == 0 {
            return;
        }
        for (p, panel) in self.w.chunks_exact(k * PANEL).enumerate() {
            let (panel, _) = panel.as_chunks::<PANEL>();
            let first = p * PANEL;
            let mut xs = x.chunks_exact(2 * k);
            let mut ys = y.chunks_exact_mut(2 * n);
            for (x, y) in xs.by_ref().zip(ys.by_ref()) {
                let (x0, x1) = x.split_at(k);
                let (y0, y1) = y.split_at_mut(n);
                let (sum0, sum1) = sweep_pair(panel, x0, x1);
                self.finish(sum0, first, y0);
                self.finish(sum1, first, y1);
            }
            let (x, y) = (xs.remainder(), ys.into_remainder());
            if x.len() == k && y.len() == n {
                self.finish(sweep(panel, x), first, y);
            }
        }
    }

    /// Bias, activation and store of the outputs from `first` on.
    #[inline(always)]
    fn finish(&self, mut sum: Block, first: usize, y: &mut [f32]) {
        for (sum, &bias) in sum.iter_mut().zip(self.bias.get(first..).unwrap_or(&[])) {
            *sum += bias;
        }
        self.activation.apply(&mut sum);
        let y = y.get_mut(first..).unwrap_or(&mut []);
        for (y, &sum) in y.iter_mut().zip(&sum) {
            *y = if self.accumulate { *y + sum } else { sum };
        }
    }
}

/// The sixteen sums of one row with a panel.
#[inline(always)]
fn sweep(panel: &[Block], x: &[f32]) -> Block {
    let mut sum = [0.0; PANEL];
    for (w, &x) in panel.iter().zip(x) {
        add_scaled(&mut sum, x, w);
    }
    sum
}

/// The sums of two rows with a panel, in the same order as [`sweep`].
#[inline(always)]
fn sweep_pair(panel: &[Block], x0: &[f32], x1: &[f32]) -> (Block, Block) {
    let mut sum0 = [0.0; PANEL];
    let mut sum1 = [0.0; PANEL];
    for ((w, &x0), &x1) in panel.iter().zip(x0).zip(x1) {
        add_scaled(&mut sum0, x0, w);
        add_scaled(&mut sum1, x1, w);
    }
    (sum0, sum1)
}
