//! Depthwise convolutions over images `[rows, columns, channels]`: each channel by itself, `y = activation(x * w + b)`.
//!
//! ```text
//! for each output pixel, for each sixteen channels:
//!     for ky, kx:  sum[0..16] += x[pixel * stride + (ky, kx) * dilation][0..16] * w[ky][kx][0..16]
//!     y[pixel][0..16] = activation(sum + bias)
//! ```
//!
//! As in [`Conv`](crate::Conv) there is no padding: the border is stored in `x`. Channels are the
//! lanes; a few pixels at a time share the weights that are read. Each output is one sum in the
//! order of the kernel.

use crate::conv::Sweep;
use crate::dispatch::{Isa, Kernel};
use crate::elementwise::assign;
use crate::ending::Ending;
use crate::lanes::{Block, LANES};
use crate::linear::{Activation, block};
use crate::simd::Simd;

/// Returns the number of elements of the packed weights of `kernel` kernel elements and `c`
/// channels.
pub const fn depthwise_packed_len([kernel, c]: [usize; 2]) -> usize {
    c.next_multiple_of(LANES) * kernel
}

/// Packs `w`, `[kernel, c]` row-major, into `[kernel][c]` with `c` rounded up to sixteen with
/// zeros. For offline use.
///
/// # Panics
/// When `w` is not `kernel * c` or `out` not [`depthwise_packed_len`] elements long.
pub fn depthwise_pack(w: &[f32], [kernel, c]: [usize; 2], out: &mut [f32]) {
    assert_eq!(w.len(), kernel * c, "w is [kernel, c]");
    assert_eq!(
        out.len(),
        depthwise_packed_len([kernel, c]),
        "out is depthwise_packed_len"
    );
    out.fill(0.0);
    let rows = out.chunks_exact_mut(c.next_multiple_of(LANES).max(1));
    for (to, w) in rows.zip(w.chunks_exact(c.max(1))) {
        assign(to, w);
    }
}

/// Depthwise convolution of `c` channels, each with a kernel of its own.
#[derive(Debug, Clone, Copy)]
pub struct Depthwise<'w> {
    /// Geometry of the input and output.
    pub sweep: Sweep,
    /// Number of channels.
    pub c: usize,
    /// Packed weights: [`depthwise_packed_len`] elements, ordered by [`depthwise_pack`].
    pub w: &'w [f32],
    /// Bias `[c]`.
    pub bias: &'w [f32],
    /// Activation, applied last.
    pub activation: Activation,
}

impl Depthwise<'_> {
    /// Computes `y` from `x`, both starting at their first pixel. If a view or the weights are too
    /// short, `y` is unchanged.
    pub fn run(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        let [rows, cols] = self.sweep.kernel;
        let there = (self.sweep.reach(self.c)).is_some_and(|reach| reach <= x.len());
        let packed = rows
            .checked_mul(cols)
            .zip(self.c.checked_next_multiple_of(LANES))
            .and_then(|(kernel, c)| kernel.checked_mul(c));
        if there && self.c > 0 && packed == Some(self.w.len()) {
            isa.run(Channels { layer: self, x, y });
        }
    }
}

/// Operands of a running depthwise convolution; `x` and the weights are long enough.
struct Channels<'a> {
    layer: &'a Depthwise<'a>,
    x: &'a [f32],
    y: &'a mut [f32],
}

/// Largest number of pixels that share the weights that are read.
const MOST: usize = 4;

impl Kernel for Channels<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let layer = self.layer;
        let pixels = layer.sweep.out[0] * layer.sweep.out[1];
        let mut out = [[0.0; LANES]; MOST];
        let ending = Ending {
            n: layer.c,
            bias: layer.bias,
            activation: layer.activation,
            accumulate: false,
        };
        let mut first = 0;
        while first < pixels {
            let at = layer.sweep.pixels(first);
            let size = match pixels - first {
                4.. if S::PIXELS >= 4 => 4,
                2.. => 2,
                _ => 1,
            };
            for channel in (0..layer.c).step_by(LANES) {
                match size {
                    4 if S::PIXELS >= 4 => {
                        sums::<S, 4>(simd, layer, self.x, &at, channel, &mut out);
                    }
                    2 => sums::<S, 2>(simd, layer, self.x, &at, channel, &mut out),
                    _ => sums::<S, 1>(simd, layer, self.x, &at, channel, &mut out),
                }
                ending.end(simd, (&out, None), &at, [size, channel], self.y);
            }
            first += size;
        }
    }
}

/// Computes the sums of sixteen channels of `P` pixels. Reads past a pixel's channels give zeros at
/// the last pixel and the next pixel's elements elsewhere; those results are unused.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "arrays whose length is a constant, as is every index"
)]
#[expect(
    unsafe_code,
    reason = "a load for each product: a branch for each of them would take longer than the products"
)]
fn sums<S: Simd, const P: usize>(
    simd: S,
    layer: &Depthwise,
    x: &[f32],
    at: &[[usize; 2]; MOST],
    channel: usize,
    out: &mut [Block; MOST],
) {
    let [rows, cols] = layer.sweep.kernel;
    let mut sums = [simd.splat(0.0); P];
    let wide = layer.c.next_multiple_of(LANES);
    let [down, along] = layer.sweep.apart();
    let last = channel + rows.saturating_sub(1) * down + cols.saturating_sub(1) * along;
    let mut places = at.iter().take(P).map(|&[at, _]| at);
    // `run` found the weights of every channel.
    let whole =
        places.all(|at| at + last + LANES <= x.len()) && rows * cols * wide <= layer.w.len();
    let mut spare: Block = [0.0; LANES];
    for ky in 0..rows {
        for kx in 0..cols {
            let offset = channel + ky * down + kx * along;
            let l = (ky * cols + kx) * wide + channel;
            if whole {
                // SAFETY: `l` is at most sixteen from the end of `rows * cols * wide` weights, as `channel` is a multiple of sixteen below
                // `wide`; each place is at most that of the last kernel element, after which sixteen inputs follow, as checked above.
                unsafe {
                    let w = simd.load(sixteen(layer.w, l));
                    for p in 0..P {
                        sums[p] =
                            simd.add_product(sums[p], simd.load(sixteen(x, at[p][0] + offset)), w);
                    }
                }
            } else {
                let w = simd.load(block(layer.w, l, &mut spare));
                for p in 0..P {
                    let x = simd.load(block(x, at[p][0] + offset, &mut spare));
                    sums[p] = simd.add_product(sums[p], x, w);
                }
            }
        }
    }
    for (out, sum) in out.iter_mut().zip(sums) {
        simd.store(sum, out);
    }
}

/// Returns the sixteen elements from `first` on.
///
/// # Safety
/// `x` has at least `first + 16` elements.
#[inline(always)]
#[expect(unsafe_code, reason = "see where it is called")]
unsafe fn sixteen(x: &[f32], first: usize) -> &Block {
    // SAFETY: the caller's promise.
    unsafe { &*x.as_ptr().add(first).cast() }
}
