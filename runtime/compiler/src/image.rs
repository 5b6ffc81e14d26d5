//! Writing the program image: contract, strings, programs, ops, weights and the golden episode, laid out as
//! [`lads_core::image`] describes.

use std::collections::HashMap;

use lads_core::image::{
    self, Beyond, CRC_WORD, ContractRecord, DecisionRule, ElementRecord, GoldenRecord,
    InstructionRecord, Layout, PORTS, PolicyKind, PortRecord, ProgramRecord, QuaternionOrder,
    SECTIONS, Section, Text,
};
use lads_image::codec::{Field, Writer};
use lads_image::op::{Place, Port, WeightSpan};

use crate::aligned::Aligned;
use crate::bundle::Bundle;
use crate::contract::{self, Contract};
use crate::error::CompileError;
use crate::golden::Golden;
use crate::plan::Placed;
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
        let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        let crc = image::crc32(&bytes);
        bytes[CRC_WORD * 4..][..4].copy_from_slice(&crc.to_le_bytes());
        Self {
            bytes: Aligned::new(&bytes),
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
    /// In the order of `ProgramKind`, with the tokens that each appends to the cache.
    pub programs: &'a [(&'a Placed, usize)],
    /// Words of each instruction: how many, and where.
    pub words: &'a [(u32, WeightSpan)],
    pub weights: &'a [f32],
    pub cache_len: u32,
    /// Of the golden episode's actions.
    pub tolerance: f32,
}

/// Writes an image.
pub(crate) fn write(
    bundle: &Bundle,
    parts: &Parts,
    report: CompileReport,
) -> Result<Image, CompileError> {
    let mut strings = Strings::default();
    let contract = contract_words(bundle, parts, &mut strings);
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
    let (programs, ops) = program_words(parts);
    let golden = golden_words(bundle.golden(), parts.tolerance);
    let weights: Vec<u32> = parts.weights.iter().map(|x| x.to_bits()).collect();
    let sections: [(Section, Vec<u32>); SECTIONS] = [
        (Section::Contract, contract),
        (Section::Strings, strings),
        (Section::Programs, programs),
        (Section::Ops, ops),
        (Section::Weights, weights),
        (Section::Golden, golden),
    ];
    let lens = sections.each_ref().map(|(_, words)| words.len() * 4);
    let layout = Layout::new(lens).ok_or_else(|| CompileError::TooLarge {
        what: "the policy".into(),
    })?;
    let mut words = vec![0; layout.total_bytes() / 4];
    words[..image::HEADER_WORDS].copy_from_slice(&layout.header());
    for (section, content) in sections {
        let at = layout.section(section).offset / 4;
        words[at..at + content.len()].copy_from_slice(&content);
    }
    Ok(Image::new(&words, report))
}

fn contract_words(bundle: &Bundle, parts: &Parts, strings: &mut Strings) -> Vec<u32> {
    let c: &Contract = bundle.contract();
    let mut out = vec![];
    let record = ContractRecord {
        kind: match c.kind {
            contract::Kind::Lads => PolicyKind::Lads,
        },
        environment_id: strings.add(&c.environment.id),
        environment_version: strings.add(&c.environment.version),
        control_period_s: c.control_period_s,
        horizon: c.horizon as u32,
        codebook_len: c.codebook.size as u32,
        plan_len: c.codebook.dim as u32,
        rule: match c.decision.rule {
            contract::Rule::Argmax => DecisionRule::Argmax,
            contract::Rule::Sample => DecisionRule::Sample,
        },
        temperature: c.decision.temperature,
        seed: c.decision.seed,
        observation_len: c.observation.len() as u32,
        action_len: c.action.len() as u32,
        quaternion_order: match c.quaternion_order {
            contract::QuaternionOrder::None => QuaternionOrder::None,
            contract::QuaternionOrder::Wxyz => QuaternionOrder::Wxyz,
            contract::QuaternionOrder::Xyzw => QuaternionOrder::Xyzw,
        },
        words_len: c.context.words as u32,
        word_dim: c.language.dim as u32,
        context_steps: c.context.steps as u32,
        beyond: match c.context.beyond {
            contract::Beyond::Restart => Beyond::Restart,
            contract::Beyond::Refuse => Beyond::Refuse,
        },
        layers: c.network.layers as u32,
        heads: c.network.heads as u32,
        head_dim: c.network.head_dim as u32,
        instruction_count: c.instructions.len() as u32,
        encoder: strings.add(&c.language.encoder),
        encoder_sha256: strings.add(&c.language.sha256),
        bundle_sha256: strings.add(bundle.sha256()),
        cache_len: parts.cache_len,
    };
    put(&mut out, &record);
    for element in c.observation.iter().chain(&c.action) {
        let record = ElementRecord {
            name: strings.add(&element.name),
            unit: strings.add(&element.unit),
            joint: strings.add(element.joint.as_deref().unwrap_or("")),
            min: element.min,
            max: element.max,
        };
        put(&mut out, &record);
    }
    for (known, &(words_len, words)) in c.instructions.iter().zip(parts.words) {
        let record = InstructionRecord {
            id: strings.add(&known.id),
            text: strings.add(&known.text),
            sub_tasks: strings.add(&known.sub_tasks.join(",")),
            split: strings.add(&known.split),
            words_len,
            words,
        };
        put(&mut out, &record);
    }
    out
}

/// The program records and the ops.
fn program_words(parts: &Parts) -> (Vec<u32>, Vec<u32>) {
    let (mut programs, mut ops) = (vec![], vec![]);
    let mut first_op = 0;
    for &(program, tokens) in parts.programs {
        let record = ProgramRecord {
            first_op,
            ops_len: program.ops.len() as u32,
            arena_len: program.arena_len,
            tokens: tokens as u32,
            inputs_len: program.inputs.len() as u32,
            inputs: port_records(&program.inputs),
            outputs_len: program.outputs.len() as u32,
            outputs: port_records(&program.outputs),
        };
        put(&mut programs, &record);
        ops.extend(program.ops.iter().flat_map(lads_image::op::Op::encode));
        first_op += program.ops.len() as u32;
    }
    (programs, ops)
}

/// Entries beyond the ports stay empty. No program of this compiler has more than [`PORTS`].
fn port_records(ports: &[(Port, Place)]) -> [PortRecord; PORTS] {
    let mut records = [PortRecord::default(); PORTS];
    for (record, &(port, place)) in records.iter_mut().zip(ports) {
        *record = PortRecord { port, place };
    }
    records
}

fn golden_words(golden: &Golden, tolerance: f32) -> Vec<u32> {
    let mut out = vec![];
    put(
        &mut out,
        &GoldenRecord {
            instruction: golden.instruction as u32,
            steps: golden.steps() as u32,
            tolerance,
        },
    );
    out.extend(golden.observations.iter().map(|x| x.to_bits()));
    out.extend(&golden.plans);
    out.extend(golden.actions.iter().map(|x| x.to_bits()));
    out
}
