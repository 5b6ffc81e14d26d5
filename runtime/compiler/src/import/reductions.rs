//! Imports reductions over axes.

use lads_image::op::{ReduceKind, UnaryKind};

use super::attributes::Attributes;
use super::operators::Outputs;
use super::{Operands, shapes};
use crate::graph::{Dim, Graph, Op, Unary};

/// Adds a reduction over the axes of an attribute or an input, or over all of them.
pub(super) fn reduce(
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

/// Adds the index of the smallest or largest element along an axis, of one row.
pub(super) fn arg(g: &mut Graph, x: &Operands, a: &Attributes, op: Op) -> Outputs {
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
