//! Imports sequences of values: lists that are known at compile time, so that a program contains
//! none.

use std::collections::HashMap;
use std::sync::Arc;

use super::attributes::Attributes;
use super::shapes::{axis, integers, within};
use crate::graph::{Dim, Graph, Id};
use crate::onnx::NodeProto;
use crate::tensor::Tensor;

/// Largest number of values of a sequence.
const MAX_LEN: usize = 1024;

/// Result of a node that reads or writes a sequence.
pub(super) enum Given {
    Value(Id),
    Sequence(Vec<Id>),
}

/// Returns whether an operator reads or writes a sequence.
pub(super) fn is_known(operator: &str) -> bool {
    matches!(
        operator,
        "SplitToSequence"
            | "SequenceAt"
            | "SequenceConstruct"
            | "SequenceEmpty"
            | "SequenceInsert"
            | "SequenceLength"
            | "ConcatFromSequence"
    )
}

/// Adds a node that reads or writes a sequence. `inputs` are the values that it reads, sequences
/// left out.
pub(super) fn translate(
    g: &mut Graph,
    node: &NodeProto,
    inputs: &[Option<Id>],
    sequences: &HashMap<String, Vec<Id>>,
    a: &Attributes,
) -> Result<Given, String> {
    let get = |i: usize| {
        let found = inputs.get(i).copied().flatten();
        found.ok_or_else(|| format!("misses its input {i}"))
    };
    let list = || {
        let found = node.input.first().and_then(|name| sequences.get(name));
        found.ok_or("misses its sequence")
    };
    // An index that may count from the end, of so many.
    let index = |g: &Graph, i: usize, len: usize| -> Result<usize, String> {
        let at = integers(g, Some(get(i)?))?.unwrap_or_default();
        let at = at.first().and_then(|&at| within(at, len));
        at.ok_or_else(|| format!("has an index outside 0..{len}"))
    };
    Ok(match node.op_type.as_str() {
        "SequenceConstruct" => {
            Given::Sequence((0..inputs.len()).map(get).collect::<Result<_, _>>()?)
        }
        "SequenceEmpty" => {
            a.int("dtype", 1)?;
            Given::Sequence(vec![])
        }
        "SequenceAt" => {
            let list = list()?;
            Given::Value(list[index(g, 1, list.len())?])
        }
        "SequenceInsert" => {
            let mut list = list()?.clone();
            let at = match inputs.get(2) {
                Some(Some(_)) => index(g, 2, list.len() + 1)?,
                _ => list.len(),
            };
            list.insert(at, get(1)?);
            Given::Sequence(list)
        }
        "SequenceLength" => {
            let len = Tensor::i64(&[], vec![list()?.len() as i64]);
            Given::Value(g.add_const(Arc::new(len)))
        }
        "ConcatFromSequence" => {
            let list = list()?.clone();
            let &first = list.first().ok_or("joins an empty sequence")?;
            let new_axis = a.flag("new_axis", false)?;
            let rank = g.shape(first).len() + usize::from(new_axis);
            let along = within(a.int("axis", 0)?, rank).ok_or("names an axis that is not there")?;
            let mut parts = list;
            if new_axis {
                for part in &mut parts {
                    let mut shape = g.shape(*part).to_vec();
                    shape.insert(along, Dim::of(1));
                    *part = g.reshape(*part, &shape)?;
                }
            }
            Given::Value(g.concat(&parts, along)?)
        }
        _ => split(g, get(0)?, inputs.get(1).copied().flatten(), a)?,
    })
}

fn split(g: &mut Graph, value: Id, lens: Option<Id>, a: &Attributes) -> Result<Given, String> {
    let along = axis(g, value, a.int("axis", 0)?)?;
    // Only parts of one element lose their axis, where no lengths are given.
    let keep = a.flag("keepdims", true)? || lens.is_some();
    let whole = g.shape(value)[along]
        .known()
        .ok_or("supports axes of known length only")?;
    let one_length = lens.is_none_or(|id| g.shape(id).is_empty());
    let mut lens = integers(g, lens)?.unwrap_or_else(|| vec![1]);
    if one_length {
        let part = usize::try_from(lens[0]).unwrap_or(0).max(1);
        lens = (0..whole.div_ceil(part))
            .map(|i| part.min(whole - i * part) as i64)
            .collect();
    }
    if lens.len() > MAX_LEN {
        return Err(format!("makes a sequence of more than {MAX_LEN} values"));
    }
    let (mut at, mut parts) = (0_usize, vec![]);
    for len in lens {
        let len = usize::try_from(len).map_err(|_| "has a part of negative length")?;
        let part = g.slice(value, along, at, len)?;
        at = at.saturating_add(len);
        let mut shape = g.shape(part).to_vec();
        if !keep {
            shape.remove(along);
        }
        parts.push(g.reshape(part, &shape)?);
    }
    if at != whole {
        return Err(format!("splits {whole} elements into parts of {at} in all"));
    }
    Ok(Given::Sequence(parts))
}
