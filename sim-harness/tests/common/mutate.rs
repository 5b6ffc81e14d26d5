//! Changes a bundle and verifies the result, without the closed loop, which could only find more.
//!
//! The file is changed as protocol-buffer bytes: values of a tensor in place, the contract as a whole. A changed policy is not run by its
//! self-test, so that what is seen is what the reference sees.

use std::ops::Range;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use lads_compiler::Options;
use lads_core::Isa;
use lads_host::Opened;
use lads_proof::contract::Compared;
use lads_proof::reference::Reference;
use lads_proof::rounding::{Asked, CLEAR_SHARE, Loss};
use lads_sim::evaluate::Assignment;
use lads_sim::verify::{self, policy::Questions};
use serde_json::Value;

// Numbers of the fields of ONNX's messages.
const GRAPH: u64 = 7;
const METADATA: u64 = 14;
const INITIALIZER: u64 = 5;
const DIMS: u64 = 1;
const NAME: u64 = 8;
const RAW_DATA: u64 = 9;
const KEY: u64 = 1;
const VALUE: u64 = 2;
const CONTRACT: &str = "lads.contract";

/// A tensor of 32-bit floats inside the file.
#[derive(Debug, Clone)]
pub struct Tensor {
    /// Name of the tensor, without `weights/`.
    pub name: String,
    /// Number of elements of the tensor's first dimension.
    pub rows: usize,
    bytes: Range<usize>,
}

/// The bytes of a bundle.
#[derive(Debug, Clone)]
pub struct Model {
    bytes: Vec<u8>,
    pub tensors: Vec<Tensor>,
}

fn varint(bytes: &[u8], at: &mut usize) -> u64 {
    let mut value = 0;
    for shift in (0..).step_by(7) {
        let byte = bytes[*at];
        *at += 1;
        value |= u64::from(byte & 0x7f) << shift;
        if byte < 0x80 {
            break;
        }
    }
    value
}

/// Splits a message into its fields: number, the whole field, its content. Fields that are not bytes have their value as content.
fn fields(bytes: &[u8], message: Range<usize>) -> Vec<(u64, Range<usize>, Range<usize>)> {
    let mut found = Vec::new();
    let mut at = message.start;
    while at < message.end {
        let start = at;
        let tag = varint(bytes, &mut at);
        let content = match tag & 7 {
            0 => {
                let value = at;
                varint(bytes, &mut at);
                value..at
            }
            1 => at..at + 8,
            5 => at..at + 4,
            _ => {
                let len = varint(bytes, &mut at) as usize;
                at..at + len
            }
        };
        at = content.end;
        found.push((tag >> 3, start..at, content));
    }
    found
}

fn put(number: u64, content: &[u8], into: &mut Vec<u8>) {
    let mut number_of = |mut value: u64| {
        while value >= 0x80 {
            into.push(value as u8 | 0x80);
            value >>= 7;
        }
        into.push(value as u8);
    };
    number_of(number << 3 | 2);
    number_of(content.len() as u64);
    into.extend_from_slice(content);
}

impl Model {
    pub fn open(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap();
        let mut tensors = Vec::new();
        let top = fields(&bytes, 0..bytes.len());
        let graphs = top.into_iter().filter(|field| field.0 == GRAPH);
        for (.., initializer) in graphs
            .flat_map(|(.., graph)| fields(&bytes, graph))
            .filter(|field| field.0 == INITIALIZER)
        {
            let parts = fields(&bytes, initializer);
            let find = |number| {
                parts
                    .iter()
                    .find(|part| part.0 == number)
                    .map(|part| part.2.clone())
            };
            let (Some(name), Some(data), Some(mut dims)) = (find(NAME), find(RAW_DATA), find(DIMS))
            else {
                continue;
            };
            if let Some(name) = String::from_utf8_lossy(&bytes[name]).strip_prefix("weights/") {
                tensors.push(Tensor {
                    name: name.to_owned(),
                    rows: varint(&bytes, &mut dims.start) as usize,
                    bytes: data,
                });
            }
        }
        assert!(!tensors.is_empty(), "no weights in {}", path.display());
        Self { bytes, tensors }
    }

    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Returns a copy of the bundle with the values of a tensor changed.
    pub fn edit(&mut self, name: &str, change: impl FnOnce(&mut [f32])) {
        let tensor = self.tensors.iter().find(|tensor| tensor.name == name);
        let range = tensor
            .unwrap_or_else(|| panic!("no tensor {name}"))
            .bytes
            .clone();
        let bytes = &mut self.bytes[range];
        let mut values: Vec<f32> = bytes
            .as_chunks::<4>()
            .0
            .iter()
            .map(|&word| f32::from_le_bytes(word))
            .collect();
        change(&mut values);
        for (word, value) in bytes.as_chunks_mut::<4>().0.iter_mut().zip(values) {
            *word = value.to_le_bytes();
        }
    }

    /// Reorders the rows of a tensor: row `n` of the result is row `order[n]`.
    pub fn reorder(&mut self, name: &str, order: &[usize]) {
        self.edit(name, |values| {
            let row = values.len() / order.len();
            let rows: Vec<_> = order
                .iter()
                .flat_map(|&from| values[from * row..(from + 1) * row].to_vec())
                .collect();
            values.copy_from_slice(&rows);
        });
    }

    fn contract_entry(&self) -> (Range<usize>, Range<usize>) {
        let top = fields(&self.bytes, 0..self.bytes.len());
        let mut entries = top.into_iter().filter(|field| field.0 == METADATA);
        let found = entries.find_map(|(_, whole, entry)| {
            let parts = fields(&self.bytes, entry);
            let part = |number| {
                parts
                    .iter()
                    .find(|part| part.0 == number)
                    .map(|part| part.2.clone())
            };
            (&self.bytes[part(KEY)?] == CONTRACT.as_bytes()).then_some((whole, part(VALUE)?))
        });
        found.expect("a bundle has a contract")
    }

    pub fn contract(&self) -> Value {
        serde_json::from_slice(&self.bytes[self.contract_entry().1]).unwrap()
    }

    /// Returns a copy of the bundle with another contract.
    pub fn with_contract(&self, contract: &Value) -> Self {
        let (whole, _) = self.contract_entry();
        let mut entry = Vec::new();
        put(KEY, CONTRACT.as_bytes(), &mut entry);
        put(VALUE, contract.to_string().as_bytes(), &mut entry);
        let mut bytes = self.bytes.clone();
        bytes.drain(whole);
        put(METADATA, &entry, &mut bytes);
        // Tensors stand before the metadata or after it: their places are looked for anew.
        let path = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(path.path(), &bytes).unwrap();
        Self::open(path.path())
    }
}

/// Opens and compiles a bundle, without its self-test; the error is what a person would read.
pub fn open(bytes: &[u8], options: &Options) -> Result<Opened, String> {
    lads_host::from_bytes_with(bytes, options).map_err(|refused| refused.to_string())
}

/// Difference of a logit from which on a change must be found.
pub const LOGIT: f64 = 1e-2;
/// Difference of an action from which on a change must be found.
pub const ACTION: f64 = 1e-4;

/// What a change moves in the policy's answers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moved {
    /// Largest difference of a logit: from the reference's with 32 bits, from those with 32 bits with fewer.
    pub logit: f64,
    /// Largest difference of an action element.
    pub action: f64,
    /// Number of segments that are encoded as another plan.
    pub segments: usize,
    /// Number of decisions that fewer bits let fall out otherwise.
    pub decisions: usize,
    /// Whether enough decisions are clear by more than fewer bits move the logits.
    clear: bool,
    /// Whether the image has fewer bits than 32: then its logits count by what they decide.
    fewer_bits: bool,
}

impl Moved {
    /// Whether anything moves so far that it is to be found.
    pub fn is_much(&self) -> bool {
        let decided = self.decisions > 0 || !self.fewer_bits && self.logit > LOGIT;
        decided || self.action > ACTION || self.segments > 0
    }

    /// Whether nothing moves so far that it may be found.
    pub fn is_little(&self) -> bool {
        !self.is_much() && self.logit <= LOGIT && self.clear
    }
}

#[derive(Debug, Clone)]
pub struct Judged {
    pub contract: Compared,
    pub asked: Asked,
}

impl Judged {
    pub fn different(&self) -> bool {
        !self.contract.differing.is_empty()
            || !self.contract.image_differing.is_empty()
            || !self.asked.differences().is_empty()
    }

    /// Returns the reason that a verdict names first.
    pub fn reason(&self) -> String {
        let field = self
            .contract
            .differing
            .first()
            .map(|it| format!("contract: {}", it.field));
        field
            .or_else(|| self.asked.differences().into_iter().next())
            .unwrap_or_default()
    }

    pub fn moved(&self) -> Moved {
        let answers = &self.asked.policy;
        let rounding = self.asked.rounding.as_ref();
        // What is changed beside the bits moves the logits with 32.
        let exact = self.asked.exact.as_ref().unwrap_or(answers);
        let rounded = rounding.map_or(0.0, |it| it.largest_logit_difference);
        Moved {
            logit: exact.largest_logit_difference.max(rounded),
            action: answers.largest_action_difference,
            segments: answers.differing_segments,
            decisions: match rounding.and_then(|it| it.loss.as_ref()) {
                Some(Loss::Selected { changed, .. }) => *changed,
                _ => 0,
            },
            clear: rounding.is_none_or(|it| it.clear_share >= CLEAR_SHARE),
            fewer_bits: rounding.is_some(),
        }
    }
}

/// Compares an opened bundle with its reference: the contract, and the policy's answers to the first traced episode of the instructions whose
/// index is a multiple of `every`.
pub fn judge(opened: &Opened, reference: &Reference, every: usize) -> Judged {
    let (bundle, policy) = (opened.bundle().unwrap(), opened.policy());
    let known = (0..reference.instructions.len() as u32).step_by(every);
    let assignments: Vec<_> = known
        .map(|instruction| Assignment {
            instruction,
            commanded: Vec::new(),
            max_steps: 0,
        })
        .collect();
    let questions = Questions {
        reference,
        assignments: &assignments,
        episodes: 1,
        shown: None,
    };
    let stop = AtomicBool::new(false);
    let image = (&policy, Isa::detect());
    let (asked, _) = verify::policy::judge(image, bundle, questions, &stop, &|| {}).unwrap();
    let stated = serde_json::from_str(bundle.metadata(CONTRACT).unwrap()).unwrap();
    Judged {
        contract: Compared::new(
            &stated,
            reference.contract.as_ref(),
            [
                &verify::contract::of_image(&policy),
                &verify::contract::of_bundle(bundle).unwrap(),
            ],
        ),
        asked,
    }
}

/// Changes every value of a contract, one at a time: returns its place, and the contract.
pub fn contracts(contract: &Value) -> Vec<(String, Value)> {
    fn places(value: &Value, pointer: String, found: &mut Vec<String>) {
        match value {
            Value::Object(object) => object
                .iter()
                .for_each(|(key, value)| places(value, format!("{pointer}/{key}"), found)),
            Value::Array(list) => list
                .iter()
                .enumerate()
                .for_each(|(index, value)| places(value, format!("{pointer}/{index}"), found)),
            _ => found.push(pointer),
        }
    }
    let mut found = Vec::new();
    places(contract, String::new(), &mut found);
    let changed = |pointer: String| {
        let mut changed = contract.clone();
        let value = changed.pointer_mut(&pointer).unwrap();
        *value = match value.take() {
            Value::String(text) => other_word(&text).into(),
            Value::Number(number) if number.is_u64() => (number.as_u64().unwrap() + 1).into(),
            Value::Number(number) => (number.as_f64().unwrap() * 1.25 + 0.125).into(),
            Value::Bool(flag) => (!flag).into(),
            _ => "something".into(),
        };
        (pointer, changed)
    };
    found.into_iter().map(changed).collect()
}

/// Returns another word where only some are known, so that the bundle still opens.
fn other_word(word: &str) -> String {
    match word {
        "argmax" => "sample".to_owned(),
        "sample" => "argmax".to_owned(),
        "restart" => "refuse".to_owned(),
        "refuse" => "restart".to_owned(),
        "wxyz" => "xyzw".to_owned(),
        "none" => "wxyz".to_owned(),
        other => format!("{other}x"),
    }
}

/// Multiplies a tensor by a factor.
pub fn scale(values: &mut [f32], factor: f32) {
    for x in values {
        *x *= factor;
    }
}

/// Stream of normals, the same each time.
pub struct Normals(lads_sim::random::Stream);

impl Normals {
    pub fn new(seed: u64) -> Self {
        Self(lads_sim::random::Stream::new(&[seed]))
    }

    pub fn next(&mut self) -> f32 {
        let [a, b] = [self.0.unit(), self.0.unit()];
        ((-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()) as f32
    }
}

/// Returns the model with relative noise on every weight.
pub fn noisy(model: &Model, relative: f32, seed: u64) -> Model {
    let (mut model, mut normals) = (model.clone(), Normals::new(seed));
    for tensor in model.tensors.clone() {
        model.edit(&tensor.name, |values| {
            for x in values {
                *x *= 1.0 + relative * normals.next();
            }
        });
    }
    model
}

/// Returns the model with its plans under other numbers, throughout.
pub fn renumbered(model: &Model, step: usize) -> Model {
    let mut model = model.clone();
    let codes = model
        .tensors
        .iter()
        .find(|tensor| tensor.name == "codebook")
        .expect("a codebook")
        .rows;
    let order: Vec<_> = (0..codes).map(|plan| (plan + step) % codes).collect();
    for name in ["codebook", "high_level.head.weight", "high_level.head.bias"] {
        model.reorder(name, &order);
    }
    model
}
