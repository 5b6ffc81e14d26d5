//! Writes the program image: the records of [`lads_image::records`] in the sections of
//! [`lads_image::format`].

mod schedule;
mod states;

use std::collections::HashMap;

use lads_image::codec::{Field, Writer};
use lads_image::format::{self, CRC_WORD, Layout, SECTIONS, Tag};
use lads_image::op::WeightSpan;
use lads_image::records::{
    self, ChannelRecord, ContractRecord, ElementRecord, GoldenRecord, InstructionRecord, NONE, Text,
};

use crate::aligned::Aligned;
use crate::bundle::Bundle;
use crate::compile::Made;
use crate::contract::{self, Channel, Contract};
use crate::error::CompileError;
use crate::family::Blueprint;
use crate::golden::{Golden, Recorded};
use crate::lower::Cache;
use crate::report::CompileReport;

use schedule::{call_words, entry_words};
pub(crate) use states::rows_len;
use states::states;

/// A compiled policy image.
#[derive(Debug)]
pub struct Image {
    bytes: Aligned,
    report: CompileReport,
}

impl Image {
    /// Returns the image; its address is a multiple of 64.
    pub fn as_bytes(&self) -> &[u8] {
        self.bytes.as_bytes()
    }

    /// Returns the sizes of the compiled programs.
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

/// Appends the words of a record.
fn put<T: Field>(out: &mut Vec<u32>, record: &T) {
    let start = out.len();
    out.resize(start + T::WORDS, 0);
    record.put(&mut Writer::new(&mut out[start..]));
}

/// All texts, each stored once.
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

/// Parts of an image that the bundle does not contain.
pub(crate) struct Parts<'a> {
    pub blueprint: &'a Blueprint,
    /// KV caches by the names of their states.
    pub caches: &'a HashMap<String, Cache>,
    pub made: &'a [Made],
    /// Number and place of the words of each instruction.
    pub words: &'a [(u32, WeightSpan)],
    pub weights: &'a [f32],
    /// Tolerance of the golden episode's actions.
    pub tolerance: f32,
    /// Number of multiply-adds of the worst step.
    pub work: u64,
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
        (Tag::Entries, entries.records),
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
    /// Threshold above any similarity: no other sentence is followed.
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

/// Encodes the channels and their elements.
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

/// Returns the shape, padded with ones at the end.
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
