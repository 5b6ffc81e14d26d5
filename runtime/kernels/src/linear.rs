//! Dense layers over packed weights: `y = (accumulate ? y : 0) + activation(x·W + b)`.
//!
//! ```text
//! for each panel of up to 64 outputs:          [k][64], one after the other in memory
//!     for l in 0..k:  sum[0..64] += x[l] * panel[l][0..64]
//!     y[panel] = activation(sum * scale + bias)
//! ```
//!
//! Memory is read strictly in order, once. Rows of `x` go through the panels in pairs: the two tokens of a control step read each
//! weight once. A target with few registers takes a panel in parts. Each output is one sum in the order of `k`, then the scale,
//! then the bias, whatever the number of rows or parts.
//!
//! The module `floats` sums panels of float weights, `integers` those of integer weights.

use core::hint::black_box;
use core::ops::Range;

use crate::dispatch::{Isa, Kernel};
use crate::elementwise::{Unary, UnaryKind, assign};
use crate::floats;
use crate::integers::{self, PART, Part};
use crate::lanes::{Block, LANES};
use crate::math;
use crate::simd::Simd;
use crate::stored::{Bf16, F16, F32, Panels, WeightFormat};

/// Number of blocks of sixteen outputs in a whole panel.
pub(crate) const PANEL_BLOCKS: usize = 4;

/// Number of outputs of one whole weight panel.
pub const PANEL: usize = PANEL_BLOCKS * LANES;

/// Returns the number of rows of a `[k, n]` weight matrix in panels: `k`, rounded up to sixteen for
/// integer formats.
pub const fn packed_rows(format: WeightFormat, k: usize) -> usize {
    if format.is_scaled() {
        k.next_multiple_of(LANES)
    } else {
        k
    }
}

/// Returns the number of elements of a `[k, n]` weight matrix in panels: rows times `n` rounded up
/// to sixteen.
pub const fn packed_len(format: WeightFormat, [k, n]: [usize; 2]) -> usize {
    n.div_ceil(LANES) * LANES * packed_rows(format, k)
}

/// Packs `w`, `[k, n]` row-major, into panels `[n / 64][k][64]`, or `[n / 64][k / 2][64][2]` for
/// integer formats. The remainder of `n` becomes a last, narrower panel. Rows and columns are
/// rounded up to sixteen with zeros. For offline use.
///
/// # Panics
/// When `w` is not `k * n` or `out` not [`packed_len`] elements long.
pub fn pack<T: Copy + Default>(format: WeightFormat, w: &[T], [k, n]: [usize; 2], out: &mut [T]) {
    assert_eq!(w.len(), k * n, "w is [k, n]");
    assert_eq!(out.len(), packed_len(format, [k, n]), "out is packed_len");
    out.fill(T::default());
    let together = if format.is_scaled() { 2 } else { 1 };
    for (l, row) in w.chunks_exact(n.max(1)).enumerate() {
        for (p, part) in row.chunks(PANEL).enumerate() {
            let width = part.len().next_multiple_of(LANES);
            let start =
                p * PANEL * packed_rows(format, k) + l / together * together * width + l % together;
            let to = out.get_mut(start..).unwrap_or(&mut []);
            for (to, &w) in to.iter_mut().step_by(together).zip(part) {
                *to = w;
            }
        }
    }
}

/// True if this build has the kernels of integer weights; without them such a layer computes
/// nothing.
pub(crate) const INTEGERS: bool = cfg!(feature = "integer-weights");

/// True if this build has the kernels of 16-bit floats; without them such a layer computes nothing.
const HALVES: bool = cfg!(feature = "half-weights");

/// Non-linearity of a dense layer or a convolution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Activation {
    /// Identity, `x`.
    None,
    /// Rectifier, `max(x, 0)`.
    Relu,
    /// Leaky rectifier: `x` where `x >= 0`, else `alpha * x`.
    LeakyRelu(f32),
    /// Clipped rectifier, `min(max(x, 0), bound)`: with a bound of 6, the `ReLU6` of mobile networks.
    Clipped(f32),
    /// Hyperbolic tangent.
    Tanh,
    /// Logistic sigmoid, `1 / (1 + exp(-x))`.
    Sigmoid,
    /// Exponential linear unit: `x` where `x >= 0`, else `alpha * (exp(x) - 1)`.
    Elu(f32),
    /// Softplus, `log(1 + exp(x))`.
    Softplus,
    /// Mish, `x * tanh(log(1 + exp(x)))`.
    Mish,
}

impl Activation {
    /// Returns the unary operation that a layer may leave for a last pass over its outputs: long
    /// code, which is compiled once.
    fn for_the_end(self) -> Option<Unary> {
        let (kind, alpha) = match self {
            Self::None | Self::Relu | Self::LeakyRelu(_) | Self::Clipped(_) => return None,
            Self::Tanh => (UnaryKind::Tanh, 0.0),
            Self::Sigmoid => (UnaryKind::Sigmoid, 0.0),
            Self::Elu(alpha) => (UnaryKind::Elu, alpha),
            Self::Softplus => (UnaryKind::Softplus, 0.0),
            Self::Mish => (UnaryKind::Mish, 0.0),
        };
        Some(Unary { kind, alpha })
    }

    #[inline(always)]
    pub(crate) fn apply<S: Simd>(self, simd: S, x: S::V) -> S::V {
        /// Applies a long activation element by element, in code that all instruction sets share.
        #[inline(never)]
        fn each(block: &mut Block, alpha: f32, f: fn(f32, f32) -> f32) {
            for x in block {
                *x = f(*x, alpha);
            }
        }
        let slow = |alpha, f| {
            let mut block = [0.0; LANES];
            simd.store(x, &mut block);
            each(&mut block, alpha, f);
            simd.load(&block)
        };
        match self {
            Self::None => x,
            Self::Relu => simd.where_negative(x, simd.splat(0.0)),
            Self::LeakyRelu(alpha) => simd.where_negative(x, simd.mul(simd.splat(alpha), x)),
            Self::Clipped(bound) => {
                let x = simd.where_negative(x, simd.splat(0.0));
                simd.at_most(x, simd.splat(bound))
            }
            Self::Tanh => slow(0.0, |x, _| math::tanh(x)),
            Self::Sigmoid => slow(0.0, |x, _| math::sigmoid(x)),
            Self::Elu(alpha) => slow(alpha, math::elu),
            Self::Softplus => slow(0.0, |x, _| math::softplus(x)),
            Self::Mish => slow(0.0, |x, _| math::mish(x)),
        }
    }
}

/// Dense layer of `k` inputs and `n` outputs.
#[derive(Debug, Clone, Copy)]
pub struct Linear<'w> {
    /// Number of inputs.
    pub k: usize,
    /// Number of outputs.
    pub n: usize,
    /// Packed weights: [`packed_len`] elements, ordered by [`pack`].
    pub w: Panels<'w>,
    /// Bias `[n]`, or empty for none.
    pub bias: &'w [f32],
    /// Activation, applied to `x·W + b`.
    pub activation: Activation,
    /// True if the result is added to `y`; else it replaces `y`.
    pub accumulate: bool,
}

impl Linear<'_> {
    /// Computes `y`, `[m, n]`, from `x`, `[m, k]`; `m` is `x.len() / k`.
    pub fn run(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        if self.k == 0 || self.n == 0 {
            return;
        }
        let at_the_end = self.activation.for_the_end().filter(|_| !self.accumulate);
        let activation = match at_the_end {
            Some(_) => Activation::None,
            None => self.activation,
        };
        match self.w {
            Panels::F32(_) => self.wide(isa, activation, x, y, &mut []),
            Panels::Int8 { .. } | Panels::Int16 { .. } => {
                if INTEGERS {
                    self.integers(isa, activation, x, y);
                }
            }
            Panels::F16(_) | Panels::Bf16(_) => {
                if HALVES {
                    isa.run(Rows::<true> {
                        layer: self,
                        activation,
                        parts: &mut [],
                        x,
                        y,
                    });
                }
            }
        }
        if let Some(unary) = at_the_end {
            let rows = |len: usize, of: usize| len.checked_div(of).unwrap_or(0);
            let computed = rows(x.len(), self.k).min(rows(y.len(), self.n)) * self.n;
            unary.run_in_place(isa, y.get_mut(..computed).unwrap_or(&mut []));
        }
    }

    /// Runs the layer with integer weights. Out of line, so float layers do not reserve this stack
    /// buffer.
    #[inline(never)]
    fn integers(&self, isa: Isa, activation: Activation, x: &[f32], y: &mut [f32]) {
        self.wide(isa, activation, x, y, &mut [Part::EMPTY; 2]);
    }

    /// Runs the layer with 32-bit floats or integers as weights. Out of line, so that these formats
    /// share one compiled body.
    #[inline(never)]
    fn wide(&self, isa: Isa, activation: Activation, x: &[f32], y: &mut [f32], parts: &mut [Part]) {
        isa.run(Rows::<false> {
            layer: self,
            activation,
            parts,
            x,
            y,
        });
    }

    /// Returns whether the weights are integers.
    #[inline(always)]
    fn is_scaled(&self) -> bool {
        INTEGERS && matches!(self.w, Panels::Int8 { .. } | Panels::Int16 { .. })
    }

    /// Computes the sums of `R` rows with the panel that starts at weight `at`; with integers it
    /// adds those of part `i` to those of earlier parts.
    #[inline(always)]
    fn panel<S: Simd, const R: usize, const NARROW: bool>(
        &self,
        simd: S,
        (at, blocks): (Range<usize>, usize),
        (x, parts, i): ([&[f32]; R], &[Part], usize),
        sums: &mut Sums,
    ) {
        #[inline(always)]
        fn part<T>(w: &[T], at: Range<usize>) -> &[T] {
            w.get(at).unwrap_or(&[])
        }
        match self.w {
            Panels::F32(w) if !NARROW => {
                floats::panel::<S, F32, R>(simd, part(w, at), blocks, x, sums);
            }
            Panels::Int8 { panels: w, .. } if INTEGERS && !NARROW => {
                integers::panel::<S, i8, R>(simd, part(w, at), blocks, parts, i, sums);
            }
            Panels::Int16 { panels: w, .. } if INTEGERS && !NARROW => {
                integers::panel::<S, i16, R>(simd, part(w, at), blocks, parts, i, sums);
            }
            Panels::F16(w) if NARROW => {
                floats::panel::<S, F16, R>(simd, part(w, at), blocks, x, sums);
            }
            Panels::Bf16(w) if NARROW => {
                floats::panel::<S, Bf16, R>(simd, part(w, at), blocks, x, sums);
            }
            // `run` chooses the kernel by the format.
            _ => {}
        }
    }

    /// Applies scale, bias and activation to the up to sixteen outputs from `first` on, and stores
    /// them.
    #[inline(always)]
    fn finish<S: Simd>(
        &self,
        simd: S,
        activation: Activation,
        sums: &Block,
        first: usize,
        y: &mut [f32],
    ) {
        let mut spare = [0.0; LANES];
        let mut v = simd.load(sums);
        if let Panels::Int8 { scales, .. } | Panels::Int16 { scales, .. } = self.w {
            v = simd.mul(v, simd.load(block(scales, first, &mut spare)));
        }
        v = simd.add(v, simd.load(block(self.bias, first, &mut spare)));
        v = activation.apply(simd, v);
        if self.accumulate {
            v = simd.add(simd.load(block(y, first, &mut spare)), v);
        }
        let y = y.get_mut(first..).unwrap_or(&mut []);
        if let Some(y) = y.first_chunk_mut() {
            simd.store(v, y);
        } else {
            simd.store(v, &mut spare);
            assign(y, &spare);
        }
    }
}

/// Returns the sixteen elements from `first` on; missing ones are zero, in `spare`.
#[inline(always)]
pub(crate) fn block<'b>(x: &'b [f32], first: usize, spare: &'b mut Block) -> &'b Block {
    let x = x.get(first..).unwrap_or(&[]);
    if let Some(block) = x.first_chunk() {
        return block;
    }
    *spare = [0.0; LANES];
    assign(spare, x);
    spare
}

/// Operands of a running layer, of wide weights or integers, or of `NARROW` ones, see
/// [`Kernel::NARROW`].
struct Rows<'a, const NARROW: bool> {
    layer: &'a Linear<'a>,
    /// Activation of the layer, or none if it is applied in a last pass.
    activation: Activation,
    /// Two parts for integer weights, else empty.
    parts: &'a mut [Part],
    x: &'a [f32],
    y: &'a mut [f32],
}

/// The sums of one panel for two rows.
pub(crate) type Sums = [[Block; PANEL_BLOCKS]; 2];

impl<const NARROW: bool> Kernel for Rows<'_, NARROW> {
    const NARROW: bool = NARROW;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let layer = self.layer;
        let (k, n) = (layer.k, layer.n);
        let (height, part_len) = if !NARROW && layer.is_scaled() {
            (k.next_multiple_of(LANES), PART)
        } else {
            (k, k)
        };
        let mut sums = [[[0.0; LANES]; PANEL_BLOCKS]; 2];
        let parts = self.parts;
        let (mut x, mut y) = (self.x, self.y);
        while let Some((x0, rest)) = x.split_at_checked(k)
            && let Some((y0, others)) = y.split_at_mut_checked(n)
        {
            let (rows, x1, y1) = if let Some((x1, rest)) = rest.split_at_checked(k)
                && let Some((y1, others)) = others.split_at_mut_checked(n)
            {
                (x, y) = (rest, others);
                (2, x1, y1)
            } else {
                (x, y) = (&[], &mut []);
                (1, &[][..], Default::default())
            };
            let mut y = [y0, y1];
            let mut ready = None;
            for first in (0..n).step_by(PANEL) {
                let blocks = (n - first).div_ceil(LANES).min(PANEL_BLOCKS);
                let place = || {
                    let at = first * height..(first + blocks * LANES) * height;
                    (at, blocks)
                };
                for i in 0..k.div_ceil(part_len.max(1)) {
                    if !NARROW && layer.is_scaled() && ready != Some(i) {
                        for (part, x) in parts.iter_mut().zip([x0, x1]).take(black_box(rows)) {
                            part.take(simd, x.get(i * PART..).unwrap_or(&[]));
                        }
                        ready = Some(i);
                    }
                    if rows == 2 {
                        let x = ([x0, x1], &*parts, i);
                        layer.panel::<S, 2, NARROW>(simd, place(), x, &mut sums);
                    } else {
                        let x = ([x0], &*parts, i);
                        layer.panel::<S, 1, NARROW>(simd, place(), x, &mut sums);
                    }
                }
                // Written once for all widths and numbers of rows, and not unrolled by those who know them: activations are long.
                for (y, sums) in y.iter_mut().zip(&sums).take(black_box(rows)) {
                    let sums = black_box(sums.get(..blocks).unwrap_or(&[]));
                    for (block, sums) in sums.iter().enumerate() {
                        layer.finish(simd, self.activation, sums, first + block * LANES, y);
                    }
                }
            }
        }
    }
}
