//! Imports operators that move elements or name shapes and indices, as views wherever that is
//! possible.

use std::sync::Arc;

use super::Operands;
use super::attributes::Attributes;
use super::constants::{cast, constant, eye_like, filled, range};
use super::indices::{gather, gather_nd, slice, split};
use super::operators::Outputs;
use super::parts::{pad, scatter, tile};
use crate::graph::{Dim, Graph, Id, show};
use crate::tensor::Tensor;

/// Message for an unknown operator.
pub(super) const UNKNOWN: &str =
    "is not supported; export the graph with operators that the compiler's documentation lists";

/// Adds a node's operations to the graph.
pub(super) fn translate(g: &mut Graph, operator: &str, x: &Operands, a: &Attributes) -> Outputs {
    let one = |y: Result<Id, String>| y.map(|y| vec![y]);
    match operator {
        "Identity" => Ok(vec![x.get(0)?]),
        "Dropout" => {
            // Identity unless training; the ratio is an attribute in operator sets before 12.
            a.int("seed", 0)?;
            a.float("ratio", 0.5)?;
            let training = x.optional(2).and_then(|id| g.constant(id).cloned());
            if x.optional(2).is_some() && training.is_none_or(|flag| flag.uniform() != Some(0.0)) {
                return Err("supports inference only".into());
            }
            Ok(vec![x.get(0)?])
        }
        "Cast" => cast(g, x, a),
        "Constant" => constant(g, a),
        "ConstantOfShape" => filled(g, x, a),
        "Shape" => {
            let shape = g
                .known_shape(x.get(0)?)
                .ok_or("supports static shapes only")?;
            let rank = shape.len() as i64;
            let at = |i: i64| (if i < 0 { i.saturating_add(rank) } else { i }).clamp(0, rank);
            let (start, end) = (at(a.int("start", 0)?), at(a.int("end", i64::MAX)?));
            let dims: Vec<i64> = shape.iter().map(|&dim| dim as i64).collect();
            let dims = dims[start as usize..end.max(start) as usize].to_vec();
            if dims.is_empty() {
                return Err("gives no axis".into());
            }
            Ok(vec![
                g.add_const(Arc::new(Tensor::i64(&[dims.len()], dims))),
            ])
        }
        "Size" => {
            let shape = g
                .known_shape(x.get(0)?)
                .ok_or("supports static shapes only")?;
            let size = shape.iter().product::<usize>() as i64;
            Ok(vec![g.add_const(Arc::new(Tensor::i64(&[], vec![size])))])
        }
        "Range" => range(g, x),
        "EyeLike" => eye_like(g, x, a),
        "Reshape" => one(reshape(g, x, a)),
        "Flatten" => one(flatten(g, x, a)),
        "Squeeze" => one(squeeze(g, x, a)),
        "Unsqueeze" => one(unsqueeze(g, x, a)),
        "Expand" => {
            let shape = wanted(g, x.get(1)?)?
                .into_iter()
                .map(|dim| usize::try_from(dim).map(Dim::of))
                .collect::<Result<Vec<_>, _>>();
            let shape = shape.map_err(|_| "has a negative length")?;
            one(g.expand(x.get(0)?, &shape))
        }
        "Transpose" => {
            let value = x.get(0)?;
            let reversed: Vec<usize> = (0..g.shape(value).len()).rev().collect();
            let perm = match a.ints("perm")? {
                Some(perm) => perm
                    .iter()
                    .map(|&i| axis(g, value, i))
                    .collect::<Result<_, _>>()?,
                None => reversed,
            };
            one(g.transpose(value, &perm))
        }
        "Concat" => {
            let parts = x.all()?;
            let along = axis(g, x.get(0)?, a.int("axis", i64::MIN)?)?;
            one(g.concat(&parts, along))
        }
        "Split" => split(g, x, a),
        "Slice" => one(slice(g, x, a)),
        "Pad" => one(pad(g, x, a)),
        "Tile" => one(tile(g, x)),
        "ScatterND" => one(scatter(g, x, a)),
        "Gather" => one(gather(g, x, a)),
        "GatherND" => one(gather_nd(g, x, a)),
        _ => Err(UNKNOWN.into()),
    }
}

/// Resolves an axis that may count from the end.
pub(super) fn axis(g: &Graph, x: Id, axis: i64) -> Result<usize, String> {
    within(axis, g.shape(x).len())
        .ok_or_else(|| format!("names axis {axis} of {}", show(g.shape(x))))
}

pub(super) fn within(axis: i64, rank: usize) -> Option<usize> {
    let axis = if axis < 0 {
        axis.checked_add(rank as i64)?
    } else {
        axis
    };
    usize::try_from(axis).ok().filter(|&axis| axis < rank)
}

/// Returns the number of elements.
pub(super) fn volume(dims: &[Dim]) -> Result<Dim, String> {
    let mut lens = dims.iter().map(|dim| dim.known());
    lens.try_fold(1_usize, |all, len| all.checked_mul(len?))
        .map(Dim::of)
        .ok_or_else(|| "supports static shapes only".into())
}

/// Returns constant integers, if the input is given.
pub(super) fn integers(g: &Graph, id: Option<Id>) -> Result<Option<Vec<i64>>, String> {
    id.map(|id| wanted(g, id)).transpose()
}

pub(super) fn wanted(g: &Graph, id: Id) -> Result<Vec<i64>, String> {
    let tensor = g.constant(id).and_then(|tensor| tensor.as_i64());
    tensor
        .map(<[i64]>::to_vec)
        .ok_or_else(|| "needs constant shapes, axes and indices".into())
}

fn reshape(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    let value = x.get(0)?;
    let keep_zero = a.flag("allowzero", false)?;
    let from = g.shape(value).to_vec();
    let mut shape = vec![];
    let mut open = None;
    for (i, dim) in wanted(g, x.get(1)?)?.into_iter().enumerate() {
        shape.push(match dim {
            0 if !keep_zero => *from
                .get(i)
                .ok_or_else(|| format!("keeps axis {i} of {}", show(&from)))?,
            -1 if open.is_none() => {
                open = Some(i);
                Dim::of(1)
            }
            dim => Dim::of(usize::try_from(dim).map_err(|_| format!("has length {dim}"))?),
        });
    }
    if let Some(i) = open {
        // What is left of the elements, the symbolic axes aside.
        let product = |dims: &[Dim]| {
            dims.iter()
                .filter(|dim| !dim.past)
                .try_fold(1usize, |product, dim| product.checked_mul(dim.fixed))
        };
        let (whole, rest) = (product(&from), product(&shape));
        let (Some(whole), Some(rest)) = (whole, rest) else {
            return Err("has a shape that is too large".into());
        };
        if rest == 0 || whole % rest != 0 {
            return Err(format!(
                "does not divide {} by {}",
                show(&from),
                show(&shape)
            ));
        }
        shape[i] = Dim::of(whole / rest);
    }
    g.reshape(value, &shape)
}

fn flatten(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    let value = x.get(0)?;
    let shape = g.known_shape(value).ok_or("supports static shapes only")?;
    let at = a.int("axis", 1)?;
    let at = if at == shape.len() as i64 {
        shape.len()
    } else {
        axis(g, value, at)?
    };
    let (rows, cols) = shape.split_at(at);
    let shape = [rows, cols].map(|part| Dim::of(part.iter().product()));
    g.reshape(value, &shape)
}

/// Reads axes from an attribute (operator sets before 13) or from input 1.
fn axes(g: &Graph, x: &Operands, a: &Attributes) -> Result<Option<Vec<i64>>, String> {
    match a.ints("axes")? {
        Some(axes) => Ok(Some(axes.to_vec())),
        None => integers(g, x.optional(1)),
    }
}

fn squeeze(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    let value = x.get(0)?;
    let shape = g.shape(value).to_vec();
    let named = match axes(g, x, a)? {
        Some(axes) => axes
            .iter()
            .map(|&i| axis(g, value, i))
            .collect::<Result<Vec<_>, _>>()?,
        None => (0..shape.len()).filter(|&i| shape[i].is_one()).collect(),
    };
    if let Some(&i) = named.iter().find(|&&i| !shape[i].is_one()) {
        return Err(format!("drops axis {i} of {}", show(&shape)));
    }
    let left: Vec<Dim> = (0..shape.len())
        .filter(|i| !named.contains(i))
        .map(|i| shape[i])
        .collect();
    g.reshape(value, &left)
}

fn unsqueeze(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    let value = x.get(0)?;
    let named = axes(g, x, a)?.ok_or("misses its axes")?;
    let rank = g.shape(value).len() + named.len();
    let named: Option<Vec<usize>> = named.iter().map(|&i| within(i, rank)).collect();
    let named = named.ok_or("names an axis that does not exist")?;
    let mut rest = g.shape(value).to_vec().into_iter();
    let shape: Option<Vec<Dim>> = (0..rank)
        .map(|i| {
            if named.contains(&i) {
                Some(Dim::of(1))
            } else {
                rest.next()
            }
        })
        .collect();
    g.reshape(value, &shape.ok_or("names an axis twice")?)
}
