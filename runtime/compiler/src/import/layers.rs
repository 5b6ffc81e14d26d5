//! Imports matrix products and softmax.

use lads_image::op::{BinaryKind, ReduceKind, UnaryKind};

use super::arithmetic::constant;
use super::attributes::Attributes;
use super::operators::Outputs;
use super::{Operands, shapes};
use crate::graph::{Dim, Graph, Id, Unary};

/// Adds a general matrix product, `alpha * A·B + beta * C`.
pub(super) fn gemm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
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

/// Adds a matrix product; a vector is a row on the left, a column on the right.
pub(super) fn matmul(g: &mut Graph, x: &Operands) -> Outputs {
    let (a, b) = (x.get(0)?, x.get(1)?);
    let (from_a, from_b) = (g.shape(a).to_vec(), g.shape(b).to_vec());
    let one = Dim::of(1);
    let row = match from_a[..] {
        [k] => g.reshape(a, &[one, k])?,
        _ => a,
    };
    let column = match from_b[..] {
        [k] => g.reshape(b, &[k, one])?,
        _ => b,
    };
    let y = g.matmul(row, column)?;
    let mut shape = g.shape(y).to_vec();
    if from_b.len() == 1 {
        shape.pop();
    }
    if from_a.len() == 1 {
        shape.remove(shape.len() - from_b.len().min(2));
    }
    g.reshape(y, &shape).map(|y| vec![y])
}

/// Normalises along an axis; in operator sets before 13 over all axes from one on, flattened.
fn distribution(
    g: &mut Graph,
    x: &Operands,
    a: &Attributes,
    over: impl Fn(&mut Graph, Id, usize) -> Result<Id, String>,
) -> Outputs {
    let value = x.get(0)?;
    if x.opset >= 13 {
        let axis = shapes::axis(g, value, a.int("axis", -1)?)?;
        return over(g, value, axis).map(|y| vec![y]);
    }
    let shape = g.shape(value).to_vec();
    let axis = shapes::axis(g, value, a.int("axis", 1)?)?;
    let inner = shapes::volume(&shape[axis..])?;
    let rows = g.reshape(value, &[&shape[..axis], &[inner]].concat())?;
    let y = over(g, rows, axis)?;
    g.reshape(y, &shape).map(|y| vec![y])
}

pub(super) fn softmax(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    distribution(g, x, a, Graph::softmax)
}

/// Adds a log-softmax, `x - max - log(sum(exp(x - max)))`.
pub(super) fn log_softmax(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    distribution(g, x, a, |g, x, axis| {
        let mut kept = g.shape(x).to_vec();
        kept[axis] = Dim::of(1);
        let max = g.reduce(ReduceKind::Max, x, axis)?;
        let max = g.reshape(max, &kept)?;
        let shifted = g.binary(BinaryKind::Sub, x, max)?;
        let exp = g.unary(Unary::of(UnaryKind::Exp), shifted)?;
        let sum = g.reduce(ReduceKind::Sum, exp, axis)?;
        let sum = g.reshape(sum, &kept)?;
        let log = g.unary(Unary::of(UnaryKind::Log), sum)?;
        g.binary(BinaryKind::Sub, shifted, log)
    })
}
