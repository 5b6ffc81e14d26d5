//! Measures the least that reading some weights can cost: a bare sweep over the same bytes, with the widest vectors of the CPU.
//!
//! Every kernel reads its weights once. What a kernel takes beyond this sweep over a block of the same size, in the same run, is
//! not the memory's fault.

#![allow(
    clippy::inline_always,
    reason = "the loop gets the vectors of the body that it is inlined into"
)]

use lads_host::Aligned;
use pulp::{Arch, Simd, WithSimd};

/// Memory to sweep over, where an image would lie too, and the machine's vectors.
#[derive(Debug)]
pub struct Sweep {
    words: Aligned,
    arch: Arch,
}

/// Number of vectors that are summed side by side: enough for the latency of an addition not to show.
const CHAINS: usize = 8;

struct Sum<'w>(&'w [f32]);

impl WithSimd for Sum<'_> {
    type Output = f32;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f32 {
        let (vectors, rest) = S::as_simd_f32s(self.0);
        let (blocks, tail) = vectors.as_chunks::<CHAINS>();
        let mut sums = [simd.splat_f32s(0.0); CHAINS];
        for block in blocks {
            for (sum, &vector) in sums.iter_mut().zip(block) {
                *sum = simd.add_f32s(*sum, vector);
            }
        }
        for (sum, &vector) in sums.iter_mut().zip(tail) {
            *sum = simd.add_f32s(*sum, vector);
        }
        let total = sums.into_iter().reduce(|a, b| simd.add_f32s(a, b));
        total.map_or(0.0, |total| simd.reduce_sum_f32s(total)) + rest.iter().sum::<f32>()
    }
}

impl Sweep {
    /// Allocates memory of `bytes`, rounded down to whole words.
    pub fn new(bytes: usize) -> Self {
        Self {
            words: Aligned::new(bytemuck::cast_slice(&vec![
                1.0_f32;
                bytes / size_of::<f32>()
            ])),
            arch: Arch::new(),
        }
    }

    /// Number of bytes that one sweep reads.
    pub fn bytes(&self) -> usize {
        self.words.as_bytes().len()
    }

    /// Reads all of the memory; returns the sum of its words.
    pub fn read(&self) -> f32 {
        self.arch
            .dispatch(Sum(bytemuck::cast_slice(self.words.as_bytes())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_word_is_read() {
        for words in [0, 1, 15, 16, 127, 128, 1000] {
            let sweep = Sweep::new(4 * words + 3);
            assert_eq!(sweep.bytes(), 4 * words);
            assert_eq!(sweep.read(), words as f32);
        }
    }
}
