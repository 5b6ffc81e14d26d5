//! Naive twins of the kernels of images.

use super::activation;
use crate::{Activation, Pool, PoolKind, Resize, Sweep};

/// Computes a convolution with `w` as `[kernel rows, kernel columns, c, n]`, accumulated if
/// `residual` is set.
pub fn conv(
    sweep: &Sweep,
    (w, bias): (&[f32], &[f32]),
    (a, residual): (Activation, bool),
    x: &[f32],
    y: &mut [f32],
) {
    let n = bias.len();
    let [kh, kw] = sweep.kernel;
    let c = w.len() / (kh * kw * n);
    for (row, col) in (0..sweep.out[0]).flat_map(|row| (0..sweep.out[1]).map(move |col| (row, col)))
    {
        for j in 0..n {
            let at = row * sweep.y_strides[0] + col * sweep.y_strides[1] + j;
            let mut sum = f64::from(bias[j]) + if residual { f64::from(y[at]) } else { 0.0 };
            for (ky, kx) in (0..kh).flat_map(|ky| (0..kw).map(move |kx| (ky, kx))) {
                for i in 0..c {
                    let x = x[place(sweep, [row, col], [ky, kx]) + i];
                    sum += f64::from(x) * f64::from(w[((ky * kw + kx) * c + i) * n + j]);
                }
            }
            y[at] = activation(a, sum) as f32;
        }
    }
}

/// Computes a convolution of integers with `w` as `[kernel rows, kernel columns, c, n]`, accumulated
/// if `residual` is set; `scale` is the value of a unit of `x`, `scales` those of the outputs' weights.
pub fn integer_conv(
    sweep: &Sweep,
    (w, scales, bias): (&[i16], &[f32], &[f32]),
    (a, residual): (Activation, bool),
    (x, scale): (&[i16], f32),
    y: &mut [f32],
) {
    let n = bias.len();
    let [kh, kw] = sweep.kernel;
    let c = w.len() / (kh * kw * n);
    for (row, col) in (0..sweep.out[0]).flat_map(|row| (0..sweep.out[1]).map(move |col| (row, col)))
    {
        for j in 0..n {
            let mut sum = 0;
            for (ky, kx) in (0..kh).flat_map(|ky| (0..kw).map(move |kx| (ky, kx))) {
                for i in 0..c {
                    let x = x[place(sweep, [row, col], [ky, kx]) + i];
                    sum += i64::from(x) * i64::from(w[((ky * kw + kx) * c + i) * n + j]);
                }
            }
            let at = row * sweep.y_strides[0] + col * sweep.y_strides[1] + j;
            let before = if residual { f64::from(y[at]) } else { 0.0 };
            let sum = sum as f64 * f64::from(scale) * f64::from(scales[j]);
            y[at] = activation(a, sum + f64::from(bias[j]) + before) as f32;
        }
    }
}

/// Computes a depthwise convolution with `w` as `[kernel rows, kernel columns, c]`.
pub fn depthwise(
    sweep: &Sweep,
    (w, bias): (&[f32], &[f32]),
    a: Activation,
    x: &[f32],
    y: &mut [f32],
) {
    let c = bias.len();
    let [kh, kw] = sweep.kernel;
    for (row, col) in (0..sweep.out[0]).flat_map(|row| (0..sweep.out[1]).map(move |col| (row, col)))
    {
        for i in 0..c {
            let products = (0..kh * kw).map(|k| {
                let x = x[place(sweep, [row, col], [k / kw, k % kw]) + i];
                f64::from(x) * f64::from(w[k * c + i])
            });
            let sum = products.sum::<f64>() + f64::from(bias[i]);
            y[row * sweep.y_strides[0] + col * sweep.y_strides[1] + i] = activation(a, sum) as f32;
        }
    }
}

/// Returns the position of the input of a kernel element at an output pixel.
fn place(sweep: &Sweep, pixel: [usize; 2], element: [usize; 2]) -> usize {
    (0..2)
        .map(|axis| {
            let input = pixel[axis] * sweep.stride[axis] + element[axis] * sweep.dilation[axis];
            input * sweep.x_strides[axis]
        })
        .sum()
}

/// Pools windows over an image.
pub fn pool(op: &Pool, x: &[f32], y: &mut [f32]) {
    for (row, col) in (0..op.out[0]).flat_map(|row| (0..op.out[1]).map(move |col| (row, col))) {
        for i in 0..op.c {
            let (mut elements, mut padded) = (Elements::default(), 0_usize);
            for (ky, kx) in
                (0..op.kernel[0]).flat_map(|ky| (0..op.kernel[1]).map(move |kx| (ky, kx)))
            {
                // Counted from the padding's first row and column.
                let at = [
                    row * op.stride[0] + ky * op.dilation[0],
                    col * op.stride[1] + kx * op.dilation[1],
                ];
                let within =
                    |axis: usize, after: usize| at[axis] < op.before[axis] + op.size[axis] + after;
                if within(0, op.after[0]) && within(1, op.after[1]) {
                    padded += 1;
                }
                if (0..2).all(|axis| at[axis] >= op.before[axis] && within(axis, 0)) {
                    let [r, c] = [at[0] - op.before[0], at[1] - op.before[1]];
                    elements.add(x[r * op.x_strides[0] + c * op.x_strides[1] + i]);
                }
            }
            y[row * op.y_strides[0] + col * op.y_strides[1] + i] = match op.kind {
                PoolKind::Max => elements.largest,
                PoolKind::Mean => (elements.sum / elements.count.max(1.0)) as f32,
                PoolKind::PaddedMean => (elements.sum / padded.max(1) as f64) as f32,
            };
        }
    }
}

/// Statistics of the elements of a window.
struct Elements {
    largest: f32,
    sum: f64,
    count: f64,
}

impl Default for Elements {
    fn default() -> Self {
        Self {
            largest: f32::NEG_INFINITY,
            sum: 0.0,
            count: 0.0,
        }
    }
}

impl Elements {
    fn add(&mut self, x: f32) {
        self.largest = self.largest.max(x);
        self.sum += f64::from(x);
        self.count += 1.0;
    }
}

/// Resizes an image.
pub fn resize(op: &Resize, x: &[f32], y: &mut [f32]) {
    for (i, row) in op.rows.chunks(3).enumerate() {
        for (j, col) in op.cols.chunks(3).enumerate() {
            for channel in 0..op.c {
                let pixel = |row: f32, col: f32| {
                    let at = row as usize * op.x_strides[0] + col as usize * op.x_strides[1];
                    f64::from(x[at + channel])
                };
                let [along, down] = [col[2], row[2]].map(f64::from);
                let line =
                    |row: f32| pixel(row, col[0]) * (1.0 - along) + pixel(row, col[1]) * along;
                let mixed = line(row[0]) * (1.0 - down) + line(row[1]) * down;
                y[i * op.y_strides[0] + j * op.y_strides[1] + channel] = mixed as f32;
            }
        }
    }
}
