//! Imports operators that take parts of values: slices, splits, and gathers by an index.

use super::Operands;
use super::attributes::Attributes;
use super::operators::Outputs;
use super::shapes::{axis, integers, wanted, within};
use crate::graph::{Dim, Graph, Id, Type};

pub(super) fn split(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
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

/// Adds a slice, whose parameters are attributes in operator sets before 10, inputs since.
pub(super) fn slice(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    let mut value = x.get(0)?;
    let (starts, ends, axes, steps);
    if x.opset < 10 {
        x.at_most(1)?;
        let ints = |name| Ok::<_, String>(a.ints(name)?.map(<[i64]>::to_vec));
        starts = ints("starts")?.ok_or("misses starts")?;
        ends = ints("ends")?.ok_or("misses ends")?;
        (axes, steps) = (ints("axes")?, None);
    } else {
        (starts, ends) = (wanted(g, x.get(1)?)?, wanted(g, x.get(2)?)?);
        axes = integers(g, x.optional(3))?;
        steps = integers(g, x.optional(4))?;
    }
    let axes = axes.unwrap_or_else(|| (0..starts.len() as i64).collect());
    let steps = steps.unwrap_or_else(|| vec![1; starts.len()]);
    if ends.len() != starts.len() || axes.len() != starts.len() || steps.len() != starts.len() {
        return Err("has starts, ends, axes and steps of different lengths".into());
    }
    for (((start, end), along), step) in starts.into_iter().zip(ends).zip(axes).zip(steps) {
        let along = axis(g, value, along)?;
        let len = g.shape(value)[along]
            .known()
            .ok_or("supports axes of known length only")? as i64;
        if step != 1 {
            value = stepped(g, value, along, [start, end, step])?;
            continue;
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

/// Takes every `step`th element of an axis, backwards if `step` is negative.
fn stepped(
    g: &mut Graph,
    value: Id,
    along: usize,
    [start, end, step]: [i64; 3],
) -> Result<Id, String> {
    let len = g.shape(value)[along].known().unwrap_or(0) as i64;
    let from_end = |at: i64| if at < 0 { at.saturating_add(len) } else { at };
    // Backwards, the end may be before the first element.
    let (low, high) = if step < 0 { (-1, len - 1) } else { (0, len) };
    let end = from_end(end).clamp(low, high);
    let mut at = from_end(start).clamp(low.max(0), high);
    let mut picked = vec![];
    while if step > 0 { at < end } else { at > end } {
        picked.push(at as usize);
        at = at.saturating_add(step);
    }
    rows(g, value, along, &picked)
}

/// Largest number of rows that are picked one by one.
pub(super) const MAX_PICKED: usize = 1024;

/// Takes rows of an axis, in any order.
fn rows(g: &mut Graph, value: Id, along: usize, rows: &[usize]) -> Result<Id, String> {
    if rows.is_empty() || rows.len() > MAX_PICKED {
        return Err(format!(
            "picks {} rows one by one, 1 to {MAX_PICKED} are supported",
            rows.len()
        ));
    }
    if rows.windows(2).all(|pair| pair[0] + 1 == pair[1]) {
        return g.slice(value, along, rows[0], rows.len());
    }
    let runs = rows.chunk_by(|a, b| a + 1 == *b);
    let parts = runs
        .map(|run| g.slice(value, along, run[0], run.len()))
        .collect::<Result<Vec<_>, _>>()?;
    g.concat(&parts, along)
}

pub(super) fn gather(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    let (value, index) = (x.get(0)?, x.get(1)?);
    let along = axis(g, value, a.int("axis", 0)?)?;
    let index_shape = g.shape(index).to_vec();
    // An integer that was computed is a number.
    let index = match g.ty(index) {
        Type::F32 => g.index_of(index)?,
        Type::I64 => index,
    };
    let before = g.shape(value)[..along].to_vec();
    let after = g.shape(value)[along + 1..].to_vec();
    let shape = [&before[..], &index_shape, &after].concat();
    let Some(indices) = g
        .constant(index)
        .and_then(|tensor| tensor.as_i64())
        .map(<[i64]>::to_vec)
    else {
        let mut perm: Vec<usize> = (0..g.shape(value).len()).collect();
        perm.remove(along);
        perm.insert(0, along);
        let table = g.transpose(value, &perm)?;
        let row = g.gather_row(table, index)?;
        return g.reshape(row, &shape);
    };
    let len = g.shape(value)[along]
        .known()
        .ok_or("supports axes of known length only")?;
    let picked: Option<Vec<usize>> = indices.iter().map(|&row| within(row, len)).collect();
    let picked = picked.ok_or_else(|| format!("has indices outside 0..{len}"))?;
    let picked = rows(g, value, along, &picked)?;
    g.reshape(picked, &shape)
}

/// Adds a gather of rows by all indices of a row of `indices` at once: constants, or one computed
/// index of the first axis.
pub(super) fn gather_nd(g: &mut Graph, x: &Operands, a: &Attributes) -> Result<Id, String> {
    a.only("batch_dims", 0)?;
    let (value, index) = (x.get(0)?, x.get(1)?);
    let from = g.known_shape(value).ok_or("supports static shapes only")?;
    let index_shape = g.shape(index).to_vec();
    let depth = index_shape.last().and_then(|dim| dim.known());
    let (Some(depth @ 1..), [outer @ .., _]) = (depth, &index_shape[..]) else {
        return Err("needs indices of static shape".into());
    };
    if depth > from.len() {
        return Err("has indices of more axes than its data".into());
    }
    let shape = [outer, &g.shape(value)[depth..]].concat();
    let Some(indices) = g.constant(index).and_then(|tensor| tensor.as_i64()) else {
        if depth != 1 {
            return Err("supports an index of one axis only where it is computed".into());
        }
        let index = match g.ty(index) {
            Type::F32 => g.index_of(index)?,
            Type::I64 => index,
        };
        let row = g.gather_row(value, index)?;
        return g.reshape(row, &shape);
    };
    let axes = &from[..depth];
    let picked: Option<Vec<usize>> = indices
        .chunks(depth)
        .map(|at| {
            let mut pairs = at.iter().zip(axes);
            pairs.try_fold(0, |row, (&i, &dim)| Some(row * dim + within(i, dim)?))
        })
        .collect();
    let picked = picked.ok_or_else(|| format!("has indices outside of {axes:?}"))?;
    let mut flat = vec![Dim::of(axes.iter().product())];
    flat.extend_from_slice(&g.shape(value)[depth..]);
    let table = g.reshape(value, &flat)?;
    let picked = rows(g, table, 0, &picked)?;
    g.reshape(picked, &shape)
}
