//! Narrows values to the parts that are read: of the last layer's tokens, the one that decides; of
//! queries, keys and values, where a layer only records, keys and values.
//!
//! From the outputs back, each value is told which part of one axis its users need: the smallest range that holds all of their
//! slices. Operations that work row by row pass it on to their operands, a product passes columns on to its matrix.

use std::collections::HashMap;

use super::Fused;
use crate::graph::{Dim, Graph, Id, Op, Rewriter, topological};

/// Part of a value that is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Demand {
    Whole,
    Part {
        axis: usize,
        start: usize,
        len: usize,
    },
}

impl Demand {
    /// Returns the smallest part that holds both.
    fn with(self, other: Self) -> Self {
        match (self, other) {
            (
                Self::Part { axis, start, len },
                Self::Part {
                    axis: other_axis,
                    start: other_start,
                    len: other_len,
                },
            ) if axis == other_axis => {
                let end = (start + len).max(other_start + other_len);
                let start = start.min(other_start);
                Self::Part {
                    axis,
                    start,
                    len: end - start,
                }
            }
            _ => Self::Whole,
        }
    }
}

/// Narrows the values of an entry.
pub(super) fn narrow(fused: Fused) -> Result<Fused, String> {
    let old = &fused.graph;
    let mut roots = fused.roots();
    roots.extend(fused.inputs.iter().map(|&(_, id)| id));
    let order = topological(old, &roots, &HashMap::new());
    let mut demands: HashMap<Id, Demand> =
        roots.iter().map(|&root| (root, Demand::Whole)).collect();
    for &id in order.iter().rev() {
        let demand = computed(old, id, demands[&id]);
        demands.insert(id, demand);
        for (i, &input) in old.node(id).inputs.iter().enumerate() {
            let wanted = passed_on(old, id, demand, i);
            demands
                .entry(input)
                .and_modify(|known| *known = known.with(wanted))
                .or_insert(wanted);
        }
    }
    let mut rewriter = Rewriter::new(old, HashMap::new());
    for &id in &order {
        let demand = demands[&id];
        let mut operands = vec![];
        for (i, &input) in old.node(id).inputs.iter().enumerate() {
            let copy = rewriter.copy_of(input);
            rewriter.at(id);
            operands.push(match (passed_on(old, id, demand, i), demands[&input]) {
                (Demand::Part { axis, start, len }, Demand::Part { start: first, .. }) => {
                    rewriter.new.slice(copy, axis, start - first, len)?
                }
                (Demand::Part { axis, start, len }, Demand::Whole) => {
                    rewriter.new.slice(copy, axis, start, len)?
                }
                (Demand::Whole, _) => copy,
            });
        }
        let new = match (old.op(id), demand) {
            // A slice of what was already cut is the operand itself.
            (Op::Slice { .. }, _) => operands[0],
            (Op::Reshape, Demand::Part { axis, len, .. }) => {
                let mut shape = old.shape(id).to_vec();
                shape[axis] = Dim::of(len);
                rewriter.at(id);
                rewriter.new.reshape(operands[0], &shape)?
            }
            _ => rewriter.rebuild(id, &operands)?,
        };
        rewriter.set(id, new);
    }
    let (graph, copies) = rewriter.finish(&order);
    Ok(fused.mapped(graph, |id| copies[&id]))
}

/// Returns the part of a value that is computed: the part asked for if the operation works row by
/// row along that axis, else all of it.
fn computed(g: &Graph, id: Id, asked: Demand) -> Demand {
    let Demand::Part { axis, start, len } = asked else {
        return Demand::Whole;
    };
    let node = g.node(id);
    let from_end = node.shape.len() - axis;
    let can = match &node.op {
        Op::Binary(_) | Op::Unary(_) | Op::Transpose(_) => true,
        Op::LayerNorm { .. } | Op::Softmax => from_end > 1,
        Op::MatMul => from_end == 2 || (from_end == 1 && g.constant(node.inputs[1]).is_some()),
        // Attention computes the last rows or all of them.
        Op::Attention { .. } => axis == 0 && start + len == node.shape[0].fixed,
        Op::Reshape => same_axis(g.shape(node.inputs[0]), &node.shape, axis).is_some(),
        _ => false,
    };
    if can { asked } else { Demand::Whole }
}

/// Returns the part of operand `i` that a node reads to compute `demand`.
fn passed_on(g: &Graph, id: Id, demand: Demand, i: usize) -> Demand {
    let node = g.node(id);
    if let Op::Slice { axis, start } = node.op {
        return Demand::Part {
            axis,
            start,
            len: node.shape[axis].fixed,
        };
    }
    let Demand::Part { axis, start, len } = demand else {
        return Demand::Whole;
    };
    let operand = g.shape(node.inputs[i]);
    let from_end = node.shape.len() - axis;
    // The same axis of an operand, counted from the end, unless it broadcasts there.
    let aligned = operand
        .len()
        .checked_sub(from_end)
        .filter(|&axis| operand[axis] == node.shape[node.shape.len() - from_end]);
    let part = |axis: usize| Demand::Part { axis, start, len };
    match &node.op {
        Op::Binary(_) | Op::Unary(_) => aligned.map_or(Demand::Whole, part),
        Op::LayerNorm { .. } | Op::Softmax | Op::Attention { .. } if i == 0 => part(axis),
        // Rows come from the first operand, columns from the second.
        Op::MatMul if i == 2 - from_end => aligned.map_or(Demand::Whole, part),
        Op::Transpose(perm) => part(perm[axis]),
        Op::Reshape => same_axis(operand, &node.shape, axis).map_or(Demand::Whole, part),
        _ => Demand::Whole,
    }
}

/// Returns the axis of `from` that a reshape leaves as axis `axis` of `to`.
fn same_axis(from: &[Dim], to: &[Dim], axis: usize) -> Option<usize> {
    let volume = |dims: &[Dim]| {
        dims.iter()
            .map(|dim| dim.known())
            .try_fold(1usize, |product, dim| product.checked_mul(dim?))
    };
    let before = volume(&to[..axis])?;
    (0..from.len()).find(|&i| from[i] == to[axis] && volume(&from[..i]) == Some(before))
}
