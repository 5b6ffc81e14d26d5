//! Dense layers over packed weights: `y = (accumulate ? y : 0) + activation(x·W + b)`.
//!
//! ```text
//! for each panel of up to 64 outputs:          [k][64], one after the other in memory
//!     for l in 0..k:  sum[0..64] += x[l] * panel[l][0..64]
//!     y[panel] = activation(sum * scale + bias)
//! ```
//!
//! Memory is read strictly in order, once: then the processor's own prefetcher keeps up, and a layer takes the time of a bare
//! sweep over its bytes, from whichever cache they come. That prefetcher stops at the end of a page, so each panel asks for one line
//! of every page of the next: measured at a robot's pace, when weights are in memory, this takes a fifth off `low_level/act`, and
//! nothing off or on where they are in a cache. (To ask for every line costs a third there and gains nothing here.) Rows of `x` go
//! through a panel in pairs: the two tokens of a control step read each weight once. A target with few registers takes a
//! panel in parts. Each output is one sum in the order of `k`, then the scale, then the bias, whatever the number of rows or parts.

use core::hint::black_box;

use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
use crate::lanes::{Block, LANES};
use crate::math;
use crate::simd::{Simd, prefetch};
use crate::stored::{Bf16, F16, F32, Int8, Panels, Stored};

/// Blocks of sixteen outputs in a whole panel.
const PANEL_BLOCKS: usize = 4;

/// Bytes of a page.
const PAGE: usize = 4096;

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
    fn apply<S: Simd>(self, simd: S, x: S::V) -> S::V {
        #[inline(always)]
        fn each<S: Simd>(simd: S, x: S::V, f: impl Fn(f32) -> f32) -> S::V {
            let mut block = [0.0; LANES];
            simd.store(x, &mut block);
            for x in &mut block {
                *x = f(*x);
            }
            simd.load(&block)
        }
        match self {
            Self::None => x,
            Self::Relu => simd.where_negative(x, simd.splat(0.0)),
            Self::LeakyRelu(alpha) => simd.where_negative(x, simd.mul(simd.splat(alpha), x)),
            Self::Tanh => each(simd, x, math::tanh),
            Self::Sigmoid => each(simd, x, math::sigmoid),
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
            Panels::F32(_) => isa.run(Rows::<false> { layer, x, y }),
            _ => isa.run(Rows::<true> { layer, x, y }),
        }
    }

    /// The sums of `R` rows with the panel of so many blocks that begins at weight `start`.
    #[inline(always)]
    fn panel<S: Simd, const R: usize, const NARROW: bool>(
        &self,
        simd: S,
        (start, blocks): (usize, usize),
        x: [&[f32]; R],
        sums: &mut Sums,
    ) {
        #[inline(always)]
        fn part<T>(w: &[T], start: usize, len: usize) -> &[T] {
            w.get(start..start + len).unwrap_or(&[])
        }
        let len = blocks * LANES * self.k;
        match self.w {
            Panels::F32(w) if !NARROW => {
                panel::<S, F32, R>(simd, part(w, start, len), blocks, x, sums);
            }
            Panels::F16(w) if NARROW => {
                panel::<S, F16, R>(simd, part(w, start, len), blocks, x, sums);
            }
            Panels::Bf16(w) if NARROW => {
                panel::<S, Bf16, R>(simd, part(w, start, len), blocks, x, sums);
            }
            Panels::Int8 { panels: w, .. } if NARROW => {
                panel::<S, Int8, R>(simd, part(w, start, len), blocks, x, sums);
            }
            // `run` chooses the kernel by the format.
            _ => {}
        }
    }

    /// Scale, bias, activation and store of sixteen outputs from `first` on, or of as many as there are.
    #[inline(always)]
    fn finish<S: Simd>(&self, simd: S, sums: &Block, first: usize, y: &mut [f32]) {
        let mut spare = [0.0; LANES];
        let mut v = simd.load(sums);
        if let Panels::Int8 { scales, .. } = self.w {
            v = simd.mul(v, simd.load(block(scales, first, &mut spare)));
        }
        v = simd.add(v, simd.load(block(self.bias, first, &mut spare)));
        v = self.activation.apply(simd, v);
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

/// The sixteen elements from `first` on; what is missing is zero, in `spare`.
#[inline(always)]
fn block<'b>(x: &'b [f32], first: usize, spare: &'b mut Block) -> &'b Block {
    let x = x.get(first..).unwrap_or(&[]);
    if let Some(block) = x.first_chunk() {
        return block;
    }
    *spare = [0.0; LANES];
    assign(spare, x);
    spare
}

/// A layer at work, of 32-bit weights or `NARROW` ones, see [`Kernel::NARROW`].
struct Rows<'a, const NARROW: bool> {
    layer: &'a Linear<'a>,
    x: &'a [f32],
    y: &'a mut [f32],
}

/// The sums of one panel for two rows.
type Sums = [[Block; PANEL_BLOCKS]; 2];

impl<const NARROW: bool> Kernel for Rows<'_, NARROW> {
    const NARROW: bool = NARROW;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (k, n) = (self.layer.k, self.layer.n);
        let mut sums = [[[0.0; LANES]; PANEL_BLOCKS]; 2];
        for first in (0..n).step_by(PANEL) {
            let blocks = (n - first).div_ceil(LANES).min(PANEL_BLOCKS);
            let place = (first * k, blocks);
            let (mut x, mut y) = (self.x, &mut *self.y);
            while let Some((x0, rest)) = x.split_at_checked(k)
                && let Some((y0, others)) = y.split_at_mut_checked(n)
            {
                let (rows, second) = if let Some((x1, rest)) = rest.split_at_checked(k)
                    && let Some((y1, others)) = others.split_at_mut_checked(n)
                {
                    self.layer
                        .panel::<S, 2, NARROW>(simd, place, [x0, x1], &mut sums);
                    (x, y) = (rest, others);
                    (2, y1)
                } else {
                    self.layer
                        .panel::<S, 1, NARROW>(simd, place, [x0], &mut sums);
                    (x, y) = (&[], &mut []);
                    (1, Default::default())
                };
                // Written once for all widths and numbers of rows, and not unrolled by those who know them: activations are long.
                for (y, sums) in [y0, second].iter_mut().zip(&sums).take(black_box(rows)) {
                    let sums = black_box(sums.get(..blocks).unwrap_or(&[]));
                    for (block, sums) in sums.iter().enumerate() {
                        self.layer.finish(simd, sums, first + block * LANES, y);
                    }
                }
            }
        }
    }
}

/// One panel and `R` rows, in as many parts as the registers ask for.
#[inline(always)]
fn panel<S: Simd, W: Stored, const R: usize>(
    simd: S,
    w: &[W::Bits],
    blocks: usize,
    x: [&[f32]; R],
    sums: &mut Sums,
) {
    // Behind this panel lies the next, or the next layer.
    for page in (0..size_of_val(w)).step_by(PAGE) {
        prefetch(w.as_ptr_range().end.wrapping_byte_add(page));
    }
    let mut at = 0;
    while at < blocks {
        let (place, left) = ([at, blocks], blocks - at);
        at += if S::SUMS >= PANEL_BLOCKS * R && left >= PANEL_BLOCKS {
            sweep::<S, W, PANEL_BLOCKS, R>(simd, w, place, x, sums)
        } else if S::SUMS >= 2 * R && left >= 2 {
            sweep::<S, W, 2, R>(simd, w, place, x, sums)
        } else {
            sweep::<S, W, 1, R>(simd, w, place, x, sums)
        };
    }
}

/// The sums of `R` rows of `k` elements with `P` blocks, from block `at` on, of a panel of `blocks`; returns `P`.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn sweep<S: Simd, W: Stored, const P: usize, const R: usize>(
    simd: S,
    w: &[W::Bits],
    [at, blocks]: [usize; 2],
    x: [&[f32]; R],
    out: &mut Sums,
) -> usize {
    let (w, _) = w.as_chunks::<LANES>();
    let w = w.chunks_exact(blocks.max(1));
    if x.iter().any(|x| x.len() != w.len()) || at + P > blocks {
        return P;
    }
    let mut sums = [[simd.splat(0.0); P]; R];
    for (l, row) in w.enumerate() {
        // SAFETY: each `x[r]` is as long as `w`, as compared above, and `l` is an index of `w`.
        let x: [S::V; R] = x.map(|x| simd.splat(unsafe { *x.get_unchecked(l) }));
        for p in 0..P {
            // SAFETY: `row` has `blocks` elements, `at + P <= blocks`, as compared above, and `p < P`.
            let w = W::load(simd, unsafe { row.get_unchecked(at + p) });
            for (sums, &x) in sums.iter_mut().zip(&x) {
                sums[p] = simd.add_product(sums[p], x, w);
            }
        }
    }
    for (out, sums) in out.iter_mut().zip(sums) {
        for (out, sum) in out.iter_mut().skip(at).zip(sums) {
            simd.store(sum, out);
        }
    }
    P
}
