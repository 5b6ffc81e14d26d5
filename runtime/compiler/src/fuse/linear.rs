//! Turns products with constant matrices into linear layers, and fuses the nodes after them: scale,
//! bias, activation, residual.
//!
//! `(x·W) * s + t` is `x·(W s) + t`: so batch normalisation disappears. A value that has another
//! reader is not fused. A reshape between a layer and the node after it, as vectors without a batch
//! axis have it, moves behind both.

use std::collections::HashMap;

use lads_image::op::{BinaryKind, UnaryKind};

use super::{Fused, columns};
use crate::graph::{Dim, Graph, Id, Op, Rewriter, Type, Unary, topological};

/// Fuses the linear layers of an entry.
pub(super) fn fuse(fused: Fused) -> Result<Fused, String> {
    let old = &fused.graph;
    let mut roots = fused.roots();
    let outputs = roots.clone();
    roots.extend(fused.inputs.iter().map(|&(_, id)| id));
    let order = topological(old, &roots, &HashMap::new());
    let mut uses: HashMap<Id, usize> = HashMap::new();
    for id in order
        .iter()
        .flat_map(|&id| old.node(id).inputs.clone())
        .chain(outputs)
    {
        *uses.entry(id).or_default() += 1;
    }
    let mut rewriter = Rewriter::new(old, HashMap::new());
    for &id in &order {
        let operands = rewriter.operands(id);
        let alone: Vec<bool> = old
            .node(id)
            .inputs
            .iter()
            .map(|input| {
                let reshaped = matches!(old.op(*input), Op::Reshape);
                uses[input] == 1 && !(reshaped && uses[&old.node(*input).inputs[0]] != 1)
            })
            .collect();
        rewriter.at(id);
        let taken = match old.op(id) {
            Op::MatMul => product(&mut rewriter.new, &operands)?,
            Op::Binary(kind) => combined(&mut rewriter.new, kind.0, &operands, &alone)?,
            Op::Unary(unary) if alone[0] => activated(&mut rewriter.new, *unary, operands[0])?,
            _ => None,
        };
        rewriter.set_or_rebuild(id, taken, &operands)?;
    }
    let (graph, copies) = rewriter.finish(&order);
    Ok(fused.mapped(graph, |id| copies[&id]))
}

/// Makes a linear layer of `x·W` with a constant matrix.
fn product(g: &mut Graph, x: &[Id]) -> Result<Option<Id>, String> {
    let matrix = g.constant(x[1]).is_some() && g.shape(x[1]).len() == 2;
    let rows = g.known_shape(x[0]).is_some() && g.constant(x[0]).is_none();
    if !(matrix && rows) {
        return Ok(None);
    }
    let (rows, matrix) = columns::sorted(g, x[0], x[1])?.unwrap_or((x[0], x[1]));
    g.linear(
        Op::Linear {
            bias: false,
            residual: false,
            activation: None,
        },
        vec![rows, matrix],
    )
    .map(Some)
}

/// Returns the layer that computes a value, if another node can still be fused with it.
fn layer(g: &Graph, id: Id) -> Option<(bool, Option<Unary>)> {
    match *g.op(id) {
        Op::Linear {
            bias,
            residual: false,
            activation,
        } => Some((bias, activation)),
        _ => None,
    }
}

/// Returns the operand of a reshape, or the value itself.
fn unshaped(g: &Graph, id: Id) -> Id {
    match g.op(id) {
        Op::Reshape => g.node(id).inputs[0],
        _ => id,
    }
}

/// Fuses a linear layer with a scale, a bias or a residual.
fn combined(
    g: &mut Graph,
    kind: BinaryKind,
    x: &[Id],
    alone: &[bool],
) -> Result<Option<Id>, String> {
    let commutes = matches!(kind, BinaryKind::Add | BinaryKind::Mul);
    // The later layer is taken first: the other side is then more likely to be the residual that it belongs to.
    let sides = if x[0] > x[1] { [0, 1] } else { [1, 0] };
    for side in sides {
        let (shaped, other) = (x[side], x[1 - side]);
        let own = unshaped(g, shaped);
        let Some((bias, activation)) =
            layer(g, own).filter(|_| alone[side] && (commutes || side == 0))
        else {
            continue;
        };
        // The last axis must be the layer's outputs.
        let outputs = g.shape(shaped).last() == g.shape(own).last();
        if let Some(column) = per_output(g, shaped, other)?.filter(|_| outputs) {
            if activation.is_none() {
                let shape = g.shape(shaped).to_vec();
                let taken = folded(g, kind, own, bias, column)?;
                return taken.map(|layer| g.reshape(layer, &shape)).transpose();
            }
        } else if own == shaped
            && kind == BinaryKind::Add
            && g.shape(other) == g.shape(own)
            && g.ty(other) == Type::F32
            && g.constant(other).is_none()
        {
            let mut inputs = g.node(own).inputs.clone();
            inputs.push(other);
            return g
                .linear(
                    Op::Linear {
                        bias,
                        residual: true,
                        activation,
                    },
                    inputs,
                )
                .map(Some);
        }
    }
    Ok(None)
}

/// Returns the constant as one value per output of the layer, if it has that form.
fn per_output(g: &mut Graph, layer: Id, constant: Id) -> Result<Option<Id>, String> {
    let shape = g.shape(constant).to_vec();
    if g.constant(constant).is_none()
        || shape.len() > g.shape(layer).len()
        || shape.iter().rev().skip(1).any(|dim| !dim.is_one())
    {
        return Ok(None);
    }
    let n = *g.shape(layer).last().ok_or("a layer has rows")?;
    let flat = g.reshape(constant, &[shape.last().copied().unwrap_or(Dim::of(1))])?;
    g.expand(flat, &[n]).map(Some)
}

/// Folds `layer + c`, `layer - c`, `layer * c` or `layer / c`.
fn folded(
    g: &mut Graph,
    kind: BinaryKind,
    layer: Id,
    bias: bool,
    column: Id,
) -> Result<Option<Id>, String> {
    let mut inputs = g.node(layer).inputs.clone();
    match kind {
        BinaryKind::Add | BinaryKind::Sub if bias => {
            inputs[2] = g.binary(kind, inputs[2], column)?;
        }
        BinaryKind::Add => inputs.push(column),
        BinaryKind::Sub => {
            let negative = g.unary(Unary::of(UnaryKind::Neg), column)?;
            inputs.push(negative);
        }
        BinaryKind::Mul | BinaryKind::Div => {
            inputs[1] = g.binary(kind, inputs[1], column)?;
            if bias {
                inputs[2] = g.binary(kind, inputs[2], column)?;
            }
        }
        _ => return Ok(None),
    }
    let bias = inputs.len() == 3;
    g.linear(
        Op::Linear {
            bias,
            residual: false,
            activation: None,
        },
        inputs,
    )
    .map(Some)
}

/// Returns whether layers and convolutions can apply the function to their results.
pub(super) fn is_activation(unary: Unary) -> bool {
    matches!(
        unary.kind.0,
        UnaryKind::Relu
            | UnaryKind::LeakyRelu
            | UnaryKind::Tanh
            | UnaryKind::Sigmoid
            | UnaryKind::Elu
            | UnaryKind::Softplus
            | UnaryKind::Mish
    )
}

/// Fuses an activation after a layer that has none yet.
fn activated(g: &mut Graph, unary: Unary, x: Id) -> Result<Option<Id>, String> {
    let own = unshaped(g, x);
    let Some((bias, None)) = layer(g, own).filter(|_| is_activation(unary)) else {
        return Ok(None);
    };
    let (inputs, shape) = (g.node(own).inputs.clone(), g.shape(x).to_vec());
    let layer = g.linear(
        Op::Linear {
            bias,
            residual: false,
            activation: Some(unary),
        },
        inputs,
    )?;
    g.reshape(layer, &shape).map(Some)
}
