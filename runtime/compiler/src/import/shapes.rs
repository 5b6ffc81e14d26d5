//! Operators that move elements or name shapes and indices: what they become is a view wherever that is possible.

use std::sync::Arc;

use super::Operands;
use super::attributes::Attributes;
use super::operators::Outputs;
use crate::graph::{Dim, Graph, Id, Type, show};
use crate::tensor::{Data, MAX_ELEMENTS, Tensor};

/// What is said of an operator that is not known.
pub(super) const UNKNOWN: &str =
    "is not supported; export the graph with operators that the compiler's documentation lists";

/// Adds a node's operations to the graph.
pub(super) fn translate(g: &mut Graph, operator: &str, x: &Operands, a: &Attributes) -> Outputs {
    let one = |y: Result<Id, String>| y.map(|y| vec![y]);
    match operator {
        "Identity" => Ok(vec![x.get(0)?]),
        "Dropout" => {
            // Identity unless training.
            a.int("seed", 0)?;
            let training = x.optional(2).and_then(|id| g.constant(id).cloned());
            if x.optional(2).is_some()
                && training.is_none_or(|flag| flag.data != Data::I64(vec![0]))
            {
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
            if a.int("start", 0)? != 0 || a.int("end", i64::MAX)? != i64::MAX {
                return Err("supports whole shapes only".into());
            }
            let dims: Vec<i64> = shape.iter().map(|&dim| dim as i64).collect();
            Ok(vec![
                g.add_const(Arc::new(Tensor::i64(&[dims.len()], dims))),
            ])
        }
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
        "Pad" => one(pad(g, x, a)),
        "Split" => split(g, x, a),
        "Slice" => one(slice(g, x)),
        "Gather" => one(gather(g, x, a)),
        _ => Err(UNKNOWN.into()),
    }
}

/// An axis that may count from the end.
pub(super) fn axis(g: &Graph, x: Id, axis: i64) -> Result<usize, String> {
    within(axis, g.shape(x).len())
        .ok_or_else(|| format!("names axis {axis} of {}", show(g.shape(x))))
}

fn within(axis: i64, rank: usize) -> Option<usize> {
    let axis = if axis < 0 {
        axis.checked_add(rank as i64)?
    } else {
        axis
    };
    usize::try_from(axis).ok().filter(|&axis| axis < rank)
}

/// Constant integers, if the input is there.
pub(super) fn integers(g: &Graph, id: Option<Id>) -> Result<Option<Vec<i64>>, String> {
    id.map(|id| wanted(g, id)).transpose()
}

fn wanted(g: &Graph, id: Id) -> Result<Vec<i64>, String> {
    let tensor = g.constant(id).and_then(|tensor| tensor.as_i64());
    tensor
        .map(<[i64]>::to_vec)
        .ok_or_else(|| "needs constant shapes, axes and indices".into())
}

fn cast(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    use crate::onnx::data_type::{FLOAT, INT32, INT64, name};
    let value = x.get(0)?;
    let to = a.int("to", 0)?;
    a.only("saturate", 1)?;
    let to = i32::try_from(to).unwrap_or(0);
    match (g.ty(value), to) {
        (Type::F32, FLOAT) | (Type::I64, INT64 | INT32) => return Ok(vec![value]),
        _ => {}
    }
    let shape = g.known_shape(value);
    let (Some(tensor), Some(shape)) = (g.constant(value).cloned(), shape) else {
        return Err(format!("to {} is supported for constants only", name(to)));
    };
    let cast = match (&tensor.data, to) {
        (Data::I64(data), FLOAT) => Tensor::f32(&shape, data.iter().map(|&x| x as f32).collect()),
        (Data::F32(data), INT64 | INT32) => {
            Tensor::i64(&shape, data.iter().map(|&x| x as i64).collect())
        }
        _ => return Err(format!("to {} is not supported", name(to))),
    };
    Ok(vec![g.add_const(Arc::new(cast))])
}

fn constant(g: &mut Graph, a: &Attributes) -> Outputs {
    let tensor = if let Some(tensor) = a.tensor("value")? {
        tensor
    } else if let Some(values) = a.floats("value_floats")? {
        Arc::new(Tensor::f32(&[values.len()], values.to_vec()))
    } else if let Some(values) = a.ints("value_ints")? {
        Arc::new(Tensor::i64(&[values.len()], values.to_vec()))
    } else {
        let (float, int) = (
            a.float("value_float", f32::NAN)?,
            a.int("value_int", i64::MIN)?,
        );
        match (float.is_nan(), int) {
            (false, _) => Arc::new(Tensor::scalar(float)),
            (true, i64::MIN) => return Err("has no value that is supported".into()),
            (true, int) => Arc::new(Tensor::i64(&[], vec![int])),
        }
    };
    Ok(vec![g.add_const(tensor)])
}

fn filled(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let shape = wanted(g, x.get(0)?)?;
    let shape: Option<Vec<usize>> = shape.iter().map(|&dim| usize::try_from(dim).ok()).collect();
    let shape = shape.filter(|shape| crate::tensor::elements(shape).is_some());
    let shape = shape.ok_or_else(|| format!("needs a shape of at most {MAX_ELEMENTS} elements"))?;
    let value = a
        .tensor("value")?
        .unwrap_or_else(|| Arc::new(Tensor::f32(&[1], vec![0.0])));
    let id = g.add_const(value);
    let dims: Vec<Dim> = shape.iter().map(|&dim| Dim::of(dim)).collect();
    let single = g.reshape(id, &[])?;
    g.expand(single, &dims).map(|y| vec![y])
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

/// Axes from an attribute (operator sets before 13) or from input 1.
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

fn split(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let value = x.get(0)?;
    let along = axis(g, value, a.int("axis", 0)?)?;
    let whole = g.shape(value)[along]
        .known()
        .ok_or("supports axes of known length only")?;
    let outputs = x.outputs;
    a.only("num_outputs", outputs as i64)?;
    let lens = match a.ints("split")? {
        Some(lens) => lens.to_vec(),
        None => integers(g, x.optional(1))?.unwrap_or_else(|| {
            // Equal parts, the last one smaller.
            let part = whole.div_ceil(outputs.max(1));
            (0..outputs)
                .map(|i| (whole.saturating_sub(i * part)).min(part) as i64)
                .collect()
        }),
    };
    let mut start = 0;
    let mut parts = vec![];
    for len in lens {
        let len = usize::try_from(len).map_err(|_| format!("has a part of length {len}"))?;
        parts.push(g.slice(value, along, start, len)?);
        start += len;
    }
    if start != whole || parts.len() != outputs {
        return Err(format!(
            "splits {whole} elements into {outputs} parts of {start} in all"
        ));
    }
    Ok(parts)
}

/// A constant around a value: concatenations.
fn pad(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    x.at_most(4)?;
    let mut value = x.get(0)?;
    if let Some(mode) = a.text("mode")?.filter(|mode| mode != "constant") {
        return Err(format!("does not support mode = {mode}, only constant"));
    }
    let pads = wanted(g, x.get(1)?)?;
    let filling = match x.optional(2) {
        Some(id) => {
            let found = g.constant(id).and_then(|tensor| tensor.uniform());
            found.ok_or("needs a constant number to pad with")?
        }
        None => 0.0,
    };
    let axes = match integers(g, x.optional(3))? {
        Some(axes) => axes
            .iter()
            .map(|&i| axis(g, value, i))
            .collect::<Result<Vec<_>, _>>()?,
        None => (0..g.shape(value).len()).collect(),
    };
    if pads.len() != 2 * axes.len() {
        return Err(format!("has {} pads for {} axes", pads.len(), axes.len()));
    }
    let (before, after) = pads.split_at(axes.len());
    for (along, (&before, &after)) in axes.into_iter().zip(before.iter().zip(after)) {
        let side = |g: &mut Graph, len: i64| -> Result<Option<Id>, String> {
            let len = usize::try_from(len).map_err(|_| "has a negative pad".to_owned())?;
            let mut shape = g.shape(value).to_vec();
            shape[along] = Dim::of(len);
            if len == 0 {
                return Ok(None);
            }
            let single = g.add_const(Arc::new(Tensor::scalar(filling)));
            g.expand(single, &shape).map(Some)
        };
        let (first, last) = (side(g, before)?, side(g, after)?);
        let parts: Vec<Id> = [first, Some(value), last].into_iter().flatten().collect();
        value = g.concat(&parts, along)?;
    }
    Ok(value)
}

fn slice(g: &mut Graph, x: &Operands) -> Result<Id, String> {
    let mut value = x.get(0)?;
    let (starts, ends) = (wanted(g, x.get(1)?)?, wanted(g, x.get(2)?)?);
    let axes = integers(g, x.optional(3))?.unwrap_or_else(|| (0..starts.len() as i64).collect());
    let steps = integers(g, x.optional(4))?.unwrap_or_else(|| vec![1; starts.len()]);
    if ends.len() != starts.len() || axes.len() != starts.len() || steps.len() != starts.len() {
        return Err("has starts, ends, axes and steps of different lengths".into());
    }
    for (((start, end), along), step) in starts.into_iter().zip(ends).zip(axes).zip(steps) {
        let along = axis(g, value, along)?;
        let len = g.shape(value)[along]
            .known()
            .ok_or("supports axes of known length only")? as i64;
        if step != 1 {
            return Err(format!("supports step 1 only, not {step}"));
        }
        let clamp = |at: i64| {
            if at < 0 {
                at.saturating_add(len).max(0)
            } else {
                at.min(len)
            }
        };
        let (start, end) = (clamp(start), clamp(end));
        value = g.slice(value, along, start as usize, (end - start).max(0) as usize)?;
    }
    Ok(value)
}

fn gather(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    let (value, index) = (x.get(0)?, x.get(1)?);
    let along = axis(g, value, a.int("axis", 0)?)?;
    let index_shape = g.shape(index).to_vec();
    if g.ty(index) != Type::I64 {
        return Err("needs integer indices".into());
    }
    let before = g.shape(value)[..along].to_vec();
    let after = g.shape(value)[along + 1..].to_vec();
    let shape = [&before[..], &index_shape, &after].concat();
    let Some(rows) = g
        .constant(index)
        .and_then(|tensor| tensor.as_i64())
        .map(<[i64]>::to_vec)
    else {
        if along != 0 {
            return Err("with an index that is not constant is supported along axis 0 only".into());
        }
        let row = g.gather_row(value, index)?;
        return g.reshape(row, &shape);
    };
    let len = g.shape(value)[along]
        .known()
        .ok_or("supports axes of known length only")?;
    let rows: Option<Vec<usize>> = rows.iter().map(|&row| within(row, len)).collect();
    let rows = rows
        .filter(|rows| !rows.is_empty())
        .ok_or_else(|| format!("has indices outside 0..{len}"))?;
    // Rows that follow one another are one slice.
    let runs = rows.chunk_by(|row, next| row + 1 == *next);
    let parts = runs
        .map(|run| g.slice(value, along, run[0], run.len()))
        .collect::<Result<Vec<_>, _>>()?;
    let picked = g.concat(&parts, along)?;
    g.reshape(picked, &shape)
}
