//! Imports normalisations.

use std::sync::Arc;

use lads_image::op::{BinaryKind, ReduceKind, UnaryKind};

use super::arithmetic::constant;
use super::attributes::Attributes;
use super::operators::Outputs;
use super::{Operands, shapes};
use crate::graph::{Dim, Graph, Id, Unary, show};
use crate::tensor::Tensor;

/// Adds a layer norm over all axes from one on.
pub(super) fn layer_norm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let value = x.get(0)?;
    let eps = a.float("epsilon", 1e-5)?;
    a.only("stash_type", 1)?;
    let at = shapes::axis(g, value, a.int("axis", -1)?)?;
    let shape = g.shape(value).to_vec();
    let (outer, inner) = shape.split_at(at);
    let cols = shapes::volume(inner)?;
    let row = |g: &mut Graph, id: Id| -> Result<Id, String> {
        let id = g.expand(id, inner)?;
        g.reshape(id, &[cols])
    };
    let scale = x.get(1)?;
    let gamma = row(g, scale)?;
    let beta = match x.optional(2) {
        Some(bias) => bias,
        None => constant(g, 0.0),
    };
    let beta = row(g, beta)?;
    let rows = g.reshape(value, &[outer, &[cols]].concat())?;
    let y = g.layer_norm(rows, gamma, beta, eps)?;
    g.reshape(y, &shape).map(|y| vec![y])
}

/// Adds an RMS norm, `x / sqrt(mean(x^2) + eps) * scale`, over all axes from one on.
pub(super) fn rms_norm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let value = x.get(0)?;
    let eps = constant(g, a.float("epsilon", 1e-5)?);
    a.only("stash_type", 1)?;
    let at = shapes::axis(g, value, a.int("axis", -1)?)?;
    let mut kept = g.shape(value).to_vec();
    let mut mean = g.unary(Unary::of(UnaryKind::Square), value)?;
    for axis in (at..kept.len()).rev() {
        kept[axis] = Dim::of(1);
        mean = g.reduce(ReduceKind::Mean, mean, axis)?;
    }
    let mean = g.reshape(mean, &kept)?;
    let inner = g.binary(BinaryKind::Add, mean, eps)?;
    let by = g.unary(Unary::of(UnaryKind::Rsqrt), inner)?;
    let y = g.binary(BinaryKind::Mul, value, by)?;
    g.binary(BinaryKind::Mul, y, x.get(1)?).map(|y| vec![y])
}

/// Adds a group norm, each group of channels of each sample by itself; with a scale for each
/// channel, or for each group in operator sets before 21.
pub(super) fn group_norm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    a.only("stash_type", 1)?;
    let groups = a.int("num_groups", 0)?;
    let channels = channels(g, x.get(0)?)?;
    let groups = usize::try_from(groups)
        .ok()
        .filter(|&groups| groups > 0 && channels.is_multiple_of(groups))
        .ok_or_else(|| format!("has {channels} channels in {groups} groups"))?;
    let eps = a.float("epsilon", 1e-5)?;
    let each = if x.opset < 21 { channels / groups } else { 1 };
    by_groups(g, x, groups, each, eps)
}

/// Adds an instance norm, each channel of each sample by itself.
pub(super) fn instance_norm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let channels = channels(g, x.get(0)?)?;
    by_groups(g, x, channels, 1, a.float("epsilon", 1e-5)?)
}

fn channels(g: &Graph, x: Id) -> Result<usize, String> {
    let shape = g.known_shape(x).filter(|shape| shape.len() > 1);
    shape
        .map(|shape| shape[1])
        .ok_or_else(|| "needs static shapes, with a batch and a channel axis".into())
}

/// Normalises `groups` of channels; every scale and bias belongs to `each` channels.
fn by_groups(g: &mut Graph, x: &Operands, groups: usize, each: usize, eps: f32) -> Outputs {
    let value = x.get(0)?;
    let shape = g.shape(value).to_vec();
    let len = shapes::volume(&shape[1..])?.fixed / groups;
    let rows = g.reshape(value, &[shape[0], Dim::of(groups), Dim::of(len)])?;
    let mut filled = |with: f32| g.add_const(Arc::new(Tensor::f32(&[len], vec![with; len])));
    let (ones, zeros) = (filled(1.0), filled(0.0));
    let normed = g.layer_norm(rows, ones, zeros, eps)?;
    let normed = g.reshape(normed, &shape)?;
    let along = |g: &mut Graph, id: Id| -> Result<Id, String> {
        let given = g.shape(id).to_vec();
        let &[count] = &given[..] else {
            return Err(format!("has a scale of {}", show(&given)));
        };
        let id = g.reshape(id, &[count, Dim::of(1)])?;
        let id = g.expand(id, &[count, Dim::of(each)])?;
        let mut dims = vec![Dim::of(1); shape.len() - 1];
        dims[0] = shape[1];
        g.reshape(id, &dims)
    };
    let scale = along(g, x.get(1)?)?;
    let bias = along(g, x.get(2)?)?;
    let y = g.binary(BinaryKind::Mul, normed, scale)?;
    g.binary(BinaryKind::Add, y, bias).map(|y| vec![y])
}

/// Adds a batch norm, `(x - mean) / sqrt(var + eps) * scale + bias` over axis 1, with constants: a
/// scale and a shift.
pub(super) fn batch_norm(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    a.only("training_mode", 0)?;
    a.float("momentum", 0.9)?;
    a.only("spatial", 1)?;
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
