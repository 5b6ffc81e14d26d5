//! Naive twin of every kernel, written from its definition with sums in `f64`. For tests; slow, and
//! panics on bad shapes.
#![allow(
    clippy::indexing_slicing,
    reason = "twins read like the definition and run in tests only"
)]

mod images;

use crate::stored::from_f16;
use crate::{
    Activation, Attention, Axis, BinaryKind, Cache, MatMul, ReduceKind, Scaled, StridedCopy,
    UnaryKind,
};

pub use images::{conv, depthwise, integer_conv, pool, resize};

/// Applies a non-linearity to `x`.
pub fn activation(activation: Activation, x: f64) -> f64 {
    match activation {
        // NaN stays NaN.
        Activation::Relu | Activation::Clipped(_) if x < 0.0 => 0.0,
        Activation::Clipped(bound) if x > f64::from(bound) => f64::from(bound),
        Activation::None | Activation::Relu | Activation::Clipped(_) => x,
        Activation::LeakyRelu(alpha) => x.max(0.0) + f64::from(alpha) * x.min(0.0),
        Activation::Tanh => libm::tanh(x),
        Activation::Sigmoid => 1.0 / (1.0 + libm::exp(-x)),
        Activation::Elu(alpha) => x.max(0.0) + f64::from(alpha) * libm::expm1(x.min(0.0)),
        Activation::Softplus => softplus(x),
        Activation::Mish => x * libm::tanh(softplus(x)),
    }
}

/// Returns `log(1 + exp(x))`.
fn softplus(x: f64) -> f64 {
    x.max(0.0) + libm::log1p(libm::exp(-x.abs()))
}

/// Computes `activation(x·w + bias)` with `w` as `[k, n]`; `y` is `[m, n]` and `bias` may be empty.
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

/// Computes the layer norm of each row of `gamma.len()` elements.
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

/// Squares a number; `core` has no `powi`.
trait Square {
    fn powi_2(self) -> Self;
}

impl Square for f64 {
    fn powi_2(self) -> Self {
        self * self
    }
}

/// Computes the softmax of each row of `cols` elements.
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

/// Computes the attention of each query to the rows of the cache that it sees.
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
                        * f64::from(op.cache.key(width, op.heads, [row, c]))
                })
                .sum();
            let p = libm::exp(score * f64::from(op.scale));
            sum += p * f64::from(op.cache.value(width, op.heads, [row, col]));
            total += p;
        }
        *y = (sum / total) as f32;
    }
}

impl Cache<'_> {
    fn key(&self, width: usize, heads: usize, [row, col]: [usize; 2]) -> f32 {
        let at = key(width, row, col);
        match self {
            Self::F32 { keys, .. } => keys[at],
            Self::F16 { keys, .. } => from_f16(keys[at]),
            Self::Int8 { keys, .. } => scaled(keys, at, [width, heads], [row, col]),
        }
    }

    fn value(&self, width: usize, heads: usize, [row, col]: [usize; 2]) -> f32 {
        let at = row * width + col;
        match self {
            Self::F32 { values, .. } => values[at],
            Self::F16 { values, .. } => from_f16(values[at]),
            Self::Int8 { values, .. } => scaled(values, at, [width, heads], [row, col]),
        }
    }
}

/// Returns the number at a position of a cache of integers.
fn scaled(of: &Scaled, at: usize, [width, heads]: [usize; 2], [row, col]: [usize; 2]) -> f32 {
    let scales = &of.scales[col * heads / width * (of.scales.len() / heads)..];
    f32::from(of.integers[at]) * scales[row]
}

/// Returns the position of element `col` of key `row`.
pub fn key(width: usize, row: usize, col: usize) -> usize {
    (row / 16 * width + col) * 16 + row % 16
}

/// Computes a unary function of one element.
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
        UnaryKind::Elu => activation(Activation::Elu(alpha), x),
        UnaryKind::Softplus => activation(Activation::Softplus, x),
        UnaryKind::Mish => activation(Activation::Mish, x),
        UnaryKind::Trunc => libm::trunc(x),
    }) as f32
}

/// Computes a binary function of two elements.
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
        BinaryKind::Greater => f64::from(u8::from(a > b)),
        BinaryKind::Keep if b == 0.0 => 0.0,
        BinaryKind::Keep => a,
    }) as f32
}

/// Returns the offset of the `i`-th element of a shape in a strided layout.
pub fn offset(dims: [usize; 4], strides: [usize; 4], mut i: usize) -> usize {
    let mut offset = 0;
    for (dim, stride) in dims.into_iter().zip(strides).rev() {
        offset += i % dim * stride;
        i /= dim;
    }
    offset
}

/// Copies between two strided layouts.
pub fn copy(op: &StridedCopy, x: &[f32], y: &mut [f32]) {
    for i in 0..op.dims.iter().product() {
        y[offset(op.dims, op.y_strides, i)] = x[offset(op.dims, op.x_strides, i)];
    }
}

/// Reduces one axis.
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

/// Computes a batched matrix product.
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
