//! Dense layers over packed weights: `y = (accumulate ? y : 0) + activation(x·W + b)`.
//!
//! The weights lie in panels of sixteen outputs, `[ceil(n / 16)][k][16]`, so that one sweep over a panel reads memory strictly
//! in order and keeps sixteen sums in registers. Rows of `x` go through a panel in pairs: the two tokens of a control step
//! read each weight once. Where registers allow it, several panels are swept side by side, because a sum waits for its last
//! addition, and the next panels are prefetched meanwhile: between two control steps a robot's or a simulator's other work takes
//! the caches, and a step is as fast as its weights arrive. Each output is one sum in the order of `k`, then the bias, whatever
//! the number of rows or panels.

use crate::dispatch::{Isa, Kernel, prefetch};
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
        #[inline(always)]
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
    pub fn run(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        if self.k > 0 && self.n > 0 {
            isa.run(Rows { layer: self, x, y });
        }
    }

    /// `P` panels with all rows of `x`; the first output is `first`.
    #[inline(always)]
    fn panels<const P: usize>(&self, w: &[f32], first: usize, x: &[f32], y: &mut [f32]) {
        let (k, n) = (self.k, self.n);
        let (w, _) = w.as_chunks::<PANEL>();
        let w: [_; P] = core::array::from_fn(|p| w.get(p * k..(p + 1) * k).unwrap_or(&[]));
        let mut xs = x.chunks_exact((2 * k).max(1));
        let mut ys = y.chunks_exact_mut((2 * n).max(1));
        for (x, y) in xs.by_ref().zip(ys.by_ref()) {
            let (Some((x0, x1)), Some((y0, y1))) =
                (x.split_at_checked(k), y.split_at_mut_checked(n))
            else {
                return;
            };
            let [sums0, sums1] = sweep(w, [x0, x1]);
            self.finish(sums0, first, y0);
            self.finish(sums1, first, y1);
        }
        let (x, y) = (xs.remainder(), ys.into_remainder());
        if x.len() == k && y.len() == n {
            let [sums] = sweep(w, [x]);
            self.finish(sums, first, y);
        }
    }

    /// Bias, activation and store of the outputs from `first` on.
    #[inline(always)]
    fn finish<const P: usize>(&self, sums: [Block; P], first: usize, y: &mut [f32]) {
        for (p, mut sum) in sums.into_iter().enumerate() {
            let first = first + p * PANEL;
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
}

/// A layer at work.
struct Rows<'a> {
    layer: &'a Linear<'a>,
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Kernel for Rows<'_> {
    #[inline(always)]
    fn run<const WIDE: usize>(self) {
        let panel = self.layer.k * PANEL;
        let mut groups = self.layer.w.chunks_exact((WIDE * panel).max(1));
        let mut first = 0;
        for w in groups.by_ref() {
            self.layer.panels::<WIDE>(w, first, self.x, self.y);
            first += WIDE * PANEL;
        }
        for w in groups.remainder().chunks_exact(panel.max(1)) {
            self.layer.panels::<1>(w, first, self.x, self.y);
            first += PANEL;
        }
    }
}

/// The sums of `R` rows with `P` panels, `x` of `k` elements and `w` of `k` blocks each.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn sweep<const P: usize, const R: usize>(w: [&[Block]; P], x: [&[f32]; R]) -> [[Block; P]; R] {
    let mut sums = [[[0.0; PANEL]; P]; R];
    let k = x[0].len();
    if x.iter().any(|x| x.len() != k) || w.iter().any(|w| w.len() != k) {
        return sums;
    }
    for l in 0..k {
        for p in 0..P {
            // SAFETY: `w[p]` has `k` elements, as compared above, and `l < k`.
            let block = unsafe { w[p].get_unchecked(l) };
            // The next panels, at the same place; behind the last ones, in an image in the order of use, the next layer's.
            prefetch(core::ptr::from_ref(block).wrapping_add(P * k));
            for r in 0..R {
                // SAFETY: `x[r]` has `k` elements, as compared above, and `l < k`.
                let x = unsafe { *x[r].get_unchecked(l) };
                add_scaled(&mut sums[r][p], x, block);
            }
        }
    }
    sums
}
