//! Entries of an image with their ports and ops, and the schedule.

use lads_image::op::{Op, Place};
use lads_image::records::{CallRecord, EntryRecord, NONE, PortRecord, Repeat, Source, SourceKind};

use super::states::Used;
use super::{Parts, Strings, put};
use crate::contract::Contract;
use crate::family::{Bound, Call, Times};

/// Encoded entries, their ports and their ops.
#[derive(Default)]
pub(super) struct Entries {
    pub records: Vec<u32>,
    pub ports: Vec<u32>,
    pub ops: Vec<u32>,
}

pub(super) fn entry_words(
    contract: &Contract,
    parts: &Parts,
    states: &[Used],
    strings: &mut Strings,
) -> Entries {
    let mut out = Entries::default();
    let place_of = |of: usize| states.iter().position(|state| state.of == of);
    let (mut first_op, mut first_port) = (0, 0);
    for made in parts.made {
        let entry = &parts.blueprint.entries[made.entry];
        let mut ports = |ports: &[(String, Place)], input: bool| {
            let mut count = 0;
            for (name, place) in ports {
                let bound = parts.blueprint.bind(contract, &entry.name, name, input);
                let Some(source) = bound.and_then(|bound| source(parts, bound, &place_of)) else {
                    continue;
                };
                let record = PortRecord {
                    name: strings.add(name),
                    source,
                    place: *place,
                };
                put(&mut out.ports, &record);
                count += 1;
            }
            count
        };
        let inputs_len = ports(&made.placed.inputs, true);
        let outputs_len = ports(&made.placed.outputs, false);
        let cache = entry.cache.as_ref().and_then(|name| {
            let of = parts
                .blueprint
                .states
                .iter()
                .position(|state| state.name == *name)?;
            place_of(of)
        });
        let record = EntryRecord {
            name: strings.add(&entry.name),
            first_op,
            ops_len: made.placed.ops.len() as u32,
            arena_len: made.placed.arena_len,
            cache: cache.map_or(NONE, |state| state as u32),
            tokens: made.tokens as u32,
            first_input: first_port,
            inputs_len,
            first_output: first_port + inputs_len,
            outputs_len,
        };
        put(&mut out.records, &record);
        out.ops.extend(made.placed.ops.iter().flat_map(Op::encode));
        first_op += made.placed.ops.len() as u32;
        first_port += inputs_len + outputs_len;
    }
    out
}

fn source(
    parts: &Parts,
    bound: Bound,
    place_of: &impl Fn(usize) -> Option<usize>,
) -> Option<Source> {
    let (kind, of) = match bound {
        Bound::Channel(index) => (SourceKind::Channel, index),
        Bound::State(index) => (SourceKind::State, place_of(index)?),
        Bound::Row(index) => (SourceKind::Row, place_of(index)?),
        Bound::Timestep => (SourceKind::Timestep, 0),
        Bound::Phase => (SourceKind::Phase, parts.blueprint.period),
        Bound::Pass => (SourceKind::Pass, 0),
        Bound::Selected => (SourceKind::Selected, 0),
        Bound::Cache => return None,
    };
    Some(Source {
        kind,
        of: of as u32,
    })
}

/// Encodes the schedule, by event, and the states that its calls clear.
pub(super) fn call_words(parts: &Parts, states: &[Used]) -> (Vec<u32>, Vec<u32>) {
    let (mut calls, mut clears) = (vec![], vec![]);
    let state = |name: &String| {
        let of = parts
            .blueprint
            .states
            .iter()
            .position(|state| state.name == *name)?;
        let found = states.iter().position(|state| state.of == of);
        found.map(|state| state as u32)
    };
    let entry = |call: &Call| {
        let mut made = parts.made.iter();
        let found = made.position(|made| parts.blueprint.entries[made.entry].name == call.entry);
        found.map(|entry| entry as u32)
    };
    let mut sorted: Vec<&Call> = parts.blueprint.calls.iter().collect();
    sorted.sort_by_key(|call| call.event as u32);
    for call in sorted {
        // Calls of entries that the bundle leaves out.
        let Some(entry) = entry(call) else { continue };
        let cleared: Vec<u32> = call.clears.iter().filter_map(state).collect();
        let (repeat, count) = match &call.times {
            Times::Times(count) => (Repeat::Times, *count as u32),
            Times::Rows(ring) => (Repeat::Rows, state(ring).unwrap_or(NONE)),
        };
        let record = CallRecord {
            event: call.event,
            when: call.when,
            every: call.every as u32,
            otherwise: call.otherwise,
            entry,
            repeat,
            count,
            select: call.select.as_ref().and_then(state).unwrap_or(NONE),
            first_clear: clears.len() as u32,
            clears_len: cleared.len() as u32,
        };
        put(&mut calls, &record);
        clears.extend(cleared);
    }
    (calls, clears)
}
