//! Fuses convolutions with the nodes around them: scales and shifts of their input and of their
//! output, a residual connection, an activation with its upper bound.
//!
//! ```text
//! conv(pad(x, 0))        = conv'(x)   with more padding
//! conv(s x + t)          = conv'(x)   with weights s W, bias b + W·t, and padding (0 - t) / s, which the scale makes what it was
//! s conv(x) + t          = conv'(x)   with weights s W and bias s b + t: so batch normalisation disappears
//! min(relu(conv + r), u)              as one operation
//! ```
//!
//! A value that has another reader is not fused.

use std::collections::HashMap;
use std::sync::Arc;

use lads_image::op::{BinaryKind, UnaryKind};

use super::Fused;
use super::linear::is_activation;
use crate::graph::{ConvOp, Graph, Id, Op, Rewriter, Type, Unary, topological};
use crate::tensor::Tensor;

/// Fuses the convolutions of an entry.
pub(super) fn fuse(fused: Fused) -> Result<Fused, String> {
    let old = &fused.graph;
    let mut roots = fused.roots();
    let outputs = roots.clone();
    roots.extend(fused.inputs.iter().map(|&(_, id)| id));
    let order = topological(old, &roots, &HashMap::new());
    if !order.iter().any(|&id| matches!(old.op(id), Op::Conv(_))) {
        return Ok(fused);
    }
    let mut uses: HashMap<Id, usize> = HashMap::new();
    let read = order.iter().flat_map(|&id| old.node(id).inputs.clone());
    for id in read.chain(outputs) {
        *uses.entry(id).or_default() += 1;
    }
    let mut rewriter = Rewriter::new(old, HashMap::new());
    for &id in &order {
        let operands = rewriter.operands(id);
        let alone: Vec<bool> = old
            .node(id)
            .inputs
            .iter()
            .map(|input| uses[input] == 1)
            .collect();
        rewriter.at(id);
        let g = &mut rewriter.new;
        let taken = match old.op(id) {
            Op::Conv(conv) => {
                let (conv, source) = if alone[0] {
                    with_padding(g, *conv, operands[0])
                } else {
                    (*conv, operands[0])
                };
                let inputs = [&[source], &operands[1..]].concat();
                Some(with_input(g, conv, inputs, alone[0])?)
            }
            Op::Binary(kind) => combined(g, kind.0, &operands, &alone)?,
            Op::Unary(unary) if alone[0] => activated(g, *unary, operands[0])?,
            _ => None,
        };
        rewriter.set_or_rebuild(id, taken, &operands)?;
    }
    let (graph, copies) = rewriter.finish(&order);
    Ok(fused.mapped(graph, |id| copies[&id]))
}

/// Returns a constant as one number per channel of `x`, if it has that form.
fn per_channel(g: &Graph, x: Id, constant: Id) -> Option<Vec<f64>> {
    let tensor = g.constant(constant)?.clone();
    let (shape, data) = (&tensor.shape, tensor.as_f32()?);
    let channels = g.shape(x).last()?.known()?;
    let plain = shape.len() <= g.shape(x).len() && shape.iter().rev().skip(1).all(|&dim| dim == 1);
    let numbers: Vec<f64> = data.iter().copied().map(f64::from).collect();
    match numbers[..] {
        _ if !plain => None,
        [one] => Some(vec![one; channels]),
        _ if numbers.len() == channels => Some(numbers),
        _ => None,
    }
}

/// Converts `kind(x, column)` to a scale and a shift of each channel; with `swapped`, the column is
/// the first operand.
fn affine(kind: BinaryKind, swapped: bool, column: Vec<f64>) -> Option<Vec<[f64; 2]>> {
    let one: fn(f64) -> [f64; 2] = match (kind, swapped) {
        (BinaryKind::Add, _) => |c| [1.0, c],
        (BinaryKind::Sub, false) => |c| [1.0, -c],
        (BinaryKind::Sub, true) => |c| [-1.0, c],
        (BinaryKind::Mul, _) => |c| [c, 0.0],
        (BinaryKind::Div, false) => |c| [1.0 / c, 0.0],
        _ => return None,
    };
    let all: Vec<[f64; 2]> = column.into_iter().map(one).collect();
    // What is folded has to be numbers.
    all.iter()
        .flatten()
        .all(|number| number.is_finite())
        .then_some(all)
}

/// Converts a node to a scale and a shift of each channel of its operand.
fn affine_of(g: &Graph, id: Id) -> Option<(Id, Vec<[f64; 2]>)> {
    let Op::Binary(kind) = *g.op(id) else {
        return None;
    };
    let &[a, b] = &g.node(id).inputs[..] else {
        return None;
    };
    let (x, constant, swapped) = if g.constant(b).is_some() {
        (a, b, false)
    } else {
        (b, a, true)
    };
    let same = g.shape(x) == g.shape(id);
    let column = per_channel(g, x, constant).filter(|_| same)?;
    Some((x, affine(kind.0, swapped, column)?))
}

fn tensor(g: &mut Graph, shape: &[usize], values: &[f64]) -> Id {
    let values = values.iter().map(|&value| value as f32).collect();
    g.add_const(Arc::new(Tensor::f32(shape, values)))
}

fn numbers(g: &Graph, id: Id) -> Option<Vec<f64>> {
    let tensor = g.constant(id)?;
    Some(tensor.as_f32()?.iter().copied().map(f64::from).collect())
}

/// Moves the zeros around a convolution's input into its padding, and returns the input without
/// them.
fn with_padding(g: &Graph, mut conv: ConvOp, mut x: Id) -> (ConvOp, Id) {
    let zeros = |id: Id| g.constant(id).and_then(|tensor| tensor.uniform()) == Some(0.0);
    while let Op::Concat { axis } = *g.op(x) {
        let parts = &g.node(x).inputs;
        let rank = g.shape(x).len();
        let inside: Vec<usize> = (0..parts.len()).filter(|&i| !zeros(parts[i])).collect();
        // Rows and columns, of a sequence columns alone.
        let (&[inside], Some(side)) = (&inside[..], (axis + 3).checked_sub(rank)) else {
            break;
        };
        if axis == 0 || side > 1 || conv.fill {
            break;
        }
        let len = |parts: &[Id]| {
            parts
                .iter()
                .map(|&id| g.shape(id)[axis].fixed)
                .sum::<usize>()
        };
        conv.windows.before[side] += len(&parts[..inside]);
        conv.windows.after[side] += len(&parts[inside + 1..]);
        x = parts[inside];
    }
    (conv, x)
}

/// Folds the scales and shifts of a convolution's input into its weights.
fn with_input(g: &mut Graph, mut conv: ConvOp, mut x: Vec<Id>, alone: bool) -> Result<Id, String> {
    let mut total: Option<Vec<[f64; 2]>> = None;
    let mut source = x[0];
    let folds = alone && conv.groups == 1 && !conv.fill && !conv.residual;
    // The padding is divided by the scale.
    let divides = |outer: &[[f64; 2]]| outer.iter().all(|[scale, _]| scale.is_normal());
    while let Some((inside, outer)) =
        affine_of(g, source).filter(|(_, outer)| folds && divides(outer))
    {
        // outer(inner(x)), from the last to the first.
        let after = total.unwrap_or_else(|| vec![[1.0, 0.0]; outer.len()]);
        let both = outer
            .iter()
            .zip(after)
            .map(|([s, t], [after_s, after_t])| [after_s * s, after_s * t + after_t]);
        total = Some(both.collect());
        source = inside;
    }
    if let Some(total) = total
        && let (Some(w), Some(bias)) = (numbers(g, x[1]), numbers(g, x[2]))
    {
        let (c, n) = (total.len(), bias.len());
        let mut shifted = bias;
        let mut scaled = Vec::with_capacity(w.len());
        for (l, row) in w.chunks(n.max(1)).enumerate() {
            let [scale, shift] = total[l % c];
            for (shifted, w) in shifted.iter_mut().zip(row) {
                *shifted += w * shift;
            }
            scaled.extend(row.iter().map(|w| w * scale));
        }
        x[0] = source;
        x[1] = tensor(g, &[w.len() / n, n], &scaled);
        x[2] = tensor(g, &[n], &shifted);
        if conv.windows.pads() != [0; 4] && total.iter().any(|&[_, shift]| shift != 0.0) {
            let border: Vec<f64> = total.iter().map(|[scale, shift]| -shift / scale).collect();
            x.push(tensor(g, &[c], &border));
            conv.fill = true;
        }
    }
    g.conv(conv, x)
}

/// Returns the convolution that computes a value, if nothing is fused after its sum yet.
fn bare(g: &Graph, id: Id) -> Option<ConvOp> {
    match *g.op(id) {
        Op::Conv(conv) if conv.activation.is_none() && !conv.residual => Some(conv),
        _ => None,
    }
}

/// Fuses a convolution with a scale, a shift, a residual connection, or a bound.
fn combined(
    g: &mut Graph,
    kind: BinaryKind,
    x: &[Id],
    alone: &[bool],
) -> Result<Option<Id>, String> {
    // The later convolution is taken first: the other side is then more likely to be the residual that it belongs to.
    let sides = if x[0] > x[1] { [0, 1] } else { [1, 0] };
    for side in sides.into_iter().filter(|&side| alone[side]) {
        let (own, other) = (x[side], x[1 - side]);
        if let Some(bounded) = bounded(g, kind, own, other)? {
            return Ok(Some(bounded));
        }
        let Some(conv) = bare(g, own) else {
            continue;
        };
        let mut inputs = g.node(own).inputs.clone();
        let column = per_channel(g, own, other);
        if let Some(total) = column.and_then(|column| affine(kind, side == 1, column)) {
            if let (Some(w), Some(bias)) = (numbers(g, inputs[1]), numbers(g, inputs[2])) {
                let n = bias.len();
                let scaled: Vec<f64> = w
                    .iter()
                    .enumerate()
                    .map(|(i, w)| w * total[i % n][0])
                    .collect();
                let shifted: Vec<f64> = bias
                    .iter()
                    .zip(&total)
                    .map(|(b, [s, t])| b * s + t)
                    .collect();
                inputs[1] = tensor(g, &[w.len() / n, n], &scaled);
                inputs[2] = tensor(g, &[n], &shifted);
                return g.conv(conv, inputs).map(Some);
            }
        } else if kind == BinaryKind::Add
            && conv.groups == 1
            && g.shape(other) == g.shape(own)
            && g.ty(other) == Type::F32
            && g.constant(other).is_none()
        {
            inputs.push(other);
            let conv = ConvOp {
                residual: true,
                ..conv
            };
            return g.conv(conv, inputs).map(Some);
        }
    }
    Ok(None)
}

/// Fuses `max(conv, 0)` and `min(relu(conv), u)` with `u > 0`, which ONNX' `Clip` becomes.
fn bounded(g: &mut Graph, kind: BinaryKind, own: Id, other: Id) -> Result<Option<Id>, String> {
    let relu = Unary::of(UnaryKind::Relu);
    let uniform = g.constant(other).and_then(|tensor| tensor.uniform());
    let (&Op::Conv(conv), Some(number)) = (g.op(own), uniform) else {
        return Ok(None);
    };
    // A constant of more axes would make the result larger.
    if g.shape(other).iter().any(|dim| !dim.is_one()) || g.shape(other).len() > g.shape(own).len() {
        return Ok(None);
    }
    let conv = match kind {
        BinaryKind::Max if conv.activation.is_none() && number == 0.0 => ConvOp {
            activation: Some(relu),
            ..conv
        },
        BinaryKind::Min
            if conv.activation == Some(relu) && conv.bound.is_none() && number > 0.0 =>
        {
            ConvOp {
                bound: Some(number.to_bits()),
                ..conv
            }
        }
        _ => return Ok(None),
    };
    let inputs = g.node(own).inputs.clone();
    g.conv(conv, inputs).map(Some)
}

/// Fuses an activation after a convolution that has none yet.
fn activated(g: &mut Graph, unary: Unary, x: Id) -> Result<Option<Id>, String> {
    let Op::Conv(conv) = *g.op(x) else {
        return Ok(None);
    };
    if !is_activation(unary) || conv.activation.is_some() {
        return Ok(None);
    }
    let conv = ConvOp {
        activation: Some(unary),
        ..conv
    };
    let inputs = g.node(x).inputs.clone();
    g.conv(conv, inputs).map(Some)
}
