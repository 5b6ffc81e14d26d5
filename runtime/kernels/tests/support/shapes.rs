//! Shapes of convolutions for tests.

use lads_kernels::{Activation, Sweep};
use proptest::prelude::*;
use proptest::sample::select;

/// Generates activations that need nothing, little and much.
pub fn activation() -> impl Strategy<Value = Activation> {
    let all = [
        Activation::None,
        Activation::Relu,
        Activation::LeakyRelu(0.1),
        Activation::Clipped(0.5),
        Activation::Tanh,
        Activation::Elu(0.7),
    ];
    select(all.to_vec())
}

/// Generates sizes of rows, then columns.
pub fn pair(range: std::ops::Range<usize>) -> impl Strategy<Value = [usize; 2]> {
    [range.clone(), range]
}

/// Generates a sweep over pixels of `c` channels to pixels of `n`, with gaps between pixels and
/// between rows, and the lengths of both sides.
pub fn sweep(
    [c, n]: [usize; 2],
    [out, kernel, stride, dilation]: [[usize; 2]; 4],
    gaps: [usize; 2],
) -> (Sweep, [usize; 2]) {
    let covered =
        |axis: usize| (out[axis] - 1) * stride[axis] + (kernel[axis] - 1) * dilation[axis] + 1;
    let x_strides = [(c + gaps[0]) * covered(1) + gaps[1], c + gaps[0]];
    let y_strides = [(n + gaps[1]) * out[1] + gaps[0], n + gaps[1]];
    let sweep = Sweep {
        out,
        kernel,
        stride,
        dilation,
        x_strides,
        y_strides,
    };
    let len = |rows: usize, cols: usize, strides: [usize; 2], c: usize| {
        (rows - 1) * strides[0] + (cols - 1) * strides[1] + c
    };
    let lens = [
        len(covered(0), covered(1), x_strides, c),
        len(out[0], out[1], y_strides, n),
    ];
    (sweep, lens)
}

/// Returns whether everything but the written elements is unchanged.
pub fn untouched(sweep: &Sweep, n: usize, before: &[f32], after: &[f32]) -> bool {
    let [row, pixel] = sweep.y_strides;
    before
        .iter()
        .zip(after)
        .enumerate()
        .all(|(i, (before, after))| {
            let (line, inside) = (i / row, i % row);
            let written =
                line < sweep.out[0] && inside / pixel < sweep.out[1] && inside % pixel < n;
            written || before.to_bits() == after.to_bits()
        })
}
