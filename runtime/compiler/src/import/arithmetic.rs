//! Arithmetic element by element.
//!
//! Integers that are constants, and an index plus or minus a constant, stay integers. All other
//! integers are floats when a program runs, exact up to 2^24.

use std::sync::Arc;

use lads_image::op::{BinaryKind, UnaryKind};

use super::Operands;
use super::attributes::Attributes;
use super::operators::Outputs;
use crate::graph::{Graph, Id, Op, Type, Unary};
use crate::tensor::{Data, Tensor};

/// Adds a binary operator over all inputs, from the left.
pub(super) fn fold(g: &mut Graph, x: &Operands, kind: BinaryKind, most: usize) -> Outputs {
    x.at_most(most)?;
    let inputs = x.all()?;
    let mut y = x.get(0)?;
    for &input in inputs.iter().skip(1) {
        y = binary(g, kind, y, input)?;
    }
    Ok(vec![y])
}

/// Adds a binary operation on two operands of either type.
pub(super) fn binary(g: &mut Graph, kind: BinaryKind, a: Id, b: Id) -> Result<Id, String> {
    let (constant_a, constant_b) = (g.constant(a).is_some(), g.constant(b).is_some());
    let sums = matches!(kind, BinaryKind::Add | BinaryKind::Sub);
    let whole = match (g.ty(a), g.ty(b)) {
        (Type::F32, Type::F32) => is_whole(g, a) && is_whole(g, b),
        (Type::I64, Type::I64) if constant_a && constant_b => return g.binary(kind, a, b),
        (Type::I64, Type::I64) if sums && constant_a != constant_b => {
            return g.binary(kind, a, b);
        }
        // One of the file's integers is a number by now.
        _ => true,
    };
    let (a, b) = (number(g, a)?, number(g, b)?);
    let y = g.binary(kind, a, b)?;
    if whole && kind == BinaryKind::Div {
        // Integers divide without a remainder.
        return g.unary(Unary::of(UnaryKind::Trunc), y);
    }
    Ok(y)
}

/// Adds a unary operator; on integers, constants only.
pub(super) fn unary(g: &mut Graph, kind: UnaryKind, x: Id) -> Result<Id, String> {
    let by: fn(i64) -> Option<i64> = match kind {
        UnaryKind::Neg => i64::checked_neg,
        UnaryKind::Abs => i64::checked_abs,
        _ => return g.unary(Unary::of(kind), x),
    };
    let Some(integers) = g.constant(x).and_then(|tensor| tensor.as_i64()) else {
        return g.unary(Unary::of(kind), x);
    };
    let integers: Option<Vec<i64>> = integers.iter().copied().map(by).collect();
    let integers = integers.ok_or("overflows")?;
    let shape = g.known_shape(x).unwrap_or_default();
    Ok(g.add_const(Arc::new(Tensor::i64(&shape, integers))))
}

/// Returns whether a computed number stands for an integer of the file.
fn is_whole(g: &Graph, id: Id) -> bool {
    let inputs = &g.node(id).inputs;
    match g.op(id) {
        Op::FromIndex => true,
        Op::Unary(unary) => unary.kind.0 == UnaryKind::Trunc,
        Op::Reshape => is_whole(g, inputs[0]),
        _ => false,
    }
}

/// Converts a value to a number.
pub(super) fn number(g: &mut Graph, id: Id) -> Result<Id, String> {
    let Some(tensor) = g.constant(id) else {
        return match g.ty(id) {
            Type::F32 => Ok(id),
            Type::I64 => g.number_of(id),
        };
    };
    let Data::I64(integers) = &tensor.data else {
        return Ok(id);
    };
    let numbers = integers.iter().map(|&x| x as f32).collect();
    let tensor = Tensor::f32(&tensor.shape, numbers);
    Ok(g.add_const(Arc::new(tensor)))
}

pub(super) fn constant(g: &mut Graph, value: f32) -> Id {
    g.add_const(Arc::new(Tensor::scalar(value)))
}

/// Multiplies two values; a value times itself becomes a square.
pub(super) fn multiply(g: &mut Graph, a: Id, b: Id) -> Result<Id, String> {
    if a == b && g.ty(a) == Type::F32 {
        g.unary(Unary::of(UnaryKind::Square), a)
    } else {
        binary(g, BinaryKind::Mul, a, b)
    }
}

pub(super) fn power(g: &mut Graph, x: &Operands) -> Outputs {
    let base = x.get(0)?;
    // ONNX lets the exponent be an integer.
    let exponent = number(g, x.get(1)?)?;
    let plain = g.shape(exponent).iter().all(|dim| dim.is_one());
    let uniform = g
        .constant(exponent)
        .and_then(|tensor| tensor.uniform())
        .filter(|_| plain);
    let unary = |g: &mut Graph, kind| g.unary(Unary::of(kind), base);
    let y = match uniform {
        Some(1.0) => base,
        Some(2.0) => unary(g, UnaryKind::Square)?,
        Some(0.5) => unary(g, UnaryKind::Sqrt)?,
        Some(-0.5) => unary(g, UnaryKind::Rsqrt)?,
        Some(-1.0) => unary(g, UnaryKind::Recip)?,
        _ => return g.binary(BinaryKind::Pow, base, exponent).map(|y| vec![y]),
    };
    Ok(vec![y])
}

/// Adds a clip to limits, which are attributes in operator sets before 11, inputs since.
pub(super) fn clip(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    x.at_most(3)?;
    let (mut low, mut high) = (x.optional(1), x.optional(2));
    if x.opset < 11 {
        let mut limit = |name, none: f32| -> Result<Option<Id>, String> {
            let value = a.float(name, none)?;
            Ok((value != none).then(|| constant(g, value)))
        };
        low = limit("min", f32::MIN)?;
        high = limit("max", f32::MAX)?;
    }
    limited(g, x.get(0)?, low, high).map(|y| vec![y])
}

pub(super) fn limited(
    g: &mut Graph,
    x: Id,
    low: Option<Id>,
    high: Option<Id>,
) -> Result<Id, String> {
    let mut y = x;
    if let Some(low) = low {
        y = binary(g, BinaryKind::Max, y, low)?;
    }
    if let Some(high) = high {
        y = binary(g, BinaryKind::Min, y, high)?;
    }
    Ok(y)
}
