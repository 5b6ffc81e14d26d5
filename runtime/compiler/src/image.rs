//! Writing the program image: the records of [`lads_image::records`] in the sections of [`lads_image::format`].

use std::collections::HashMap;

use lads_image::codec::{Field, Writer};
use lads_image::format::{self, CRC_WORD, Layout, SECTIONS, Tag};
use lads_image::op::{Op, Place, WeightSpan};
use lads_image::records::{
    self, CallRecord, ChannelRecord, ContractRecord, ElementRecord, EntryRecord, Fill,
    GoldenRecord, InstructionRecord, NONE, PortRecord, Repeat, Scope, Source, SourceKind,
    StateKind, StateRecord, Text,
};

use crate::aligned::Aligned;
use crate::bundle::Bundle;
use crate::compile::Made;
use crate::contract::{self, Channel, Contract};
use crate::error::CompileError;
use crate::family::{Blueprint, Bound, Call, Keep, Times};
use crate::golden::{Golden, Recorded};
use crate::lower::Cache;
use crate::report::CompileReport;

/// A compiled policy.
#[derive(Debug)]
pub struct Image {
    bytes: Aligned,
    report: CompileReport,
}

impl Image {
    /// The image; its address is a multiple of 64.
    pub fn as_bytes(&self) -> &[u8] {
        self.bytes.as_bytes()
    }

    /// Sizes of what was compiled.
    pub fn report(&self) -> &CompileReport {
        &self.report
    }

    fn new(words: &[u32], report: CompileReport) -> Self {
        let mut words: Vec<u32> = words.iter().map(|word| word.to_le()).collect();
        words[CRC_WORD] = format::crc32(bytemuck::cast_slice(&words)).to_le();
        Self {
            bytes: Aligned::new(&words),
            report,
        }
    }
}

/// Words of a record.
fn put<T: Field>(out: &mut Vec<u32>, record: &T) {
    let start = out.len();
    out.resize(start + T::WORDS, 0);
    record.put(&mut Writer::new(&mut out[start..]));
}

/// All texts, each once.
#[derive(Default)]
struct Strings {
    bytes: Vec<u8>,
    known: HashMap<String, Text>,
}

impl Strings {
    fn add(&mut self, text: &str) -> Text {
        if let Some(&known) = self.known.get(text) {
            return known;
        }
        let added = Text {
            offset: self.bytes.len() as u32,
            len: text.len() as u32,
        };
        self.bytes.extend_from_slice(text.as_bytes());
        self.known.insert(text.into(), added);
        added
    }
}

/// What goes into an image besides what the bundle says.
pub(crate) struct Parts<'a> {
    pub blueprint: &'a Blueprint,
    /// By the names of their states.
    pub caches: &'a HashMap<String, Cache>,
    pub made: &'a [Made],
    /// Words of each instruction: how many, and where.
    pub words: &'a [(u32, WeightSpan)],
    pub weights: &'a [f32],
    /// Of the golden episode's actions.
    pub tolerance: f32,
    /// Multiply-adds of the worst step.
    pub work: u64,
}

/// A state that an entry uses, with its place in the image.
struct Used {
    /// Index into the blueprint's states.
    of: usize,
    record: StateRecord,
}

/// The states in the image's order, rings and KV caches first; those that nothing uses are left out.
fn states(parts: &Parts, contract: &Contract, strings: &mut Strings) -> Vec<Used> {
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

/// Whether a call clears a state; its cache then has two halves.
fn is_cleared(parts: &Parts, name: &str) -> bool {
    let mut calls = parts.blueprint.calls.iter();
    calls.any(|call| call.clears.iter().any(|cleared| cleared == name))
}

/// Elements of a state, or words of a KV cache; `None` when no program uses it.
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

/// 4-byte words of all rings and KV caches.
pub(crate) fn rows_len(parts: &Parts) -> usize {
    let words = |(name, cache): (&String, &Cache)| {
        let halves = if is_cleared(parts, name) { 2 } else { 1 };
        cache.len().unwrap_or(0) as usize * halves
    };
    parts.caches.iter().map(words).sum()
}

/// Writes an image.
pub(crate) fn write(
    bundle: &Bundle,
    parts: &Parts,
    report: CompileReport,
) -> Result<Image, CompileError> {
    let contract = bundle.contract();
    let mut strings = Strings::default();
    let states = states(parts, contract, &mut strings);
    let fixed = contract_words(bundle, parts, &mut strings);
    let (channels, elements) = channel_words(contract, &mut strings);
    let instructions = instruction_words(contract, parts, &mut strings);
    let entries = entry_words(contract, parts, &states, &mut strings);
    let (calls, clears) = call_words(parts, &states);
    let mut state_words = vec![];
    for state in &states {
        put(&mut state_words, &state.record);
    }
    while !strings.bytes.len().is_multiple_of(4) {
        strings.bytes.push(0);
    }
    let strings: Vec<u32> = strings
        .bytes
        .as_chunks::<4>()
        .0
        .iter()
        .map(|&word| u32::from_le_bytes(word))
        .collect();
    let golden = golden_words(bundle.golden(), parts.tolerance);
    let weights: Vec<u32> = parts.weights.iter().map(|x| x.to_bits()).collect();
    let sections: [(Tag, Vec<u32>); SECTIONS] = [
        (Tag::Contract, fixed),
        (Tag::Channels, channels),
        (Tag::Elements, elements),
        (Tag::Instructions, instructions),
        (Tag::Strings, strings),
        (Tag::States, state_words),
        (Tag::Entries, entries.entries),
        (Tag::Ports, entries.ports),
        (Tag::Calls, calls),
        (Tag::Clears, clears),
        (Tag::Ops, entries.ops),
        (Tag::Weights, weights),
        (Tag::Golden, golden),
    ];
    let lens = sections.each_ref().map(|(_, words)| words.len() * 4);
    let layout = Layout::new(lens).ok_or_else(|| CompileError::TooLarge {
        what: "the policy".into(),
    })?;
    let mut words = vec![0; layout.total_bytes() / 4];
    words[..format::HEADER_WORDS].copy_from_slice(&layout.header());
    for (tag, content) in sections {
        let at = layout.section(tag).offset / 4;
        words[at..at + content.len()].copy_from_slice(&content);
    }
    Ok(Image::new(&words, report))
}

fn contract_words(bundle: &Bundle, parts: &Parts, strings: &mut Strings) -> Vec<u32> {
    /// Above any similarity: no other sentence is followed.
    const NEVER: f32 = 2.0;
    let c: &Contract = bundle.contract();
    let kind = c.family.kind();
    let (selection, noise) = (kind.selection(), kind.noise());
    let language = c.language.as_ref();
    let mut out = vec![];
    let record = ContractRecord {
        family: strings.add(c.family.name()),
        environment_id: strings.add(&c.environment.id),
        environment_version: strings.add(&c.environment.version),
        control_period_s: c.control_period_s,
        selection: selection.rule,
        temperature: selection.temperature,
        selection_seed: selection.seed,
        noise: noise.rule,
        noise_seed: noise.seed,
        context_steps: c.context.map_or(0, |context| context.steps as u32),
        beyond: match c.context.map(|context| context.beyond) {
            Some(contract::Beyond::Refuse) => records::Beyond::Refuse,
            Some(contract::Beyond::Restart) | None => records::Beyond::Restart,
        },
        encoder: strings.add(language.map_or("", |language| &language.encoder)),
        encoder_sha256: strings.add(language.map_or("", |language| &language.sha256)),
        acceptance: language
            .and_then(|language| language.acceptance)
            .map_or(NEVER, |acceptance| acceptance.threshold),
        bundle_sha256: strings.add(bundle.sha256()),
        worst_work: parts.work,
    };
    put(&mut out, &record);
    out
}

/// The channels and their elements.
fn channel_words(contract: &Contract, strings: &mut Strings) -> (Vec<u32>, Vec<u32>) {
    let (mut channels, mut elements) = (vec![], vec![]);
    let mut count = 0;
    for channel in &contract.channels {
        let (min, max) = channel.limits();
        let record = ChannelRecord {
            name: strings.add(&channel.name),
            role: match channel.role {
                contract::Role::Observation => records::Role::Observation,
                contract::Role::Action => records::Role::Action,
                contract::Role::Instruction => records::Role::Instruction,
                contract::Role::Noise => records::Role::Noise,
                contract::Role::Demonstration => records::Role::Demonstration,
            },
            dtype: match channel.dtype {
                contract::DType::F32 => records::DType::F32,
                contract::DType::U8 => records::DType::U8,
                contract::DType::I32 => records::DType::I32,
            },
            rank: channel.shape.len() as u32,
            dims: dims(channel),
            quaternions: match channel.quaternion_order {
                contract::QuaternionOrder::None => records::QuaternionOrder::None,
                contract::QuaternionOrder::Wxyz => records::QuaternionOrder::Wxyz,
                contract::QuaternionOrder::Xyzw => records::QuaternionOrder::Xyzw,
            },
            reference: strings.add(&channel.reference),
            first_element: count,
            elements_len: channel.elements.len() as u32,
            min,
            max,
        };
        put(&mut channels, &record);
        count += channel.elements.len() as u32;
        for element in &channel.elements {
            let mut text = |text: &Option<String>| strings.add(text.as_deref().unwrap_or(""));
            let [joint, interface, physical_unit] = [
                text(&element.joint),
                text(&element.interface),
                text(&element.physical_unit),
            ];
            let record = ElementRecord {
                name: strings.add(&element.name),
                unit: strings.add(&element.unit),
                joint,
                interface,
                physical_unit,
                scale: element.scale,
                offset: element.offset,
                min: element.min,
                max: element.max,
            };
            put(&mut elements, &record);
        }
    }
    (channels, elements)
}

/// The shape, with ones behind it.
fn dims(channel: &Channel) -> [u32; 4] {
    let mut dims = [1; 4];
    for (to, &dim) in dims.iter_mut().zip(&channel.shape) {
        *to = dim as u32;
    }
    dims
}

fn instruction_words(contract: &Contract, parts: &Parts, strings: &mut Strings) -> Vec<u32> {
    let mut out = vec![];
    for (known, &(words_len, words)) in contract.instructions.iter().zip(parts.words) {
        let record = InstructionRecord {
            id: strings.add(&known.id),
            text: strings.add(&known.text),
            words_len,
            words,
        };
        put(&mut out, &record);
    }
    out
}

/// The entries, their ports and their ops.
#[derive(Default)]
struct Entries {
    entries: Vec<u32>,
    ports: Vec<u32>,
    ops: Vec<u32>,
}

fn entry_words(
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
        put(&mut out.entries, &record);
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

/// The schedule, by event, and what its calls clear.
fn call_words(parts: &Parts, states: &[Used]) -> (Vec<u32>, Vec<u32>) {
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

fn golden_words(golden: &Golden, tolerance: f32) -> Vec<u32> {
    let mut out = vec![];
    put(
        &mut out,
        &GoldenRecord {
            instruction: golden.instruction.map_or(NONE, |index| index as u32),
            steps: golden.steps() as u32,
            selects: !golden.selected.is_empty(),
            noise_len: golden.noise_len() as u32,
            tolerance,
        },
    );
    for recorded in &golden.observations {
        match recorded {
            Recorded::F32(values) => out.extend(values.iter().map(|x| x.to_bits())),
            Recorded::I32(values) => out.extend(values.iter().map(|x| x.cast_unsigned())),
            Recorded::U8(values) => {
                let words = values.chunks(4).map(|chunk| {
                    let mut word = [0; 4];
                    word[..chunk.len()].copy_from_slice(chunk);
                    u32::from_le_bytes(word)
                });
                out.extend(words);
            }
        }
    }
    out.extend(&golden.selected);
    out.extend(golden.noise.iter().map(|x| x.to_bits()));
    out.extend(golden.actions.iter().map(|x| x.to_bits()));
    out
}
