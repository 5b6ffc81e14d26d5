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

use core::mem;

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

/// Sums of one panel for two rows.
pub(crate) type Sums = [[Block; PANEL_BLOCKS]; 2];

/// Where in a panel a sweep over its weights starts.
#[derive(Clone, Copy)]
pub(crate) struct Place {
    /// First block of the sweep.
    pub at: usize,
    /// Number of blocks of the whole panel.
    pub blocks: usize,
}

/// Panel of a layer's weights.
#[derive(Clone, Copy)]
struct PanelRef {
    /// First output of the panel.
    first: usize,
    /// Number of blocks of outputs, at most [`PANEL_BLOCKS`].
    blocks: usize,
    /// Number of rows of the packed weights, see [`packed_rows`].
    rows: usize,
}

impl PanelRef {
    /// Returns the panel's weights.
    #[inline(always)]
    fn weights<T>(self, packed: &[T]) -> &[T] {
        let end = self.first + self.blocks * LANES;
        let panel = self.first * self.rows..end * self.rows;
        packed.get(panel).unwrap_or(&[])
    }
}

/// One or two rows of inputs, which go through the panels together, and their outputs.
struct RowPair<'a> {
    /// Number of rows, 1 or 2; with one, the second input and output are empty.
    rows: usize,
    x: [&'a [f32]; 2],
    y: [&'a mut [f32]; 2],
}

/// Operands of a running layer, of wide weights or integers, or of `NARROW` ones, see
/// [`Kernel::NARROW`].
struct Rows<'a, const NARROW: bool> {
    layer: &'a Linear<'a>,
    /// Activation of the layer, or none if it is applied in a last pass.
    activation: Activation,
    /// Two parts for integer weights, else empty.
    parts: &'a mut [Part],
    /// Inputs that are still to be read, whole rows of `k`.
    x: &'a [f32],
    /// Outputs that are still to be written, whole rows of `n`.
    y: &'a mut [f32],
}

impl<const NARROW: bool> Kernel for Rows<'_, NARROW> {
    const NARROW: bool = NARROW;

    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        let layer = self.layer;
        let (rows, part_len) = if self.is_scaled() {
            (layer.k.next_multiple_of(LANES), PART)
        } else {
            (layer.k, layer.k)
        };
        let mut sums = [[[0.0; LANES]; PANEL_BLOCKS]; 2];
        while let Some(mut pair) = self.next_pair() {
            let mut quantised = None;
            for first in (0..layer.n).step_by(PANEL) {
                let blocks = (layer.n - first).div_ceil(LANES).min(PANEL_BLOCKS);
                let panel = PanelRef {
                    first,
                    blocks,
                    rows,
                };
                for part in 0..layer.k.div_ceil(part_len.max(1)) {
                    if self.is_scaled() && quantised != Some(part) {
                        self.quantise(simd, &pair, part);
                        quantised = Some(part);
                    }
                    if pair.rows == 2 {
                        self.sum::<S, 2>(simd, panel, pair.x, part, &mut sums);
                    } else {
                        self.sum::<S, 1>(simd, panel, [pair.x[0]], part, &mut sums);
                    }
                }
                self.finish(simd, panel, &sums, &mut pair);
            }
        }
    }
}

impl<'a, const NARROW: bool> Rows<'a, NARROW> {
    /// Returns whether the weights are integers.
    #[inline(always)]
    fn is_scaled(&self) -> bool {
        INTEGERS && !NARROW && matches!(self.layer.w, Panels::Int8 { .. } | Panels::Int16 { .. })
    }

    /// Takes the next two rows, or the last one.
    #[inline(always)]
    fn next_pair(&mut self) -> Option<RowPair<'a>> {
        let (k, n) = (self.layer.k, self.layer.n);
        let (x0, x) = self.x.split_at_checked(k)?;
        let (y0, y) = mem::take(&mut self.y).split_at_mut_checked(n)?;
        let (rows, x1, y1);
        (rows, x1, self.x, y1, self.y) = match (x.split_at_checked(k), y.split_at_mut_checked(n)) {
            (Some((x1, x)), Some((y1, y))) => (2, x1, x, y1, y),
            _ => (1, &[][..], &[][..], Default::default(), Default::default()),
        };
        Some(RowPair {
            rows,
            x: [x0, x1],
            y: [y0, y1],
        })
    }

    /// Converts one part of each row to integers.
    #[inline(always)]
    fn quantise<S: Simd>(&mut self, simd: S, pair: &RowPair, part: usize) {
        for (to, x) in self.parts.iter_mut().zip(pair.x).take(pair.rows) {
            to.take(simd, x.get(part * PART..).unwrap_or(&[]));
        }
    }

    /// Computes the sums of `R` rows with one panel; with integers it adds those of a part to those
    /// of earlier parts.
    #[inline(always)]
    fn sum<S: Simd, const R: usize>(
        &self,
        simd: S,
        panel: PanelRef,
        x: [&[f32]; R],
        part: usize,
        sums: &mut Sums,
    ) {
        let blocks = panel.blocks;
        match self.layer.w {
            Panels::F32(w) if !NARROW => {
                floats::panel::<S, F32, R>(simd, panel.weights(w), blocks, x, sums);
            }
            Panels::Int8 { panels: w, .. } if INTEGERS && !NARROW => {
                integers::panel::<S, i8, R>(simd, panel.weights(w), blocks, self.parts, part, sums);
            }
            Panels::Int16 { panels: w, .. } if INTEGERS && !NARROW => {
                integers::panel::<S, i16, R>(
                    simd,
                    panel.weights(w),
                    blocks,
                    self.parts,
                    part,
                    sums,
                );
            }
            Panels::F16(w) if NARROW => {
                floats::panel::<S, F16, R>(simd, panel.weights(w), blocks, x, sums);
            }
            Panels::Bf16(w) if NARROW => {
                floats::panel::<S, Bf16, R>(simd, panel.weights(w), blocks, x, sums);
            }
            // `Linear::run` chooses the kernel by the format.
            _ => {}
        }
    }

    /// Computes a panel's outputs from its sums and stores them.
    #[inline(always)]
    fn finish<S: Simd>(&self, simd: S, panel: PanelRef, sums: &Sums, pair: &mut RowPair) {
        for (y, sums) in pair.y.iter_mut().zip(sums).take(pair.rows) {
            let sums = sums.get(..panel.blocks).unwrap_or(&[]);
            for (block, sums) in sums.iter().enumerate() {
                self.finish_block(simd, sums, panel.first + block * LANES, y);
            }
        }
    }

    /// Applies scale, bias and activation to the up to sixteen outputs from `first` on, and stores
    /// them.
    #[inline(always)]
    fn finish_block<S: Simd>(&self, simd: S, sums: &Block, first: usize, y: &mut [f32]) {
        let layer = self.layer;
        let mut spare = [0.0; LANES];
        let mut v = simd.load(sums);
        if let Panels::Int8 { scales, .. } | Panels::Int16 { scales, .. } = layer.w {
            v = simd.mul(v, simd.load(block(scales, first, &mut spare)));
        }
        v = simd.add(v, simd.load(block(layer.bias, first, &mut spare)));
        v = self.activation.apply(simd, v);
        if layer.accumulate {
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
