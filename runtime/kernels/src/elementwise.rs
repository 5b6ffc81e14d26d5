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
        match self.kind {
            UnaryKind::Exp
            | UnaryKind::Tanh
            | UnaryKind::Sigmoid
            | UnaryKind::Softplus
            | UnaryKind::Mish
            | UnaryKind::Elu => isa.run(Exponential { unary: self, y }),
            UnaryKind::Log => by_call(y, math::log),
            UnaryKind::Erf => by_call(y, math::erf),
            UnaryKind::Trunc => by_call(y, math::trunc),
            UnaryKind::Sqrt => by_call(y, math::sqrt),
            UnaryKind::Rsqrt => by_call(y, |x| 1.0 / math::sqrt(x)),
            _ => in_blocks(y, |x| self.short(x)),
        }
    }

    /// Computes a block of a function of an instruction or two: wider vectors gain nothing, so that its code is there once for all
    /// instruction sets.
    fn short(self, x: &mut Block) {
        match self.kind {
            UnaryKind::Relu => each(x, math::relu),
            UnaryKind::LeakyRelu => each(x, |x| math::leaky_relu(x, self.alpha)),
            UnaryKind::Neg => each(x, |x| -x),
            UnaryKind::Abs => each(x, f32::abs),
            UnaryKind::Recip => each(x, |x| 1.0 / x),
            UnaryKind::Square => each(x, |x| x * x),
            _ => {}
        }
    }

    /// Computes a block of a function that stands on the exponential, whose long code is there once for all of them.
    #[inline(always)]
    #[expect(
        clippy::indexing_slicing,
        reason = "constant bounds; compilers vectorise this form best"
    )]
    fn long(self, x: &mut Block) {
        let mut e = *x;
        match self.kind {
            UnaryKind::Tanh => each(&mut e, math::tanh_exponent),
            UnaryKind::Sigmoid => each(&mut e, |x| -x),
            UnaryKind::Softplus => each(&mut e, |x| -x.abs()),
            UnaryKind::Mish => each(&mut e, math::mish_exponent),
            UnaryKind::Elu => each(&mut e, math::elu_exponent),
            _ => {}
        }
        let mut powers = [0; LANES];
        for i in 0..LANES {
            (powers[i], e[i]) = math::split(e[i]);
        }
        if self.kind == UnaryKind::Elu {
            for i in 0..LANES {
                x[i] = math::elu_of(x[i], self.alpha, (powers[i], e[i]));
            }
            return;
        }
        for i in 0..LANES {
            e[i] = math::exp_of((powers[i], e[i]));
        }
        match self.kind {
            UnaryKind::Tanh => combine(x, &e, math::tanh_of),
            UnaryKind::Sigmoid => combine(x, &e, |_, e| math::sigmoid_of(e)),
            UnaryKind::Softplus => combine(x, &e, math::softplus_of),
            UnaryKind::Mish => combine(x, &e, math::mish_of),
            _ => *x = e,
        }
    }
}

/// Operands of a running function that stands on the exponential.
struct Exponential<'a> {
    unary: Unary,
    y: &'a mut [f32],
}

impl Kernel for Exponential<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        in_blocks(self.y, |x| self.unary.long(x));
    }
}

/// Computes a function that no vector instruction computes, in one loop for all of them.
#[inline(never)]
fn by_call(y: &mut [f32], f: fn(f32) -> f32) {
    for y in y {
        *y = f(*y);
    }
}

#[inline(always)]
fn each(block: &mut Block, f: impl Fn(f32) -> f32) {
    for x in block {
        *x = f(*x);
    }
}

/// Computes `x[i] = f(x[i], other[i])`.
///
/// By index: of two iterators compilers have made a loop over single elements, in which a selection is a branch, so that the time depends on
/// the values.
#[inline(always)]
#[expect(
    clippy::indexing_slicing,
    reason = "constant bounds; compilers vectorise this form best"
)]
pub(crate) fn combine(x: &mut Block, other: &Block, f: impl Fn(f32, f32) -> f32) {
    for i in 0..LANES {
        x[i] = f(x[i], other[i]);
    }
}

/// Calls `f` with all elements in whole blocks, so that a few elements take no longer than a vector of them, and code for what is left is
/// there once.
#[inline(always)]
fn in_blocks(y: &mut [f32], mut f: impl FnMut(&mut Block)) {
    for y in y.chunks_mut(LANES) {
        let mut spare = [0.0; LANES];
        let whole = y.len() == LANES;
        let x: &mut Block = if let Some(block) = y.first_chunk_mut() {
            block
        } else {
            assign(&mut spare, y);
            &mut spare
        };
        f(x);
        if !whole {
            assign(y, &spare);
        }
    }
}
