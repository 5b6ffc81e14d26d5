//! Convolutions with integer weights, over an image of integers that `image_integers` made, once for all that read it.
//!
//! ```text
//! for each panel of 16 outputs:                  [run][pair of inputs][16][2], one after the other in memory
//!     for each output pixel:
//!         for each 32 pairs of inputs, in the order of kernel rows, columns and channels:
//!             integers[0..16] = sum over pairs of  x[2l] * panel[l][0..16][0] + x[2l + 1] * panel[l][0..16][1]
//!             sum[0..16] += integers
//!         y[pixel][panel] = activation(sum * (scale * scale of the output) + bias + y)
//! ```
//!
//! A processor multiplies two pairs of 16-bit integers and adds the products in one instruction for each 32-bit lane, two or four times the
//! work of a multiplication and an addition of floats. Integers are not rounded, so tiles and instruction sets change no bit.
//!
//! Nothing overflows: [`conv_scale`] gives an output a scale with which the magnitudes of its weights in each 32 pairs sum to no more
//! than 131032, and `131032 * 16383 < 2^31`. For weights as random as a network's that is no bound, for equal ones it takes
//! three bits. Weights that were not made so wrap around, alike everywhere.

use core::hint::black_box;

use crate::conv::{NEAR, Runs, Sweep};
use crate::dispatch::{Isa, Kernel};
use crate::ending::Ending;
use crate::integers::Integer;
use crate::lanes::{Block, LANES};
use crate::linear::{Activation, INTEGERS, block};
use crate::simd::{Simd, prefetch_ahead};
use crate::stored::{Panels, WeightFormat, int8_scale, int16_scale};

/// Pairs of inputs whose products are added before they become floats.
const GROUP: usize = 32;

/// Largest sum of the magnitudes of an output's weights in a group, as integers before they are
/// rounded; rounding adds half of each.
const GROUP_SUM: f32 = 131_000.0;

/// Returns the number of elements of the packed weights of a convolution of `n` outputs that reads
/// [`Sweep::runs`]; an odd run is one longer.
pub const fn conv_integers_len([runs, len]: [usize; 2], n: usize) -> usize {
    n.div_ceil(LANES) * LANES * runs * len.next_multiple_of(2)
}

/// Packs `w`, `[runs * len, n]` row-major, into panels `[n / 16][runs][len / 2][16][2]`; columns are
/// rounded up to sixteen with zeros, and runs to whole pairs. For offline use.
///
/// # Panics
/// When `w` is not `runs * len * n` or `out` not [`conv_integers_len`] elements long.
pub fn conv_integers_pack<T: Copy + Default>(
    w: &[T],
    [runs, len]: [usize; 2],
    n: usize,
    out: &mut [T],
) {
    assert_eq!(w.len(), runs * len * n, "w is [runs * len, n]");
    assert_eq!(
        out.len(),
        conv_integers_len([runs, len], n),
        "out is conv_integers_len"
    );
    out.fill(T::default());
    let height = runs * len.next_multiple_of(2);
    for (l, row) in w.chunks_exact(n.max(1)).enumerate() {
        let l = packed_row(l, len);
        for (p, part) in row.chunks(LANES).enumerate() {
            let first = p * height * LANES + l / 2 * (2 * LANES) + l % 2;
            let to = out.get_mut(first..).unwrap_or(&mut []);
            for (to, &w) in to.iter_mut().step_by(2).zip(part) {
                *to = w;
            }
        }
    }
}

/// Returns where input `l` stands if each run is rounded up to whole pairs.
const fn packed_row(l: usize, len: usize) -> usize {
    match l.checked_div(len) {
        Some(run) => run * len.next_multiple_of(2) + l % len,
        None => 0,
    }
}

/// Returns the scale of one output's weights, which are given in the order of its inputs, in runs of
/// `len`: the smallest with which no weight is beyond `format`, and no sum of products overflows.
/// 1 if all weights are zero, and for formats without scales.
pub fn conv_scale(
    format: WeightFormat,
    weights: impl Iterator<Item = f32> + Clone,
    len: usize,
) -> f32 {
    match format {
        WeightFormat::Int16 => {}
        // 64 products of 127 and 16383 always fit.
        WeightFormat::Int8 => return int8_scale(weights),
        WeightFormat::F32 | WeightFormat::F16 | WeightFormat::Bf16 => return 1.0,
    }
    let (mut most, mut sum, mut group) = (0.0_f32, 0.0, 0);
    for (l, w) in weights.clone().enumerate() {
        let own = packed_row(l, len) / (2 * GROUP);
        if own != group {
            (sum, group) = (0.0, own);
        }
        sum += w.abs();
        most = most.max(sum);
    }
    int16_scale(weights).max(most / GROUP_SUM)
}

/// Convolution of an image of integers.
#[derive(Debug, Clone, Copy)]
pub struct IntegerConv<'w> {
    /// Geometry of the input, whose strides count integers, and of the output.
    pub sweep: Sweep,
    /// Number of input channels.
    pub c: usize,
    /// Number of output channels.
    pub n: usize,
    /// Packed weights: [`conv_integers_len`] elements, ordered by [`conv_integers_pack`], and scales
    /// `[n]`. Other weights than integers compute nothing.
    pub w: Panels<'w>,
    /// Bias `[n]`.
    pub bias: &'w [f32],
    /// Activation, applied last, after accumulation.
    pub activation: Activation,
    /// True if the sum is added to `y`.
    pub accumulate: bool,
}

impl IntegerConv<'_> {
    /// Computes `y` from the integers `x`, both starting at their first pixel, and the value of a unit
    /// of `x`. Behind the last input of an odd run there has to be one more integer, of any value. If
    /// a view or the weights are too short, `y` is unchanged.
    pub fn run(&self, isa: Isa, x: &[i16], scale: f32, y: &mut [f32]) {
        let runs = Runs::of(&self.sweep, self.c);
        let there = (self.sweep.reach(self.c))
            .and_then(|reach| reach.checked_add(runs.len % 2))
            .is_some_and(|reach| reach <= x.len());
        let pairs = (runs.times[0].checked_mul(runs.times[1]))
            .and_then(|times| times.checked_mul(runs.len.div_ceil(2)));
        let packed = pairs
            .zip(self.n.checked_next_multiple_of(LANES))
            .and_then(|(pairs, n)| pairs.checked_mul(n)?.checked_mul(2));
        let pairs = pairs.unwrap_or(0);
        if !INTEGERS || !there || pairs == 0 {
            return;
        }
        match self.w {
            Panels::Int16 { panels, scales } if packed == Some(panels.len()) => {
                let (w, _) = panels.as_chunks();
                self.pixels(isa, w, (scales, scale), (runs, pairs), x, y);
            }
            Panels::Int8 { panels, scales } if packed == Some(panels.len()) => {
                let (w, _) = panels.as_chunks();
                self.pixels(isa, w, (scales, scale), (runs, pairs), x, y);
            }
            _ => {}
        }
    }

    #[inline(always)]
    fn pixels<W: Integer>(
        &self,
        isa: Isa,
        w: &[[W; 2 * LANES]],
        (scales, scale): (&[f32], f32),
        (runs, pairs): (Runs, usize),
        x: &[i16],
        y: &mut [f32],
    ) {
        isa.run(Pixels {
            conv: self,
            runs,
            pairs,
            w,
            scales,
            scale,
            x,
            y,
        });
    }
}

/// Operands of a running convolution; `x` and the weights are long enough.
struct Pixels<'a, W> {
    conv: &'a IntegerConv<'a>,
    runs: Runs,
    /// Number of pairs of inputs.
    pairs: usize,
    w: &'a [[W; 2 * LANES]],
    scales: &'a [f32],
    scale: f32,
    x: &'a [i16],
    y: &'a mut [f32],
}

/// Largest numbers of panels and of pixels of a tile.
const MOST: [usize; 2] = [4, 6];

/// Sums of a tile, by panel, then pixel.
type Sums = [[Block; MOST[1]]; MOST[0]];

impl<W: Integer> Kernel for Pixels<'_, W> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let conv = self.conv;
        let [wide, high] = S::INTEGER_TILE;
        let pixels = conv.sweep.out[0] * conv.sweep.out[1];
        let panels = conv.n.div_ceil(LANES);
        let near = (NEAR * size_of::<f32>() / (self.pairs * size_of::<[W; 2 * LANES]>()).max(1))
            .min(panels);
        let near = near.next_multiple_of(wide).max(wide);
        let mut sums = [[[0.0; LANES]; MOST[1]]; MOST[0]];
        let ending = Ending {
            n: conv.n,
            bias: conv.bias,
            activation: conv.activation,
            accumulate: conv.accumulate,
        };
        let (whole, mut spare) = (simd.splat(self.scale), [0.0; LANES]);
        for first_panel in (0..panels).step_by(near) {
            let end = panels.min(first_panel + near);
            let mut first = 0;
            while first < pixels {
                let tiles = (pixels - first).div_ceil(high);
                let size = (pixels - first).div_ceil(tiles.max(1));
                let at = conv.sweep.pixels(first);
                let mut panel = first_panel;
                while panel < end {
                    let taken = match end - panel {
                        4.. if wide >= 4 => self.some::<S, 4>(simd, size, panel, &at, &mut sums),
                        2.. if wide >= 2 => self.some::<S, 2>(simd, size, panel, &at, &mut sums),
                        _ => self.some::<S, 1>(simd, size, panel, &at, &mut sums),
                    };
                    for (b, sums) in sums.iter().enumerate().take(black_box(taken)) {
                        let first = (panel + b) * LANES;
                        let scales = simd.load(block(self.scales, first, &mut spare));
                        let scales = Some(simd.mul(whole, scales));
                        ending.end(simd, (sums, scales), &at, [size, first], self.y);
                    }
                    panel += taken;
                }
                first += size;
            }
        }
    }
}

impl<W: Integer> Pixels<'_, W> {
    /// Computes the sums of the first `size` of some pixels with `B` panels, and returns `B`.
    #[inline(always)]
    fn some<S: Simd, const B: usize>(
        &self,
        simd: S,
        size: usize,
        panel: usize,
        at: &[[usize; 2]; MOST[1]],
        out: &mut Sums,
    ) -> usize {
        match size {
            6 if S::INTEGER_TILE[1] >= 6 => self.sums::<S, 6, B>(simd, panel, at, out),
            5 if S::INTEGER_TILE[1] >= 6 => self.sums::<S, 5, B>(simd, panel, at, out),
            4 if S::INTEGER_TILE[1] >= 6 => self.sums::<S, 4, B>(simd, panel, at, out),
            3 => self.sums::<S, 3, B>(simd, panel, at, out),
            2 => self.sums::<S, 2, B>(simd, panel, at, out),
            _ => self.sums::<S, 1, B>(simd, panel, at, out),
        }
        B
    }

    /// Computes the sums of `P` pixels with the `B` panels from `first` on. Missing runs add nothing.
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
        &self,
        simd: S,
        first: usize,
        at: &[[usize; 2]; MOST[1]],
        out: &mut Sums,
    ) {
        let pairs = self.runs.len.div_ceil(2);
        let mut integers = [[simd.zeros(); P]; B];
        let mut sums = [[simd.splat(0.0); P]; B];
        let mut l = first * self.pairs;
        let mut left = GROUP;
        for ky in 0..self.runs.times[0] {
            for kx in 0..self.runs.times[1] {
                let offset = ky * self.runs.apart[0] + kx * self.runs.apart[1];
                let x: [&[[i16; 2]]; P] = core::array::from_fn(|p| {
                    let first = at[p][0] + offset;
                    let run = self.x.get(first..first + 2 * pairs).unwrap_or(&[]);
                    run.as_chunks().0
                });
                let w: [&[[W; 2 * LANES]]; B] = core::array::from_fn(|b| {
                    let l = l + b * self.pairs;
                    self.w.get(l..l + pairs).unwrap_or(&[])
                });
                l += pairs;
                if x.iter().any(|x| x.len() != pairs) || w.iter().any(|w| w.len() != pairs) {
                    continue;
                }
                let mut i = 0;
                while i < pairs {
                    let end = pairs.min(i + left);
                    left -= end - i;
                    while i < end {
                        let w: [S::Pairs; B] = core::array::from_fn(|b| {
                            // SAFETY: each `w[b]` has as many elements as the run has pairs, as compared above, and `i` is below.
                            let w = unsafe { w[b].get_unchecked(i) };
                            prefetch_ahead(i, w);
                            W::load(simd, w)
                        });
                        for p in 0..P {
                            // SAFETY: each `x[p]` has as many elements as the run has pairs, as compared above, and `i` is below.
                            let x = simd.splat_pair(unsafe { x[p].get_unchecked(i) });
                            for b in 0..B {
                                integers[b][p] = simd.add_products(integers[b][p], w[b], x);
                            }
                        }
                        i += 1;
                    }
                    if left == 0 {
                        left = GROUP;
                        for (sums, integers) in sums.iter_mut().zip(&mut integers) {
                            for (sum, integers) in sums.iter_mut().zip(integers) {
                                *sum = simd.add(*sum, simd.floats(*integers));
                                *integers = simd.zeros();
                            }
                        }
                    }
                }
            }
        }
        for (out, (sums, integers)) in out.iter_mut().zip(sums.into_iter().zip(integers)) {
            for (out, (sum, integers)) in out.iter_mut().zip(sums.into_iter().zip(integers)) {
                simd.store(simd.add(sum, simd.floats(integers)), out);
            }
        }
    }
}
