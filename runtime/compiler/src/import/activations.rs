//! Non-linearities that are composed of several operations.

use std::f32::consts::{FRAC_1_SQRT_2, SQRT_2};

use lads_image::op::{BinaryKind, UnaryKind};

use super::Operands;
use super::arithmetic::{constant, limited};
use super::attributes::Attributes;
use super::operators::Outputs;
use crate::graph::{Graph, Id, Unary};

/// Adds a GELU, `x * 0.5 * (1 + erf(x / sqrt 2))`, or with the tanh approximation
/// `0.5 x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3)))`.
pub(super) fn gelu(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let x = x.get(0)?;
    let bent = match a.text("approximate")?.as_deref() {
        None | Some("none") => {
            let scale = constant(g, FRAC_1_SQRT_2);
            let scaled = g.binary(BinaryKind::Mul, x, scale)?;
            g.unary(Unary::of(UnaryKind::Erf), scaled)?
        }
        Some("tanh") => {
            // sqrt(2 / pi)
            let outer = constant(g, SQRT_2 * 0.564_189_6);
            let cubic = constant(g, 0.044_715);
            let one = constant(g, 1.0);
            let square = g.unary(Unary::of(UnaryKind::Square), x)?;
            let inner = g.binary(BinaryKind::Mul, square, cubic)?;
            let inner = g.binary(BinaryKind::Add, inner, one)?;
            let inner = g.binary(BinaryKind::Mul, inner, x)?;
            let inner = g.binary(BinaryKind::Mul, inner, outer)?;
            g.unary(Unary::of(UnaryKind::Tanh), inner)?
        }
        Some(other) => return Err(format!("does not support approximate = {other}")),
    };
    let (one, half) = (constant(g, 1.0), constant(g, 0.5));
    let gate = g.binary(BinaryKind::Add, bent, one)?;
    let gate = g.binary(BinaryKind::Mul, gate, half)?;
    g.binary(BinaryKind::Mul, x, gate).map(|y| vec![y])
}

/// Adds an ELU: `x` where `x >= 0`, else `alpha * (exp(x) - 1)`.
pub(super) fn elu(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let elu = Unary::with(UnaryKind::Elu, a.float("alpha", 1.0)?);
    g.unary(elu, x.get(0)?).map(|y| vec![y])
}

/// Adds a SELU, `gamma * elu(x)`.
pub(super) fn selu(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let (alpha, gamma) = (a.float("alpha", 1.673_263_2)?, a.float("gamma", 1.050_701)?);
    let bent = g.unary(Unary::with(UnaryKind::Elu, alpha), x.get(0)?)?;
    scaled(g, bent, gamma).map(|y| vec![y])
}

/// Adds a CELU: `x` where `x >= 0`, else `alpha * (exp(x / alpha) - 1)`.
pub(super) fn celu(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let alpha = a.float("alpha", 1.0)?;
    let by = constant(g, alpha);
    let inner = g.binary(BinaryKind::Div, x.get(0)?, by)?;
    let bent = g.unary(Unary::with(UnaryKind::Elu, 1.0), inner)?;
    scaled(g, bent, alpha).map(|y| vec![y])
}

/// Adds a thresholded rectifier: `x` where `x > alpha`, else 0.
pub(super) fn thresholded_relu(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let x = x.get(0)?;
    let alpha = constant(g, a.float("alpha", 1.0)?);
    let above = g.binary(BinaryKind::Greater, x, alpha)?;
    g.binary(BinaryKind::Keep, x, above).map(|y| vec![y])
}

/// Adds a leaky rectifier with learned slopes: `x` where `x >= 0`, else `slope * x`.
pub(super) fn prelu(g: &mut Graph, x: &Operands) -> Outputs {
    let (x, slope) = (x.get(0)?, x.get(1)?);
    if let Some(slope) = g.constant(slope).and_then(|slope| slope.uniform()) {
        return g
            .unary(Unary::with(UnaryKind::LeakyRelu, slope), x)
            .map(|y| vec![y]);
    }
    let zero = constant(g, 0.0);
    let below = g.binary(BinaryKind::Min, x, zero)?;
    let below = g.binary(BinaryKind::Mul, below, slope)?;
    let above = g.unary(Unary::of(UnaryKind::Relu), x)?;
    g.binary(BinaryKind::Add, above, below).map(|y| vec![y])
}

/// Adds a hard sigmoid, `alpha * x + beta` between 0 and 1.
pub(super) fn hard_sigmoid(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let (alpha, beta) = (a.float("alpha", 0.2)?, a.float("beta", 0.5)?);
    ramp(g, x.get(0)?, alpha, beta).map(|y| vec![y])
}

/// Adds a hard swish: `x` times `x / 6 + 0.5` between 0 and 1.
pub(super) fn hard_swish(g: &mut Graph, x: &Operands) -> Outputs {
    let x = x.get(0)?;
    let gate = ramp(g, x, 1.0 / 6.0, 0.5)?;
    g.binary(BinaryKind::Mul, x, gate).map(|y| vec![y])
}

/// Adds a softsign, `x / (1 + |x|)`.
pub(super) fn softsign(g: &mut Graph, x: &Operands) -> Outputs {
    let x = x.get(0)?;
    let one = constant(g, 1.0);
    let size = g.unary(Unary::of(UnaryKind::Abs), x)?;
    let below = g.binary(BinaryKind::Add, size, one)?;
    g.binary(BinaryKind::Div, x, below).map(|y| vec![y])
}

/// Adds a swish, `x * sigmoid(alpha * x)`.
pub(super) fn swish(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let x = x.get(0)?;
    let inner = scaled(g, x, a.float("alpha", 1.0)?)?;
    let gate = g.unary(Unary::of(UnaryKind::Sigmoid), inner)?;
    g.binary(BinaryKind::Mul, x, gate).map(|y| vec![y])
}

fn scaled(g: &mut Graph, x: Id, by: f32) -> Result<Id, String> {
    let by = constant(g, by);
    g.binary(BinaryKind::Mul, x, by)
}

fn ramp(g: &mut Graph, x: Id, alpha: f32, beta: f32) -> Result<Id, String> {
    let inner = scaled(g, x, alpha)?;
    let beta = constant(g, beta);
    let line = g.binary(BinaryKind::Add, inner, beta)?;
    let (low, high) = (constant(g, 0.0), constant(g, 1.0));
    limited(g, line, Some(low), Some(high))
}
