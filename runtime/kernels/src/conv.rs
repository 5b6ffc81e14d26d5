//! Convolutions over images `[rows, columns, channels]`: `y = activation(x * W + b + (accumulate ? y : 0))`.
//!
//! ```text
//! for each panel of 16 outputs:                  [kernel rows][kernel columns][c][16], one after the other in memory
//!     for each output pixel:
//!         for ky, kx, i:  sum[0..16] += x[pixel * stride + (ky, kx) * dilation][i] * panel[ky][kx][i][0..16]
//!         y[pixel][panel] = activation(sum + bias + y)
//! ```
//!
//! There is no padding: the border is stored in `x`, so every pixel is the same work; a kernel of
//! one row is a convolution over time. Departures for speed, none of which changes a sum:
//!
//! 1. Up to [`Simd::PIXELS`] pixels share each weight that is read, wherever in the image they lie; the pixels of an image are dealt
//!    out evenly, because a tile of one pixel reads as many weights as one of six.
//! 2. Pixels that follow one another in memory make a kernel row one run of `columns * c` inputs.
//! 3. Panels that fit the first-level cache together are gone through for each tile, so that `x` is read once for all of them.

use core::hint::black_box;

use crate::dispatch::{Isa, Kernel};
use crate::ending::Ending;
use crate::lanes::{Block, LANES};
use crate::linear::Activation;
use crate::simd::{Simd, prefetch_ahead};

/// Number of words of weights that are used for one tile of pixels before the next: a third of a
/// first-level cache.
pub(crate) const NEAR: usize = 4096;

/// Returns the number of elements of a `[k, n]` matrix in panels of sixteen outputs, `k` counting
/// kernel rows, columns and input channels.
pub const fn conv_packed_len([k, n]: [usize; 2]) -> usize {
    n.div_ceil(LANES) * LANES * k
}

/// Packs `w`, `[k, n]` row-major, into panels `[n / 16][k][16]`; columns are rounded up to sixteen
/// with zeros. For offline use.
///
/// # Panics
/// When `w` is not `k * n` or `out` not [`conv_packed_len`] elements long.
pub fn conv_pack<T: Copy + Default>(w: &[T], [k, n]: [usize; 2], out: &mut [T]) {
    assert_eq!(w.len(), k * n, "w is [k, n]");
    assert_eq!(out.len(), conv_packed_len([k, n]), "out is conv_packed_len");
    out.fill(T::default());
    for (l, row) in w.chunks_exact(n.max(1)).enumerate() {
        for (p, part) in row.chunks(LANES).enumerate() {
            let to = out.get_mut((p * k + l) * LANES..).unwrap_or(&mut []);
            for (to, &w) in to.iter_mut().zip(part) {
                *to = w;
            }
        }
    }
}

/// Geometry of a convolution: sizes, strides and dilation of its input and output. Sizes are given
/// for rows, then columns; strides are elements from a row to the next, then from a pixel to the
/// next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sweep {
    /// Number of output pixels.
    pub out: [usize; 2],
    /// Size of the kernel.
    pub kernel: [usize; 2],
    /// Input pixels from one output pixel to the next.
    pub stride: [usize; 2],
    /// Input pixels from one kernel element to the next.
    pub dilation: [usize; 2],
    /// Strides of the input, in elements.
    pub x_strides: [usize; 2],
    /// Strides of the output, in elements.
    pub y_strides: [usize; 2],
}

impl Sweep {
    /// Returns the number of elements of the input that are covered from the first to the last that
    /// is read, for pixels of `c` channels; `None` beyond `usize`.
    pub(crate) fn reach(&self, c: usize) -> Option<usize> {
        let mut reach = c;
        for axis in 0..2 {
            let get = |of: &[usize; 2]| of.get(axis).copied().unwrap_or(0);
            let outputs = get(&self.out)
                .checked_sub(1)?
                .checked_mul(get(&self.stride))?;
            let inside = get(&self.kernel)
                .checked_sub(1)?
                .checked_mul(get(&self.dilation))?;
            let last = outputs
                .checked_add(inside)?
                .checked_mul(get(&self.x_strides))?;
            reach = reach.checked_add(last)?;
        }
        Some(reach)
    }

    /// Returns how many runs of inputs, one after the other in memory, an output pixel reads, and the
    /// number of inputs of each, for pixels of `c` channels: the rows of the kernel if their pixels
    /// follow one another, else each of its pixels.
    pub fn runs(&self, c: usize) -> [usize; 2] {
        let runs = Runs::of(self, c);
        [runs.times[0].saturating_mul(runs.times[1]), runs.len]
    }

    /// Returns the distance in input elements from one element of the kernel to the next, down and
    /// along. A distance beyond a `usize` wraps: [`reach`](Self::reach) found that the kernel has no
    /// second element there.
    #[inline(always)]
    pub(crate) fn apart(&self) -> [usize; 2] {
        [
            self.dilation[0].wrapping_mul(self.x_strides[0]),
            self.dilation[1].wrapping_mul(self.x_strides[1]),
        ]
    }

    /// Returns the first input and the first output of `P` pixels, starting at pixel `first`. Pixels
    /// behind the last one are never accessed; their positions wrap or saturate, as do strides over
    /// a single row or column.
    #[inline(always)]
    pub(crate) fn pixels<const P: usize>(&self, first: usize) -> [[usize; 2]; P] {
        let (mut row, mut col) = (first / self.out[1].max(1), first % self.out[1].max(1));
        let (rows, cols) = (
            self.stride[0].wrapping_mul(self.x_strides[0]),
            self.stride[1].wrapping_mul(self.x_strides[1]),
        );
        let [y_row, y_col] = self.y_strides;
        [(); P].map(|()| {
            let at = [
                row.wrapping_mul(rows).wrapping_add(col.wrapping_mul(cols)),
                (row.saturating_mul(y_row)).saturating_add(col.saturating_mul(y_col)),
            ];
            col += 1;
            if col == self.out[1] {
                (row, col) = (row + 1, 0);
            }
            at
        })
    }
}

/// Convolution of `c` input channels and `n` output channels.
#[derive(Debug, Clone, Copy)]
pub struct Conv<'w> {
    /// Geometry of the input and output.
    pub sweep: Sweep,
    /// Number of input channels.
    pub c: usize,
    /// Number of output channels.
    pub n: usize,
    /// Packed weights: [`conv_packed_len`] elements, ordered by [`conv_pack`].
    pub w: &'w [f32],
    /// Bias `[n]`.
    pub bias: &'w [f32],
    /// Activation, applied last, after accumulation.
    pub activation: Activation,
    /// True if the sum is added to `y`.
    pub accumulate: bool,
}

impl Conv<'_> {
    /// Computes `y` from `x`, both starting at their first pixel. If a view or the weights are too
    /// short, `y` is unchanged.
    pub fn run(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        let [rows, cols] = self.sweep.kernel;
        let there = self
            .sweep
            .reach(self.c)
            .is_some_and(|reach| reach <= x.len());
        let k = (rows.checked_mul(cols)).and_then(|kernel| kernel.checked_mul(self.c));
        let packed = k
            .zip(self.n.checked_next_multiple_of(LANES))
            .and_then(|(k, n)| k.checked_mul(n));
        let k = k.unwrap_or(0);
        if there && k > 0 && packed == Some(self.w.len()) {
            isa.run(Pixels {
                conv: self,
                k,
                x,
                y,
            });
        }
    }
}

/// Operands of a running convolution; `x` and the weights are long enough.
struct Pixels<'a> {
    conv: &'a Conv<'a>,
    k: usize,
    x: &'a [f32],
    y: &'a mut [f32],
}

/// Runs of inputs that one output pixel reads: two nested counts, their distances, and the length
/// of a run.
pub(crate) struct Runs {
    pub times: [usize; 2],
    pub apart: [usize; 2],
    pub len: usize,
}

impl Runs {
    #[inline(always)]
    pub fn of(sweep: &Sweep, c: usize) -> Self {
        let [rows, cols] = sweep.kernel;
        let apart = sweep.apart();
        if apart[1] == c || cols == 1 {
            Self {
                times: [rows, 1],
                apart,
                len: cols.saturating_mul(c),
            }
        } else {
            Self {
                times: [rows, cols],
                apart,
                len: c,
            }
        }
    }
}

/// Largest numbers of panels and of pixels of a tile.
const MOST: [usize; 2] = [2, 6];

/// Sums of a tile, by panel, then pixel.
type Sums = [[Block; MOST[1]]; MOST[0]];

impl Kernel for Pixels<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let conv = self.conv;
        let runs = Runs::of(&conv.sweep, conv.c);
        let pixels = conv.sweep.out[0] * conv.sweep.out[1];
        let panels = conv.n.div_ceil(LANES);
        let near = (NEAR / (self.k * LANES).max(1)).min(panels);
        let near = near.next_multiple_of(S::PANELS).max(S::PANELS);
        let mut sums = [[[0.0; LANES]; MOST[1]]; MOST[0]];
        let ending = Ending {
            n: conv.n,
            bias: conv.bias,
            activation: conv.activation,
            accumulate: conv.accumulate,
        };
        for first_panel in (0..panels).step_by(near) {
            let end = panels.min(first_panel + near);
            let mut first = 0;
            while first < pixels {
                let tiles = (pixels - first).div_ceil(S::PIXELS);
                let size = (pixels - first).div_ceil(tiles.max(1));
                let at = conv.sweep.pixels(first);
                for panel in (first_panel..end).step_by(S::PANELS) {
                    let w = (conv.w, self.k, panel);
                    let taken = if S::PANELS == 2 && end - panel >= 2 {
                        some::<S, 2>(simd, size, &runs, w, self.x, &at, &mut sums);
                        2
                    } else {
                        some::<S, 1>(simd, size, &runs, w, self.x, &at, &mut sums);
                        1
                    };
                    for (b, sums) in sums.iter().enumerate().take(black_box(taken)) {
                        let place = [size, (panel + b) * LANES];
                        ending.end(simd, (sums, None), &at, place, self.y);
                    }
                }
                first += size;
            }
        }
    }
}

/// Computes the sums of the first `size` of some pixels with `B` panels.
#[inline(always)]
fn some<S: Simd, const B: usize>(
    simd: S,
    size: usize,
    runs: &Runs,
    w: (&[f32], usize, usize),
    x: &[f32],
    at: &[[usize; 2]; MOST[1]],
    out: &mut Sums,
) {
    match size {
        6 if S::PIXELS >= 6 => sums::<S, 6, B>(simd, runs, w, x, at, out),
        5 if S::PIXELS >= 6 => sums::<S, 5, B>(simd, runs, w, x, at, out),
        4 if S::PIXELS >= 6 => sums::<S, 4, B>(simd, runs, w, x, at, out),
        3 => sums::<S, 3, B>(simd, runs, w, x, at, out),
        2 => sums::<S, 2, B>(simd, runs, w, x, at, out),
        _ => sums::<S, 1, B>(simd, runs, w, x, at, out),
    }
}

/// Computes the sums of `P` pixels with `B` panels of `k` weights each, starting at panel `first`.
/// Missing runs add nothing.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "the sums stay in registers only without a branch in the loop, and compilers keep some of the bounds checks"
)]
fn sums<S: Simd, const P: usize, const B: usize>(
    simd: S,
    runs: &Runs,
    (w, k, first): (&[f32], usize, usize),
    x: &[f32],
    at: &[[usize; 2]; MOST[1]],
    out: &mut Sums,
) {
    let mut sums = [[simd.splat(0.0); P]; B];
    let (w, _) = w.as_chunks::<LANES>();
    let mut l = first * k;
    for ky in 0..runs.times[0] {
        for kx in 0..runs.times[1] {
            let offset = ky * runs.apart[0] + kx * runs.apart[1];
            let x: [&[f32]; P] = core::array::from_fn(|p| {
                let first = at[p][0] + offset;
                x.get(first..first + runs.len).unwrap_or(&[])
            });
            let w: [&[Block]; B] = core::array::from_fn(|b| {
                let l = l + b * k;
                w.get(l..l + runs.len).unwrap_or(&[])
            });
            l += runs.len;
            if x.iter().any(|x| x.len() != runs.len) || w.iter().any(|w| w.len() != runs.len) {
                continue;
            }
            for i in 0..runs.len {
                // SAFETY: each `w[b]` is as long as the run, as compared above.
                let w = w.map(|w| unsafe { w.get_unchecked(i) });
                let w = w.map(|w| {
                    prefetch_ahead(i, w);
                    simd.load(w)
                });
                for p in 0..P {
                    // SAFETY: each `x[p]` is as long as the run, as compared above.
                    let x = simd.splat(unsafe { *x[p].get_unchecked(i) });
                    for b in 0..B {
                        sums[b][p] = simd.add_product(sums[b][p], x, w[b]);
                    }
                }
            }
        }
    }
    for (out, sums) in out.iter_mut().zip(sums) {
        for (out, sum) in out.iter_mut().zip(sums) {
            simd.store(sum, out);
        }
    }
}
