//! The naive twin of every kernel, written from its definition with sums in `f64`. For tests; slow, and panics on bad shapes.
#![allow(
    clippy::indexing_slicing,
    reason = "twins read like the definition and run in tests only"
)]

use crate::stored::from_f16;
use crate::{
    Activation, Attention, Axis, BinaryKind, Cache, MatMul, Pool, PoolKind, ReduceKind, Resize,
    StridedCopy, Sweep, UnaryKind,
};

/// `x`, after the non-linearity.
pub fn activation(activation: Activation, x: f64) -> f64 {
    match activation {
        Activation::None => x,
        Activation::Relu => x.max(0.0),
        Activation::LeakyRelu(alpha) => x.max(0.0) + f64::from(alpha) * x.min(0.0),
        Activation::Clipped(bound) => x.max(0.0).min(f64::from(bound)),
        Activation::Tanh => libm::tanh(x),
        Activation::Sigmoid => 1.0 / (1.0 + libm::exp(-x)),
    }
}

/// `activation(x·w + bias)` with `w` as `[k, n]`; `y` is `[m, n]` and `bias` may be empty.
pub fn linear(
    x: &[f32],
    w: &[f32],
    bias: &[f32],
    a: Activation,
    [k, n]: [usize; 2],
    y: &mut [f32],
) {
    for (i, y) in y.iter_mut().enumerate() {
        let (row, col) = (i / n, i % n);
        let sum: f64 = (0..k)
            .map(|l| f64::from(x[row * k + l]) * f64::from(w[l * n + col]))
            .sum();
        *y = activation(a, sum + bias.get(col).copied().map_or(0.0, f64::from)) as f32;
    }
}

/// Layer norm of each row of `gamma.len()` elements.
pub fn layer_norm(x: &[f32], gamma: &[f32], beta: &[f32], eps: f32, y: &mut [f32]) {
    let cols = gamma.len();
    for (i, y) in y.iter_mut().enumerate() {
        let row = &x[i / cols * cols..][..cols];
        let mean = row.iter().copied().map(f64::from).sum::<f64>() / cols as f64;
        let variance = row
            .iter()
            .map(|&x| (f64::from(x) - mean).powi_2())
            .sum::<f64>()
            / cols as f64;
        let centred = f64::from(x[i]) - mean;
        let scaled = centred / libm::sqrt(variance + f64::from(eps));
        *y = (scaled * f64::from(gamma[i % cols]) + f64::from(beta[i % cols])) as f32;
    }
}

/// `core` has no `powi`.
trait Square {
    fn powi_2(self) -> Self;
}

impl Square for f64 {
    fn powi_2(self) -> Self {
        self * self
    }
}

/// Softmax of each row of `cols` elements.
pub fn softmax(x: &[f32], cols: usize, y: &mut [f32]) {
    for (i, y) in y.iter_mut().enumerate() {
        let row = &x[i / cols * cols..][..cols];
        let sum: f64 = row
            .iter()
            .map(|&other| libm::exp(f64::from(other) - f64::from(x[i])))
            .sum();
        *y = (1.0 / sum) as f32;
    }
}

/// Attention of each query to the rows of the cache that it sees.
pub fn attention(op: &Attention, q: &[f32], y: &mut [f32]) {
    let width = op.heads * op.head_dim;
    for (i, y) in y.iter_mut().enumerate() {
        let (query, col) = (i / width, i % width);
        let head = col / op.head_dim * op.head_dim;
        let (mut sum, mut total) = (0.0, 0.0);
        for row in 0..op.visible + query {
            let score: f64 = (head..head + op.head_dim)
                .map(|c| {
                    f64::from(q[query * op.q_stride + c])
                        * f64::from(op.cache.key(key(width, row, c)))
                })
                .sum();
            let p = libm::exp(score * f64::from(op.scale));
            sum += p * f64::from(op.cache.value(row * width + col));
            total += p;
        }
        *y = (sum / total) as f32;
    }
}

impl Cache<'_> {
    fn key(&self, at: usize) -> f32 {
        match self {
            Self::F32 { keys, .. } => keys[at],
            Self::F16 { keys, .. } => from_f16(keys[at]),
        }
    }

    fn value(&self, at: usize) -> f32 {
        match self {
            Self::F32 { values, .. } => values[at],
            Self::F16 { values, .. } => from_f16(values[at]),
        }
    }
}

/// Where element `col` of key `row` lies.
pub fn key(width: usize, row: usize, col: usize) -> usize {
    (row / 16 * width + col) * 16 + row % 16
}

/// One element.
pub fn unary(kind: UnaryKind, alpha: f32, x: f32) -> f32 {
    let x = f64::from(x);
    (match kind {
        UnaryKind::Relu => activation(Activation::Relu, x),
        UnaryKind::LeakyRelu => activation(Activation::LeakyRelu(alpha), x),
        UnaryKind::Tanh => activation(Activation::Tanh, x),
        UnaryKind::Sigmoid => activation(Activation::Sigmoid, x),
        UnaryKind::Exp => libm::exp(x),
        UnaryKind::Log => libm::log(x),
        UnaryKind::Sqrt => libm::sqrt(x),
        UnaryKind::Rsqrt => 1.0 / libm::sqrt(x),
        UnaryKind::Neg => -x,
        UnaryKind::Abs => x.abs(),
        UnaryKind::Recip => 1.0 / x,
        UnaryKind::Erf => libm::erf(x),
        UnaryKind::Square => x * x,
    }) as f32
}

/// Two elements.
pub fn binary(kind: BinaryKind, a: f32, b: f32) -> f32 {
    let (a, b) = (f64::from(a), f64::from(b));
    (match kind {
        BinaryKind::Add => a + b,
        BinaryKind::Sub => a - b,
        BinaryKind::Mul => a * b,
        BinaryKind::Div => a / b,
        BinaryKind::Max => a.max(b),
        BinaryKind::Min => a.min(b),
        BinaryKind::Pow => libm::pow(a, b),
    }) as f32
}

/// The offset of the `i`-th element of a shape in a strided layout.
pub fn offset(dims: [usize; 4], strides: [usize; 4], mut i: usize) -> usize {
    let mut offset = 0;
    for (dim, stride) in dims.into_iter().zip(strides).rev() {
        offset += i % dim * stride;
        i /= dim;
    }
    offset
}

/// A strided copy.
pub fn copy(op: &StridedCopy, x: &[f32], y: &mut [f32]) {
    for i in 0..op.dims.iter().product() {
        y[offset(op.dims, op.y_strides, i)] = x[offset(op.dims, op.x_strides, i)];
    }
}

/// A reduction.
pub fn reduce(kind: ReduceKind, x: &[f32], axis: Axis, y: &mut [f32]) {
    for (i, y) in y.iter_mut().enumerate() {
        let first = i / axis.inner * axis.len * axis.inner + i % axis.inner;
        let elements = (0..axis.len).map(|a| f64::from(x[first + a * axis.inner]));
        *y = (match kind {
            ReduceKind::Sum => elements.sum::<f64>(),
            ReduceKind::Mean => elements.sum::<f64>() / axis.len as f64,
            ReduceKind::Max => elements.fold(f64::NEG_INFINITY, f64::max),
            ReduceKind::Min => elements.fold(f64::INFINITY, f64::min),
            ReduceKind::Prod => elements.product(),
        }) as f32;
    }
}

/// A matrix product.
pub fn matmul(op: &MatMul, a: &[f32], b: &[f32], y: &mut [f32]) {
    for (i, y) in y.iter_mut().enumerate() {
        let (batch, row, col) = (i / (op.m * op.n), i / op.n % op.m, i % op.n);
        *y = (0..op.k)
            .map(|l| {
                let a = a[batch * op.a_strides[0] + row * op.a_strides[1] + l * op.a_strides[2]];
                let b = b[batch * op.b_strides[0] + l * op.b_strides[1] + col * op.b_strides[2]];
                f64::from(a) * f64::from(b)
            })
            .sum::<f64>() as f32;
    }
}

/// A convolution with `w` as `[kernel rows, kernel columns, c, n]`, which is accumulated where `residual` is.
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

/// A depthwise convolution with `w` as `[kernel rows, kernel columns, c]`.
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

/// Where the input of a kernel element at an output pixel lies.
fn place(sweep: &Sweep, pixel: [usize; 2], element: [usize; 2]) -> usize {
    (0..2)
        .map(|axis| {
            let input = pixel[axis] * sweep.stride[axis] + element[axis] * sweep.dilation[axis];
            input * sweep.x_strides[axis]
        })
        .sum()
}

/// Windows over an image.
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

/// What is known of the elements of a window.
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

/// An image in another size.
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
