//! Functions of one element.

use crate::math;

/// An operation on one element.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnaryKind {
    /// `max(x, 0)`
    Relu,
    /// `x` where `x >= 0`, else `alpha * x`.
    LeakyRelu,
    /// Hyperbolic tangent.
    Tanh,
    /// `1 / (1 + exp(-x))`
    Sigmoid,
    /// Natural exponential.
    Exp,
    /// Natural logarithm.
    Log,
    /// Square root.
    Sqrt,
    /// `1 / sqrt(x)`
    Rsqrt,
    /// `-x`
    Neg,
    /// Absolute value.
    Abs,
    /// `1 / x`
    Recip,
    /// Error function.
    Erf,
    /// `x * x`
    Square,
}

/// `y[i] = kind(x[i])`; `alpha` is the slope of `LeakyRelu`.
pub fn unary(kind: UnaryKind, alpha: f32, x: &[f32], y: &mut [f32]) {
    for (y, &x) in y.iter_mut().zip(x) {
        *y = x;
    }
    unary_in_place(kind, alpha, y);
}

/// `y[i] = kind(y[i])`; `alpha` is the slope of `LeakyRelu`.
pub fn unary_in_place(kind: UnaryKind, alpha: f32, y: &mut [f32]) {
    fn each(y: &mut [f32], f: impl Fn(f32) -> f32) {
        for y in y {
            *y = f(*y);
        }
    }
    match kind {
        UnaryKind::Relu => each(y, math::relu),
        UnaryKind::LeakyRelu => each(y, |x| math::leaky_relu(x, alpha)),
        UnaryKind::Tanh => each(y, math::tanh),
        UnaryKind::Sigmoid => each(y, math::sigmoid),
        UnaryKind::Exp => each(y, math::exp),
        UnaryKind::Log => each(y, math::log),
        UnaryKind::Sqrt => each(y, math::sqrt),
        UnaryKind::Rsqrt => each(y, |x| 1.0 / math::sqrt(x)),
        UnaryKind::Neg => each(y, |x| -x),
        UnaryKind::Abs => each(y, f32::abs),
        UnaryKind::Recip => each(y, |x| 1.0 / x),
        UnaryKind::Erf => each(y, math::erf),
        UnaryKind::Square => each(y, |x| x * x),
    }
}
