//! Imports operators that assemble values from parts: padding, tiling, scattering.

use super::Operands;
use super::arithmetic::{constant, number};
use super::attributes::Attributes;
use super::indices::MAX_PICKED;
use super::shapes::{axis, integers, wanted, within};
use crate::graph::{Dim, Graph, Id, Type};

/// Adds padding, whose parameters are attributes in operator sets before 11, inputs since.
pub(super) fn pad(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    let mode = a.text("mode")?;
    if mode.as_deref().is_some_and(|mode| mode != "constant") {
        return Err("supports mode = constant only".into());
    }
    let mut value = x.get(0)?;
    if g.ty(value) != Type::F32 {
        return Err("supports numbers only".into());
    }
    let (pads, with) = if x.opset < 11 {
        let pads = a.ints("pads")?.ok_or("misses pads")?.to_vec();
        let with = a.float("value", 0.0)?;
        (pads, constant(g, with))
    } else {
        let pads = wanted(g, x.get(1)?)?;
        let with = x.optional(2).unwrap_or_else(|| constant(g, 0.0));
        (pads, number(g, with)?)
    };
    let rank = g.shape(value).len();
    let axes = integers(g, x.optional(3))?.unwrap_or_else(|| (0..rank as i64).collect());
    if pads.len() != 2 * axes.len() {
        return Err(format!("has {} pads for {} axes", pads.len(), axes.len()));
    }
    let with = g.reshape(with, &[])?;
    for (i, &along) in axes.iter().enumerate() {
        let along = axis(g, value, along)?;
        let (before, after) = (pads[i], pads[axes.len() + i]);
        // Negative ones take away.
        let cut = |pad: i64| pad.min(0).unsigned_abs() as usize;
        if before < 0 || after < 0 {
            let len = g.shape(value)[along].known().unwrap_or(0);
            let left = len.checked_sub(cut(before).saturating_add(cut(after)));
            let left = left.ok_or("takes away more than there is")?;
            value = g.slice(value, along, cut(before), left)?;
        }
        let mut shape = g.shape(value).to_vec();
        let mut parts = vec![value];
        for (pad, at) in [(before, 0), (after, usize::MAX)] {
            if let Ok(len @ 1..) = usize::try_from(pad) {
                shape[along] = Dim::of(len);
                let part = g.expand(with, &shape)?;
                parts.insert(at.min(parts.len()), part);
            }
        }
        value = g.concat(&parts, along)?;
    }
    Ok(value)
}

/// Repeats the value along each axis.
pub(super) fn tile(g: &mut Graph, x: &Operands) -> Result<Id, String> {
    let mut value = x.get(0)?;
    let repeats = wanted(g, x.get(1)?)?;
    if repeats.len() != g.shape(value).len() {
        return Err("needs a number of repeats for each axis".into());
    }
    for (along, &count) in repeats.iter().enumerate() {
        let count = usize::try_from(count).unwrap_or(0);
        if !(1..=MAX_PICKED).contains(&count) {
            return Err(format!(
                "repeats {count} times, 1 to {MAX_PICKED} are supported"
            ));
        }
        value = g.concat(&vec![value; count], along)?;
    }
    Ok(value)
}

/// Replaces elements of the data at constant indices by the updates.
pub(super) fn scatter(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    if a.text("reduction")?.is_some_and(|how| how != "none") {
        return Err("supports no reduction".into());
    }
    let (data, indices, updates) = (x.get(0)?, x.get(1)?, x.get(2)?);
    let at = wanted(g, indices)?;
    let shape = g.known_shape(data).ok_or("supports static shapes only")?;
    let &depth = g
        .known_shape(indices)
        .unwrap_or_default()
        .last()
        .filter(|&&depth| (1..=shape.len()).contains(&depth))
        .ok_or("has indices of more axes than its data")?;
    // A row for each combination of indices.
    let (outer, inner) = shape.split_at(depth);
    let (count, len) = (outer.iter().product(), inner.iter().product());
    if count > MAX_PICKED {
        return Err(format!("has {count} rows, {MAX_PICKED} are supported"));
    }
    let mut source: Vec<Option<usize>> = vec![None; count];
    for (update, index) in at.chunks(depth).enumerate() {
        let mut row = 0;
        for (&i, &dim) in index.iter().zip(outer) {
            let i = within(i, dim).ok_or_else(|| format!("has indices outside 0..{dim}"))?;
            row = row * dim + i;
        }
        source[row] = Some(update);
    }
    let flat = [Dim::of(count), Dim::of(len)];
    let rows = g.reshape(data, &flat)?;
    let updates = g.reshape(updates, &[Dim::of(at.len() / depth), Dim::of(len)])?;
    // Rows that follow each other on both sides are one part.
    let mut runs: Vec<(Id, usize, usize)> = vec![];
    for (row, update) in source.into_iter().enumerate() {
        let (from, first) = update.map_or((rows, row), |update| (updates, update));
        match runs.last_mut() {
            Some((id, start, len)) if *id == from && *start + *len == first => *len += 1,
            _ => runs.push((from, first, 1)),
        }
    }
    let mut parts = vec![];
    for (from, first, len) in runs {
        parts.push(g.slice(from, 0, first, len)?);
    }
    let all = g.concat(&parts, 0)?;
    let shape: Vec<Dim> = shape.iter().map(|&dim| Dim::of(dim)).collect();
    g.reshape(all, &shape)
}
