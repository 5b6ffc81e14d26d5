//! States of an image: the used ones, their widths and their places.

use lads_image::op::Place;
use lads_image::records::{Fill, Scope, StateKind, StateRecord};

use super::{Parts, Strings};
use crate::contract::Contract;
use crate::family::{Bound, Keep};
use crate::lower::Cache;

/// A state that an entry uses, with its place in the image.
pub(super) struct Used {
    /// Index into the blueprint's states.
    pub of: usize,
    pub record: StateRecord,
}

/// Returns the states in the image's order, rings and KV caches first; unused states are left out.
pub(super) fn states(parts: &Parts, contract: &Contract, strings: &mut Strings) -> Vec<Used> {
    let (mut rows, mut plain) = (vec![], vec![]);
    let (mut row_end, mut bank_end, mut scratch_end) = (0, 0, 0);
    for (of, state) in parts.blueprint.states.iter().enumerate() {
        let Some(width) = width(parts, contract, of) else {
            continue;
        };
        let name = strings.add(&state.name);
        let mut record = StateRecord {
            name,
            kind: StateKind::Plain,
            scope: state.scope,
            width,
            rows: 1,
            fill: Fill::Zero,
            offset: 0,
        };
        match state.keep {
            Keep::Plain => {
                let end = if state.scope == Scope::Step {
                    &mut scratch_end
                } else {
                    &mut bank_end
                };
                record.offset = *end;
                *end += width;
                plain.push(Used { of, record });
            }
            Keep::Ring { rows: count, fill } => {
                (record.kind, record.rows, record.fill) = (StateKind::Ring, count as u32, fill);
                record.offset = row_end;
                row_end += width * (count as u32 + 1);
                rows.push(Used { of, record });
            }
            Keep::Kv(_) => {
                let capacity = parts
                    .caches
                    .get(&state.name)
                    .map_or(0, |cache| cache.capacity);
                (record.kind, record.rows) = (StateKind::Kv, capacity as u32);
                record.offset = row_end;
                let halves = if is_cleared(parts, &state.name) { 2 } else { 1 };
                row_end += width * halves;
                rows.push(Used { of, record });
            }
        }
    }
    rows.into_iter().chain(plain).collect()
}

/// Returns whether a call clears a state; its cache then has two halves.
fn is_cleared(parts: &Parts, name: &str) -> bool {
    let mut calls = parts.blueprint.calls.iter();
    calls.any(|call| call.clears.iter().any(|cleared| cleared == name))
}

/// Returns the number of elements of a state, or of words of a KV cache; `None` when no program
/// uses it.
fn width(parts: &Parts, contract: &Contract, of: usize) -> Option<u32> {
    let state = &parts.blueprint.states[of];
    if let Keep::Kv(_) = state.keep {
        let used = parts.made.iter().any(|made| {
            let entry = &parts.blueprint.entries[made.entry];
            entry.cache.as_ref() == Some(&state.name)
        });
        return used.then(|| parts.caches.get(&state.name)?.len()).flatten();
    }
    let rows = |bound: Bound, input: bool| match (state.keep, bound) {
        (Keep::Ring { rows, .. }, Bound::State(_)) if input => rows as u32,
        _ => 1,
    };
    parts.made.iter().find_map(|made| {
        let entry = &parts.blueprint.entries[made.entry];
        let ports = [(&made.placed.inputs, true), (&made.placed.outputs, false)];
        ports.into_iter().find_map(|(ports, input)| {
            ports.iter().find_map(|(name, place)| {
                let bound = parts.blueprint.bind(contract, &entry.name, name, input)?;
                match (bound, place) {
                    (Bound::State(index) | Bound::Row(index), Place::Span(span)) if index == of => {
                        Some(span.len / rows(bound, input))
                    }
                    _ => None,
                }
            })
        })
    })
}

/// Returns the number of 4-byte words of all KV caches.
pub(crate) fn rows_len(parts: &Parts) -> usize {
    let words = |(name, cache): (&String, &Cache)| {
        let halves = if is_cleared(parts, name) { 2 } else { 1 };
        cache.len().unwrap_or(0) as usize * halves
    };
    parts.caches.iter().map(words).sum()
}
