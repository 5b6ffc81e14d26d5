//! Functions of one element.

use crate::dispatch::{Isa, Kernel};
use crate::lanes::{Block, LANES};
use crate::math;
use crate::simd::Simd;

/// Copies element by element up to the shorter slice's end: `copy_from_slice` without its panic.
#[inline(always)]
pub fn assign(to: &mut [f32], from: &[f32]) {
    for (to, &from) in to.iter_mut().zip(from) {
        *to = from;
    }
}

/// Functions of one element.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnaryKind {
    /// Rectifier, `max(x, 0)`.
    Relu,
    /// Leaky rectifier: `x` where `x >= 0`, else `alpha * x`.
    LeakyRelu,
    /// Hyperbolic tangent.
    Tanh,
    /// Logistic sigmoid, `1 / (1 + exp(-x))`.
    Sigmoid,
    /// Natural exponential.
    Exp,
    /// Natural logarithm.
    Log,
    /// Square root.
    Sqrt,
    /// Reciprocal square root, `1 / sqrt(x)`.
    Rsqrt,
    /// Negation, `-x`.
    Neg,
    /// Absolute value.
    Abs,
    /// Reciprocal, `1 / x`.
    Recip,
    /// Error function.
    Erf,
    /// Square, `x * x`.
    Square,
    /// Exponential linear unit: `x` where `x >= 0`, else `alpha * (exp(x) - 1)`.
    Elu,
    /// Softplus, `log(1 + exp(x))`.
    Softplus,
    /// Mish, `x * tanh(log(1 + exp(x)))`.
    Mish,
    /// Rounding towards zero.
    Trunc,
}

/// Unary operation on each element.
#[derive(Debug, Clone, Copy)]
pub struct Unary {
    /// Function to compute.
    pub kind: UnaryKind,
    /// Slope of [`UnaryKind::LeakyRelu`], factor of [`UnaryKind::Elu`].
    pub alpha: f32,
}

impl Unary {
    /// Computes `y[i] = kind(x[i])`.
    pub fn run(self, isa: Isa, x: &[f32], y: &mut [f32]) {
        assign(y, x);
        self.run_in_place(isa, y);
    }

    /// Computes `y[i] = kind(y[i])`.
    pub fn run_in_place(self, isa: Isa, y: &mut [f32]) {
        let Self { kind, alpha } = self;
        isa.run(Elements { kind, alpha, y });
    }
}

/// Operands of a running unary operation.
struct Elements<'a> {
    kind: UnaryKind,
    alpha: f32,
    y: &'a mut [f32],
}

impl Kernel for Elements<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        #[inline(always)]
        fn each(block: &mut Block, f: impl Fn(f32) -> f32) {
            for x in block {
                *x = f(*x);
            }
        }
        // In whole blocks, so that a few elements take no longer than a vector of them, and code for what is left is there once.
        for y in self.y.chunks_mut(LANES) {
            let mut spare = [0.0; LANES];
            let whole = y.len() == LANES;
            let x: &mut Block = if let Some(block) = y.first_chunk_mut() {
                block
            } else {
                assign(&mut spare, y);
                &mut spare
            };
            match self.kind {
                UnaryKind::Relu => each(x, math::relu),
                UnaryKind::LeakyRelu => each(x, |x| math::leaky_relu(x, self.alpha)),
                UnaryKind::Tanh => each(x, math::tanh),
                UnaryKind::Sigmoid => each(x, math::sigmoid),
                UnaryKind::Exp => each(x, math::exp),
                UnaryKind::Log => each(x, math::log),
                UnaryKind::Sqrt => each(x, math::sqrt),
                UnaryKind::Rsqrt => each(x, |x| 1.0 / math::sqrt(x)),
                UnaryKind::Neg => each(x, |x| -x),
                UnaryKind::Abs => each(x, f32::abs),
                UnaryKind::Recip => each(x, |x| 1.0 / x),
                UnaryKind::Erf => each(x, math::erf),
                UnaryKind::Square => each(x, |x| x * x),
                UnaryKind::Elu => each(x, |x| math::elu(x, self.alpha)),
                UnaryKind::Softplus => each(x, math::softplus),
                UnaryKind::Mish => each(x, math::mish),
                UnaryKind::Trunc => each(x, math::trunc),
            }
            if !whole {
                assign(y, &spare);
            }
        }
    }
}
