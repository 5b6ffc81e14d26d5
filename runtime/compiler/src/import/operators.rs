//! What each ONNX operator becomes. Images are in [`images`](super::images), shapes and indices in [`shapes`](super::shapes), the LSTM in
//! [`recurrent`](super::recurrent).

use std::f32::consts::{FRAC_1_SQRT_2, SQRT_2};
use std::sync::Arc;

use lads_image::op::{BinaryKind, ReduceKind, UnaryKind};

use super::attributes::Attributes;
use super::{Operands, images, recurrent, shapes};
use crate::graph::{Dim, Graph, Id, Op, Type, Unary};
use crate::tensor::Tensor;

/// Values that a node gives.
pub(super) type Outputs = Result<Vec<Id>, String>;

/// Adds a node's operations to the graph.
pub(super) fn translate(g: &mut Graph, operator: &str, x: &Operands, a: &Attributes) -> Outputs {
    let unary = |g: &mut Graph, kind| g.unary(Unary::of(kind), x.get(0)?).map(|y| vec![y]);
    match operator {
        "Add" => fold(g, x, BinaryKind::Add, 2),
        "Sub" => fold(g, x, BinaryKind::Sub, 2),
        "Mul" => multiply(g, x.get(0)?, x.get(1)?).map(|y| vec![y]),
        "Div" => fold(g, x, BinaryKind::Div, 2),
        "Pow" => power(g, x),
        "Max" => fold(g, x, BinaryKind::Max, usize::MAX),
        "Min" => fold(g, x, BinaryKind::Min, usize::MAX),
        "Sum" => fold(g, x, BinaryKind::Add, usize::MAX),
        "Relu" => unary(g, UnaryKind::Relu),
        "Tanh" => unary(g, UnaryKind::Tanh),
        "Sigmoid" => unary(g, UnaryKind::Sigmoid),
        "Exp" => unary(g, UnaryKind::Exp),
        "Log" => unary(g, UnaryKind::Log),
        "Sqrt" => unary(g, UnaryKind::Sqrt),
        "Neg" => unary(g, UnaryKind::Neg),
        "Abs" => unary(g, UnaryKind::Abs),
        "Reciprocal" => unary(g, UnaryKind::Recip),
        "Erf" => unary(g, UnaryKind::Erf),
        "LeakyRelu" => {
            let alpha = a.float("alpha", 0.01)?.to_bits();
            let unary = Unary {
                alpha,
                ..Unary::of(UnaryKind::LeakyRelu)
            };
            g.unary(unary, x.get(0)?).map(|y| vec![y])
        }
        "Gelu" => gelu(g, x, a),
        "Clip" => clip(g, x),
        "MatMul" => g.matmul(x.get(0)?, x.get(1)?).map(|y| vec![y]),
        "Gemm" => gemm(g, x, a),
        "Softmax" => {
            let axis = shapes::axis(g, x.get(0)?, a.int("axis", -1)?)?;
            g.softmax(x.get(0)?, axis).map(|y| vec![y])
        }
        "LogSoftmax" => log_softmax(g, x, a),
        "LayerNormalization" => layer_norm(g, x, a),
        "BatchNormalization" => batch_norm(g, x, a),
        "ReduceSum" => reduce(g, x, a, ReduceKind::Sum, None),
        "ReduceMean" => reduce(g, x, a, ReduceKind::Mean, None),
        "ReduceMax" => reduce(g, x, a, ReduceKind::Max, None),
        "ReduceMin" => reduce(g, x, a, ReduceKind::Min, None),
        "ReduceProd" => reduce(g, x, a, ReduceKind::Prod, None),
        "ReduceSumSquare" => reduce(g, x, a, ReduceKind::Sum, Some(UnaryKind::Square)),
        "ReduceL1" => reduce(g, x, a, ReduceKind::Sum, Some(UnaryKind::Abs)),
        "ReduceL2" => {
            let sum = reduce(g, x, a, ReduceKind::Sum, Some(UnaryKind::Square))?;
            g.unary(Unary::of(UnaryKind::Sqrt), sum[0]).map(|y| vec![y])
        }
        "ArgMin" => arg(g, x, a, Op::ArgMin),
        "ArgMax" => arg(g, x, a, Op::ArgMax),
        "LSTM" => recurrent::lstm(g, x, a),
        "GRU" => recurrent::gru(g, x, a),
        _ => images::translate(g, operator, x, a),
    }
}

/// A binary operator over all inputs, from the left.
fn fold(g: &mut Graph, x: &Operands, kind: BinaryKind, most: usize) -> Outputs {
    x.at_most(most)?;
    let inputs = x.all()?;
    let mut y = x.get(0)?;
    for &input in &inputs[1..] {
        y = g.binary(kind, y, input)?;
    }
    Ok(vec![y])
}

fn constant(g: &mut Graph, value: f32) -> Id {
    g.add_const(Arc::new(Tensor::scalar(value)))
}

/// A value by itself is a square.
fn multiply(g: &mut Graph, a: Id, b: Id) -> Result<Id, String> {
    if a == b && g.ty(a) == Type::F32 {
        g.unary(Unary::of(UnaryKind::Square), a)
    } else {
        g.binary(BinaryKind::Mul, a, b)
    }
}

fn power(g: &mut Graph, x: &Operands) -> Outputs {
    let (base, exponent) = (x.get(0)?, x.get(1)?);
    // ONNX lets the exponent be an integer.
    let exponent = match g.constant(exponent).and_then(|tensor| tensor.as_i64()) {
        Some(values) => {
            let values = values.iter().map(|&value| value as f32).collect();
            let shape = g.known_shape(exponent).unwrap_or_default();
            g.add_const(Arc::new(Tensor::f32(&shape, values)))
        }
        None => exponent,
    };
    let plain = g.shape(exponent).iter().all(|dim| dim.is_one());
    let uniform = g
        .constant(exponent)
        .and_then(|tensor| tensor.uniform())
        .filter(|_| plain);
    let unary = |g: &mut Graph, kind| g.unary(Unary::of(kind), base);
    let y = match uniform {
        Some(2.0) => unary(g, UnaryKind::Square)?,
        Some(0.5) => unary(g, UnaryKind::Sqrt)?,
        Some(-0.5) => unary(g, UnaryKind::Rsqrt)?,
        Some(-1.0) => unary(g, UnaryKind::Recip)?,
        _ => return g.binary(BinaryKind::Pow, base, exponent).map(|y| vec![y]),
    };
    Ok(vec![y])
}

/// `x * 0.5 * (1 + erf(x / sqrt 2))`, or with the tanh approximation `0.5 x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3)))`.
fn gelu(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
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

fn clip(g: &mut Graph, x: &Operands) -> Outputs {
    x.at_most(3)?;
    let mut y = x.get(0)?;
    if let Some(low) = x.optional(1) {
        y = g.binary(BinaryKind::Max, y, low)?;
    }
    if let Some(high) = x.optional(2) {
        y = g.binary(BinaryKind::Min, y, high)?;
    }
    Ok(vec![y])
}

/// `alpha * A·B + beta * C`
fn gemm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let turn = |g: &mut Graph, id: Id, flag: bool| {
        if flag {
            g.transpose(id, &[1, 0])
        } else {
            Ok(id)
        }
    };
    let (mut left, mut right) = (x.get(0)?, x.get(1)?);
    if g.shape(left).len() != 2 || g.shape(right).len() != 2 {
        return Err("supports matrices only".into());
    }
    left = turn(g, left, a.flag("transA", false)?)?;
    right = turn(g, right, a.flag("transB", false)?)?;
    let (alpha, beta) = (a.float("alpha", 1.0)?, a.float("beta", 1.0)?);
    let mut y = g.matmul(left, right)?;
    let scaled = |g: &mut Graph, id: Id, by: f32| {
        let by = constant(g, by);
        g.binary(BinaryKind::Mul, id, by)
    };
    y = scaled(g, y, alpha)?;
    if let Some(bias) = x.optional(2)
        && beta != 0.0
    {
        let bias = scaled(g, bias, beta)?;
        let shape = g.shape(y).to_vec();
        y = g.binary(BinaryKind::Add, y, bias)?;
        if g.shape(y) != shape {
            return Err("has a bias that is larger than its product".into());
        }
    }
    Ok(vec![y])
}

/// `x - max - log(sum(exp(x - max)))`
fn log_softmax(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let x = x.get(0)?;
    let axis = shapes::axis(g, x, a.int("axis", -1)?)?;
    let mut kept = g.shape(x).to_vec();
    kept[axis] = Dim::of(1);
    let max = g.reduce(ReduceKind::Max, x, axis)?;
    let max = g.reshape(max, &kept)?;
    let shifted = g.binary(BinaryKind::Sub, x, max)?;
    let exp = g.unary(Unary::of(UnaryKind::Exp), shifted)?;
    let sum = g.reduce(ReduceKind::Sum, exp, axis)?;
    let sum = g.reshape(sum, &kept)?;
    let log = g.unary(Unary::of(UnaryKind::Log), sum)?;
    g.binary(BinaryKind::Sub, shifted, log).map(|y| vec![y])
}

/// A constant spread over the last axis of `x`, or one value where there is none.
fn per_column(g: &mut Graph, x: Id, id: Option<Id>, otherwise: f32) -> Result<Id, String> {
    let cols = *g
        .shape(x)
        .last()
        .ok_or("a scalar has no axis to normalise")?;
    let id = id.unwrap_or_else(|| constant(g, otherwise));
    if g.shape(id).iter().rev().skip(1).any(|dim| !dim.is_one()) {
        return Err("supports scales and biases over the last axis only".into());
    }
    let flat = g.shape(id).last().copied().unwrap_or(Dim::of(1));
    let id = g.reshape(id, &[flat])?;
    g.expand(id, &[cols])
}

fn layer_norm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let value = x.get(0)?;
    let eps = a.float("epsilon", 1e-5)?;
    a.only("stash_type", 1)?;
    let last = g
        .shape(value)
        .len()
        .checked_sub(1)
        .ok_or("a scalar has no axis to normalise")?;
    if shapes::axis(g, value, a.int("axis", -1)?)? != last {
        return Err("supports the last axis only".into());
    }
    let gamma = per_column(g, value, Some(x.get(1)?), 1.0)?;
    let beta = per_column(g, value, x.optional(2), 0.0)?;
    g.layer_norm(value, gamma, beta, eps).map(|y| vec![y])
}

/// `(x - mean) / sqrt(var + eps) * scale + bias` over axis 1, with constants: a scale and a shift.
fn batch_norm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    a.only("training_mode", 0)?;
    a.float("momentum", 0.9)?;
    let eps = a.float("epsilon", 1e-5)?;
    let value = x.get(0)?;
    let rank = g.shape(value).len();
    if rank < 2 {
        return Err("needs a batch and a channel axis".into());
    }
    let eps = constant(g, eps);
    let var = g.binary(BinaryKind::Add, x.get(4)?, eps)?;
    let inverse = g.unary(Unary::of(UnaryKind::Rsqrt), var)?;
    let scale = g.binary(BinaryKind::Mul, x.get(1)?, inverse)?;
    let moved = g.binary(BinaryKind::Mul, x.get(3)?, scale)?;
    let shift = g.binary(BinaryKind::Sub, x.get(2)?, moved)?;
    let mut along = vec![Dim::of(1); rank - 1];
    along[0] = g.shape(value)[1];
    let scale = g.reshape(scale, &along)?;
    let shift = g.reshape(shift, &along)?;
    let y = g.binary(BinaryKind::Mul, value, scale)?;
    g.binary(BinaryKind::Add, y, shift).map(|y| vec![y])
}

/// Over the axes of an attribute or an input, or all of them.
fn reduce(
    g: &mut Graph,
    x: &Operands,
    a: &Attributes,
    kind: ReduceKind,
    before: Option<UnaryKind>,
) -> Outputs {
    let mut y = x.get(0)?;
    let keep = a.flag("keepdims", true)?;
    let nothing = a.flag("noop_with_empty_axes", false)?;
    let named = match a.ints("axes")? {
        Some(axes) => axes.to_vec(),
        None => shapes::integers(g, x.optional(1))?.unwrap_or_default(),
    };
    let rank = g.shape(y).len();
    let mut axes = named
        .iter()
        .map(|&axis| shapes::axis(g, y, axis))
        .collect::<Result<Vec<_>, _>>()?;
    axes.sort_unstable();
    axes.dedup();
    if axes.is_empty() && !nothing {
        axes = (0..rank).collect();
    }
    let mut kept = g.shape(y).to_vec();
    if let Some(kind) = before {
        y = g.unary(Unary::of(kind), y)?;
    }
    for &axis in axes.iter().rev() {
        kept[axis] = Dim::of(1);
        y = g.reduce(kind, y, axis)?;
    }
    if keep {
        y = g.reshape(y, &kept)?;
    }
    Ok(vec![y])
}

/// Index along an axis, of one row.
fn arg(g: &mut Graph, x: &Operands, a: &Attributes, op: Op) -> Outputs {
    let value = x.get(0)?;
    a.only("select_last_index", 0)?;
    let keep = a.flag("keepdims", true)?;
    let axis = shapes::axis(g, value, a.int("axis", 0)?)?;
    let mut shape = g.shape(value).to_vec();
    if shape
        .iter()
        .enumerate()
        .any(|(i, dim)| i != axis && !dim.is_one())
    {
        return Err(format!(
            "supports one row only, not {}",
            crate::graph::show(&shape)
        ));
    }
    if keep {
        shape[axis] = Dim::of(1);
    } else {
        shape.remove(axis);
    }
    let index = g.arg(op, value)?;
    g.reshape(index, &shape).map(|y| vec![y])
}
