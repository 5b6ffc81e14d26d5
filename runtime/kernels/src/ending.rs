//! How a tile of a convolution ends: sums are scaled, get the bias and what is there already, then the activation, and are stored.

use core::hint::black_box;

use crate::elementwise::assign;
use crate::lanes::{Block, LANES};
use crate::linear::{Activation, block};
use crate::simd::Simd;

/// What a convolution does with its sums.
pub(crate) struct Ending<'w> {
    /// Number of output channels.
    pub n: usize,
    /// Bias `[n]`.
    pub bias: &'w [f32],
    /// Activation, applied last, after accumulation.
    pub activation: Activation,
    /// True if the sum is added to what is there.
    pub accumulate: bool,
}

impl Ending<'_> {
    /// Ends the sums of sixteen channels from `first` on at the first `size` of some pixels, whose places in `y` are the second of each
    /// pair `at`; `scales` are those of sums of integers. Compiled once for all sizes and not unrolled for each, because activations are
    /// long.
    #[inline(always)]
    pub fn end<S: Simd>(
        &self,
        simd: S,
        (sums, scales): (&[Block], Option<S::V>),
        at: &[[usize; 2]],
        [size, first]: [usize; 2],
        y: &mut [f32],
    ) {
        let mut spare = [0.0; LANES];
        let bias = simd.load(block(self.bias, first, &mut spare));
        let width = LANES.min(self.n - first);
        for (sum, [_, at]) in sums.iter().zip(at).take(black_box(size)) {
            let y = y.get_mut(at.saturating_add(first)..).unwrap_or(&mut []);
            let mut v = simd.load(sum);
            if let Some(scales) = scales {
                v = simd.mul(v, scales);
            }
            self.store(simd, simd.add(v, bias), y, width);
        }
    }

    /// Adds what is there if asked to, applies the activation to the first `width` of sixteen outputs, and stores them.
    #[inline(always)]
    fn store<S: Simd>(&self, simd: S, mut v: S::V, y: &mut [f32], width: usize) {
        let mut spare = [0.0; LANES];
        if self.accumulate {
            v = simd.add(v, simd.load(block(y, 0, &mut spare)));
        }
        let v = self.activation.apply(simd, v);
        if width == LANES
            && let Some(y) = y.first_chunk_mut()
        {
            simd.store(v, y);
        } else {
            simd.store(v, &mut spare);
            assign(y.get_mut(..width).unwrap_or(&mut []), &spare);
        }
    }
}
