//! Moves the channels of images to the last axis: ONNX has them second, so every convolution stands
//! between two transposes. This pass moves the transposes past elementwise nodes, where they meet
//! the next operator's and cancel out.
//!
//! ```text
//! f(first(x))                    = first(f(x))              elementwise, slices, concatenations, sums along an axis
//! flat(first(x))·W               = flat(x)·W'               W' are the rows of W in another order
//! ```
//!
//! An entry without images is unchanged.

use std::collections::HashMap;

use lads_image::op::BinaryKind;

use super::Fused;
use crate::graph::{Dim, Graph, Id, Op, Rewriter, channels_first, channels_last, topological};

/// Moves the channels of an entry's images to the end.
pub(super) fn channels_to_the_end(fused: Fused) -> Result<Fused, String> {
    let old = &fused.graph;
    let mut roots = fused.roots();
    roots.extend(fused.inputs.iter().map(|&(_, id)| id));
    let order = topological(old, &roots, &HashMap::new());
    let has_images = order
        .iter()
        .any(|&id| matches!(old.op(id), Op::Conv(_) | Op::Pool(..) | Op::Resize));
    if !has_images {
        return Ok(fused);
    }
    let mut rewriter = Rewriter::new(old, HashMap::new());
    for &id in &order {
        let operands = rewriter.operands(id);
        rewriter.at(id);
        let turned = turned(&mut rewriter.new, old, id, &operands)?;
        rewriter.set_or_rebuild(id, turned, &operands)?;
    }
    let (graph, copies) = rewriter.finish(&order);
    Ok(fused.mapped(graph, |id| copies[&id]))
}

/// Returns the value with channels last whose transposed view is `id`.
fn inner(g: &Graph, id: Id) -> Option<Id> {
    let shape = g.known_shape(id).filter(|shape| shape.len() >= 3)?;
    let source = *g.node(id).inputs.first()?;
    let is_turn = match g.op(id) {
        Op::Transpose(perm) => {
            let last = perm.len() - 1;
            perm.iter()
                .copied()
                .eq([0, last].into_iter().chain(1..last))
        }
        // A turn that moves no element.
        Op::Reshape => {
            let sides = &shape[2..];
            let last = [&shape[..1], sides, &shape[1..2]].concat();
            let still = shape[1] == 1 || sides.iter().all(|&side| side == 1);
            still && g.known_shape(source) == Some(last)
        }
        _ => false,
    };
    is_turn.then_some(source)
}

/// Returns whether axes in this order have the channels last.
fn is_last(perm: &[usize]) -> bool {
    perm.iter()
        .copied()
        .eq([0].into_iter().chain(2..perm.len()).chain([1]))
}

/// Returns a value with its channels last; a value between constants, as padding makes it, is
/// transposed alone, without them.
fn padded(g: &mut Graph, x: Id) -> Result<Id, String> {
    let Op::Concat { axis } = *g.op(x) else {
        return channels_last(g, x);
    };
    let (parts, rank) = (g.node(x).inputs.clone(), g.shape(x).len());
    let computed = parts.iter().filter(|&&part| g.constant(part).is_none());
    if computed.count() > 1 {
        return channels_last(g, x);
    }
    let last = parts.into_iter().map(|part| padded(g, part));
    let last = last.collect::<Result<Vec<_>, _>>()?;
    g.concat(&last, axis_of(rank, axis))
}

/// Returns the position of a transposed view's axis in the value with channels last.
fn axis_of(rank: usize, axis: usize) -> usize {
    match axis {
        0 => 0,
        1 => rank - 1,
        _ => axis - 1,
    }
}

/// Rebuilds a node whose operands are transposed views as the transposed view of another node.
fn turned(g: &mut Graph, old: &Graph, id: Id, x: &[Id]) -> Result<Option<Id>, String> {
    let whole: Option<Vec<Id>> = x.iter().map(|&id| inner(g, id)).collect();
    let new = match (old.op(id), whole) {
        (Op::Unary(unary), Some(last)) => g.unary(*unary, last[0])?,
        (Op::Binary(kind), _) => match binary(g, kind.0, x)? {
            Some(new) => new,
            None => return Ok(None),
        },
        (Op::Slice { axis, start }, Some(last)) => {
            let (axis, len) = (
                axis_of(old.shape(id).len(), *axis),
                old.shape(id)[*axis].fixed,
            );
            g.slice(last[0], axis, *start, len)?
        }
        // Constants beside transposed views: their padding.
        (Op::Concat { axis }, _) if x.iter().any(|&id| inner(g, id).is_some()) => {
            let mut last = vec![];
            for &id in x {
                match inner(g, id) {
                    Some(own) => last.push(own),
                    None if g.constant(id).is_some() => last.push(channels_last(g, id)?),
                    None => return Ok(None),
                }
            }
            let axis = axis_of(old.shape(id).len(), *axis);
            g.concat(&last, axis)?
        }
        (Op::Reduce(kind, axis), Some(last)) => {
            let rank = g.shape(x[0]).len();
            let reduced = g.reduce(kind.0, last[0], axis_of(rank, *axis))?;
            // Without channels nothing is left to turn, and without a batch the channels are not second.
            return match *axis {
                1 => Ok(Some(reduced)),
                0 => Ok(None),
                _ if rank == 3 => Ok(Some(reduced)),
                _ => channels_first(g, reduced).map(Some),
            };
        }
        (Op::MatMul, _) => return product(g, x),
        (Op::Transpose(perm), _) if is_last(perm) && matches!(g.op(x[0]), Op::Concat { .. }) => {
            return padded(g, x[0]).map(Some);
        }
        _ => return Ok(None),
    };
    channels_first(g, new).map(Some)
}

/// Rebuilds a binary node, at least one operand of which is a transposed view of the result's rank.
fn binary(g: &mut Graph, kind: BinaryKind, x: &[Id]) -> Result<Option<Id>, String> {
    let rank = g.shape(x[0]).len().max(g.shape(x[1]).len());
    let is_turned = |&id: &Id| g.shape(id).len() == rank && inner(g, id).is_some();
    let constant = |id: &Id| g.constant(*id).is_some();
    let fits = x.iter().all(|id| is_turned(id) || constant(id)) && x.iter().any(is_turned);
    if !fits {
        return Ok(None);
    }
    let mut last = vec![];
    for &id in x {
        let mut shape = vec![Dim::of(1); rank - g.shape(id).len()];
        shape.extend(g.shape(id));
        let whole = g.reshape(id, &shape)?;
        last.push(channels_last(g, whole)?);
    }
    g.binary(kind, last[0], last[1]).map(Some)
}

/// Rebuilds the product of a flattened transposed view with a constant matrix.
fn product(g: &mut Graph, x: &[Id]) -> Result<Option<Id>, String> {
    let (flat, matrix) = (x[0], x[1]);
    if *g.op(flat) != Op::Reshape || g.constant(matrix).is_none() {
        return Ok(None);
    }
    let source = g.node(flat).inputs[0];
    let Some(last) = inner(g, source) else {
        return Ok(None);
    };
    let (shape, rows) = (g.shape(source).to_vec(), g.shape(flat).to_vec());
    // Each image is one row.
    let &[k, n] = g.shape(matrix) else {
        return Ok(None);
    };
    let inputs = shape[1..].iter().map(|dim| dim.fixed).product::<usize>();
    if rows.last() != Some(&k) || k != Dim::of(inputs) {
        return Ok(None);
    }
    let split: Vec<Dim> = shape[1..].iter().copied().chain([n]).collect();
    let split = g.reshape(matrix, &split)?;
    let sides = shape.len() - 2;
    let perm: Vec<usize> = (1..=sides).chain([0, sides + 1]).collect();
    let moved = g.transpose(split, &perm)?;
    let matrix = g.reshape(moved, &[k, n])?;
    let flat = g.reshape(last, &rows)?;
    g.matmul(flat, matrix).map(Some)
}
