//! Dense layers over packed weights: `y = (accumulate ? y : 0) + activation(x·W + b)`.
//!
//! ```text
//! for each panel of up to 64 outputs:          [k][64], one after the other in memory
//!     for l in 0..k:  sum[0..64] += x[l] * panel[l][0..64]
//!     y[panel] = activation(sum * scale + bias)
//! ```
//!
//! Memory is read strictly in order, once: then the processor's own prefetcher keeps up, and a layer takes the time of a bare
//! sweep over its bytes, from whichever cache they come. (Software prefetch of the next panel or layer was measured: it costs a
//! third of the time where weights are in the second-level cache and gains nothing where they are in memory.) Rows of `x` go
//! through a panel in pairs: the two tokens of a control step read each weight once. A target with few registers takes a
//! panel in parts. Each output is one sum in the order of `k`, then the scale, then the bias, whatever the number of rows or parts.

use crate::dispatch::{Isa, Kernel};
use crate::lanes::{Block, LANES};
use crate::math;
use crate::simd::Simd;
use crate::stored::{Bf16, F16, F32, Int8, Panels, Stored};

/// Blocks of sixteen outputs in a whole panel.
const PANEL_BLOCKS: usize = 4;

/// Outputs of one whole weight panel.
pub const PANEL: usize = PANEL_BLOCKS * LANES;

/// Elements of a `[k, n]` weight matrix in panels: `k * n`, `n` rounded up to sixteen.
pub const fn packed_len(k: usize, n: usize) -> usize {
    n.div_ceil(LANES) * k * LANES
}

/// Packs `w`, `[k, n]` row-major, into panels `[n / 64][k][64]`. What is left of `n` is a last panel, `[k][..]`, its width padded
/// with zeros to a multiple of sixteen. Offline work.
///
/// # Panics
/// When `w` is not `k * n` or `out` not [`packed_len`] elements long.
pub fn pack<T: Copy + Default>(w: &[T], k: usize, n: usize, out: &mut [T]) {
    assert_eq!(w.len(), k * n, "w is [k, n]");
    assert_eq!(out.len(), packed_len(k, n), "out is packed_len(k, n)");
    out.fill(T::default());
    for (l, row) in w.chunks_exact(n.max(1)).enumerate() {
        for (p, part) in row.chunks(PANEL).enumerate() {
            let start = p * PANEL * k + l * part.len().next_multiple_of(LANES);
            if let Some(to) = out.get_mut(start..start + part.len()) {
                to.copy_from_slice(part);
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
    /// [`packed_len`]`(k, n)` elements, ordered by [`pack`].
    pub w: Panels<'w>,
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
        if self.k == 0 || self.n == 0 {
            return;
        }
        let layer = self;
        match self.w {
            Panels::F32(w) => isa.run(Rows::<F32, false> { layer, w, x, y }),
            Panels::F16(w) => isa.run(Rows::<F16, true> { layer, w, x, y }),
            Panels::Bf16(w) => isa.run(Rows::<Bf16, true> { layer, w, x, y }),
            Panels::Int8 { panels: w, .. } => isa.run(Rows::<Int8, true> { layer, w, x, y }),
        }
    }

    /// Scale, bias, activation and store of the outputs from `first` on.
    #[inline(always)]
    fn finish<S: Simd, const P: usize>(
        &self,
        simd: S,
        sums: [S::V; P],
        first: usize,
        y: &mut [f32],
    ) {
        for (p, sum) in sums.into_iter().enumerate() {
            let first = first + p * LANES;
            let mut block = [0.0; LANES];
            simd.store(sum, &mut block);
            if let Panels::Int8 { scales, .. } = self.w {
                for (x, &scale) in block.iter_mut().zip(scales.get(first..).unwrap_or(&[])) {
                    *x *= scale;
                }
            }
            if let Some(bias) = self.bias.get(first..).and_then(<[_]>::first_chunk) {
                let bias: &Block = bias;
                for (x, bias) in block.iter_mut().zip(bias) {
                    *x += bias;
                }
            } else {
                for (x, &bias) in block.iter_mut().zip(self.bias.get(first..).unwrap_or(&[])) {
                    *x += bias;
                }
            }
            self.activation.apply(&mut block);
            let y = y.get_mut(first..).unwrap_or(&mut []);
            if let Some(y) = y.first_chunk_mut::<LANES>() {
                for (y, &x) in y.iter_mut().zip(&block) {
                    *y = if self.accumulate { *y + x } else { x };
                }
            } else {
                for (y, &x) in y.iter_mut().zip(&block) {
                    *y = if self.accumulate { *y + x } else { x };
                }
            }
        }
    }
}

/// A layer at work. `NARROW` is [`Kernel::NARROW`].
struct Rows<'a, W: Stored, const NARROW: bool> {
    layer: &'a Linear<'a>,
    w: &'a [W::Bits],
    x: &'a [f32],
    y: &'a mut [f32],
}

impl<W: Stored, const NARROW: bool> Kernel for Rows<'_, W, NARROW> {
    const NARROW: bool = NARROW;

    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        let (whole, rest) = (self.layer.n / PANEL, self.layer.n % PANEL);
        for panel in 0..whole {
            self.panel::<S, PANEL_BLOCKS>(simd, panel * PANEL);
        }
        let first = whole * PANEL;
        match rest.div_ceil(LANES) {
            0 => {}
            1 => self.panel::<S, 1>(simd, first),
            2 => self.panel::<S, 2>(simd, first),
            3 => self.panel::<S, 3>(simd, first),
            _ => self.panel::<S, PANEL_BLOCKS>(simd, first),
        }
    }
}

impl<W: Stored, const NARROW: bool> Rows<'_, W, NARROW> {
    /// A panel of `B` blocks with all rows of `x`; the first output is `first`.
    #[inline(always)]
    fn panel<S: Simd, const B: usize>(&mut self, simd: S, first: usize) {
        let (k, n) = (self.layer.k, self.layer.n);
        let start = first * k;
        let w = self.w.get(start..start + B * LANES * k).unwrap_or(&[]);
        let mut xs = self.x.chunks_exact((2 * k).max(1));
        let mut ys = self.y.chunks_exact_mut((2 * n).max(1));
        for (x, y) in xs.by_ref().zip(ys.by_ref()) {
            let (Some((x0, x1)), Some((y0, y1))) =
                (x.split_at_checked(k), y.split_at_mut_checked(n))
            else {
                return;
            };
            rows::<S, W, B, 2>(simd, self.layer, w, first, [x0, x1], [y0, y1]);
        }
        let (x, y) = (xs.remainder(), ys.into_remainder());
        if x.len() == k && y.len() == n {
            rows::<S, W, B, 1>(simd, self.layer, w, first, [x], [y]);
        }
    }
}

/// One panel and `R` rows, in as many parts as the registers ask for.
#[inline(always)]
fn rows<S: Simd, W: Stored, const B: usize, const R: usize>(
    simd: S,
    layer: &Linear,
    w: &[W::Bits],
    first: usize,
    x: [&[f32]; R],
    y: [&mut [f32]; R],
) {
    if S::SUMS >= B * R {
        part::<S, W, B, B, R>(simd, layer, w, [first, 0], x, y);
    } else if S::SUMS >= 2 * R && B.is_multiple_of(2) {
        let mut y = y;
        for at in (0..B).step_by(2) {
            part::<S, W, 2, B, R>(
                simd,
                layer,
                w,
                [first, at],
                x,
                y.each_mut().map(|y| &mut **y),
            );
        }
    } else {
        let mut y = y;
        for at in 0..B {
            part::<S, W, 1, B, R>(
                simd,
                layer,
                w,
                [first, at],
                x,
                y.each_mut().map(|y| &mut **y),
            );
        }
    }
}

/// `P` blocks, from block `at` on, of a panel of `B` blocks that begins at output `first`.
#[inline(always)]
fn part<S: Simd, W: Stored, const P: usize, const B: usize, const R: usize>(
    simd: S,
    layer: &Linear,
    w: &[W::Bits],
    [first, at]: [usize; 2],
    x: [&[f32]; R],
    y: [&mut [f32]; R],
) {
    let sums = sweep::<S, W, P, B, R>(simd, w, at, x);
    for (sums, y) in sums.into_iter().zip(y) {
        layer.finish(simd, sums, first + at * LANES, y);
    }
}

/// The sums of `R` rows of `k` elements.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn sweep<S: Simd, W: Stored, const P: usize, const B: usize, const R: usize>(
    simd: S,
    w: &[W::Bits],
    at: usize,
    x: [&[f32]; R],
) -> [[S::V; P]; R] {
    let mut sums = [[simd.splat(0.0); P]; R];
    let (w, _) = w.as_chunks::<LANES>();
    let (w, _) = w.as_chunks::<B>();
    if x.iter().any(|x| x.len() != w.len()) || at + P > B {
        return sums;
    }
    for (l, row) in w.iter().enumerate() {
        // SAFETY: each `x[r]` is as long as `w`, as compared above, and `l` is an index of `w`.
        let x: [S::V; R] = x.map(|x| simd.splat(unsafe { *x.get_unchecked(l) }));
        for p in 0..P {
            // SAFETY: `at + P <= B`, as compared above, and `p < P`.
            let w = W::load(simd, unsafe { row.get_unchecked(at + p) });
            for (sums, &x) in sums.iter_mut().zip(&x) {
                sums[p] = simd.add_product(sums[p], x, w);
            }
        }
    }
    sums
}
