//! Imports conditions, which are numbers that are 1 if true, else 0, and selections by them.

use std::sync::Arc;

use lads_image::op::{BinaryKind, UnaryKind};

use super::Operands;
use super::arithmetic::{binary, constant, number};
use super::operators::Outputs;
use crate::graph::{Dim, Graph, Id, Unary};
use crate::tensor::{Data, Tensor};

/// Comparison of two values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Comparison {
    Equal,
    Greater,
    GreaterOrEqual,
    Less,
    LessOrEqual,
}

/// Adds a comparison. For NaN, all but `Greater` and `Less` are true.
pub(super) fn compare(g: &mut Graph, x: &Operands, how: Comparison) -> Outputs {
    let (a, b) = (x.get(0)?, x.get(1)?);
    let mut greater = |a: Id, b: Id| -> Result<Id, String> {
        let holds = binary(g, BinaryKind::Greater, a, b)?;
        number(g, holds)
    };
    let y = match how {
        Comparison::Greater => greater(a, b)?,
        Comparison::Less => greater(b, a)?,
        Comparison::GreaterOrEqual => {
            let less = greater(b, a)?;
            negated(g, less)?
        }
        Comparison::LessOrEqual => {
            let more = greater(a, b)?;
            negated(g, more)?
        }
        Comparison::Equal => {
            let (more, less) = (greater(a, b)?, greater(b, a)?);
            let differs = g.binary(BinaryKind::Add, more, less)?;
            negated(g, differs)?
        }
    };
    Ok(vec![y])
}

/// Negates a condition, `1 - x`.
fn negated(g: &mut Graph, x: Id) -> Result<Id, String> {
    let one = constant(g, 1.0);
    g.binary(BinaryKind::Sub, one, x)
}

pub(super) fn not(g: &mut Graph, x: &Operands) -> Outputs {
    negated(g, x.get(0)?).map(|y| vec![y])
}

/// Combines two conditions by a binary operation.
pub(super) fn both(g: &mut Graph, x: &Operands, kind: BinaryKind) -> Outputs {
    g.binary(kind, x.get(0)?, x.get(1)?).map(|y| vec![y])
}

pub(super) fn either(g: &mut Graph, x: &Operands) -> Outputs {
    let differs = g.binary(BinaryKind::Sub, x.get(0)?, x.get(1)?)?;
    g.unary(Unary::of(UnaryKind::Square), differs)
        .map(|y| vec![y])
}

/// Tests whether a number is not zero.
pub(super) fn is_set(g: &mut Graph, x: Id) -> Result<Id, String> {
    let zero = constant(g, 0.0);
    let more = g.binary(BinaryKind::Greater, x, zero)?;
    let less = g.binary(BinaryKind::Greater, zero, x)?;
    g.binary(BinaryKind::Add, more, less)
}

/// Selects the second input where the first is true, else the third.
pub(super) fn select(g: &mut Graph, x: &Operands) -> Outputs {
    let (condition, a, b) = (x.get(0)?, x.get(1)?, x.get(2)?);
    let mut shape = g.shape(condition).to_vec();
    for side in [a, b] {
        shape = g.broadcast(&shape, side)?;
    }
    let chosen = g.constant(condition).and_then(|all| all.uniform());
    let y = if let Some(chosen) = chosen {
        if chosen == 0.0 { b } else { a }
    } else if let Some(y) = selected(g, condition, a, b, &shape)? {
        y
    } else {
        let (a, b) = (number(g, a)?, number(g, b)?);
        let otherwise = negated(g, condition)?;
        let is_zero = |g: &Graph, id| g.constant(id).and_then(|x| x.uniform()) == Some(0.0);
        let from = |g: &mut Graph, x, when| g.binary(BinaryKind::Keep, x, when);
        if is_zero(g, a) {
            from(g, b, otherwise)?
        } else if is_zero(g, b) {
            from(g, a, condition)?
        } else {
            let (a, b) = (from(g, a, condition)?, from(g, b, otherwise)?);
            g.binary(BinaryKind::Add, a, b)?
        }
    };
    g.expand(y, &shape).map(|y| vec![y])
}

/// Selects among constants, integers too, which gives a constant.
fn selected(
    g: &mut Graph,
    condition: Id,
    a: Id,
    b: Id,
    shape: &[Dim],
) -> Result<Option<Id>, String> {
    fn pick<T: Copy>(holds: &[f32], a: &[T], b: &[T]) -> Vec<T> {
        let pairs = holds.iter().zip(a.iter().zip(b));
        pairs
            .map(|(&holds, (&a, &b))| if holds == 0.0 { b } else { a })
            .collect()
    }
    if g.ty(a) != g.ty(b) || [condition, a, b].iter().any(|&id| g.constant(id).is_none()) {
        return Ok(None);
    }
    let mut spread = |id: Id| -> Result<Option<Arc<Tensor>>, String> {
        let id = g.expand(id, shape)?;
        Ok(g.constant(id).cloned())
    };
    let (Some(condition), Some(a), Some(b)) = (spread(condition)?, spread(a)?, spread(b)?) else {
        return Ok(None);
    };
    let Some(holds) = condition.as_f32() else {
        return Err("needs a condition of booleans".into());
    };
    let tensor = match (&a.data, &b.data) {
        (Data::F32(x), Data::F32(y)) => Tensor::f32(&a.shape, pick(holds, x, y)),
        (Data::I64(x), Data::I64(y)) => Tensor::i64(&a.shape, pick(holds, x, y)),
        _ => return Ok(None),
    };
    Ok(Some(g.add_const(Arc::new(tensor))))
}
