//! What a program image says of itself beside what the bundle says that it was compiled from: everything of a contract that an image holds.
//!
//! Both are made alike, so that a field that only one of them has shows. What can fail: a bundle whose table of instructions cannot be evaluated.

use lads_compiler::{Bundle, CompileError};
use lads_core::{Contract, Decision, Noise, Policy};
use serde::Serialize;
use serde_json::Value;

/// The fields.
#[derive(Serialize)]
struct Said<'a> {
    bundle_sha256: &'a str,
    family: &'a str,
    environment: [&'a str; 2],
    control_period_s: f32,
    decision: Value,
    noise: Value,
    channels: Vec<Channel<'a>>,
    context: Option<Context>,
    language: [&'a str; 2],
    /// `None` where no other sentence is followed.
    acceptance: Option<f32>,
    instructions: Vec<Instruction<'a>>,
}

#[derive(Serialize)]
struct Channel<'a> {
    name: &'a str,
    role: String,
    dtype: String,
    shape: Vec<usize>,
    quaternion_order: String,
    reference: &'a str,
    /// Of all its elements alike, where they are not described one by one.
    limits: Option<[f32; 2]>,
    elements: Vec<Element<'a>>,
}

#[derive(Serialize)]
struct Element<'a> {
    name: &'a str,
    unit: &'a str,
    min: f32,
    max: f32,
    joint: &'a str,
    interface: &'a str,
    scale: f32,
    offset: f32,
    physical_unit: &'a str,
}

#[derive(Serialize)]
struct Context {
    words: usize,
    steps: usize,
    beyond: String,
}

#[derive(Serialize)]
struct Instruction<'a> {
    id: &'a str,
    text: &'a str,
    /// Elements of its word embeddings.
    words: usize,
    /// Of their bits.
    words_sha256: String,
}

impl<'a> Instruction<'a> {
    fn new(id: &'a str, text: &'a str, words: &[f32]) -> Self {
        let bytes: Vec<u8> = words.iter().flat_map(|x| x.to_le_bytes()).collect();
        Self {
            id,
            text,
            words: words.len(),
            words_sha256: lads_compiler::sha256(&bytes),
        }
    }
}

/// The name of a value that both sides call alike.
fn name(value: impl std::fmt::Debug) -> String {
    format!("{value:?}").to_lowercase()
}

fn decision(decision: Decision) -> Value {
    match decision {
        Decision::Argmax => serde_json::json!({"rule": "argmax"}),
        Decision::Sample { temperature, seed } => {
            serde_json::json!({"rule": "sample", "temperature": temperature, "seed": seed})
        }
    }
}

fn noise(noise: Noise) -> Value {
    match noise {
        Noise::Zero => serde_json::json!({"rule": "zero"}),
        Noise::Seeded { seed } => serde_json::json!({"rule": "seeded", "seed": seed}),
    }
}

impl Said<'_> {
    fn json(&self) -> Value {
        serde_json::to_value(self).expect("texts and finite numbers are JSON")
    }
}

/// What an image says.
pub fn of_image(policy: &Policy<'_>) -> Value {
    let contract = policy.contract();
    let channels: Vec<_> = contract.channels().collect();
    let said = Said {
        bundle_sha256: contract.bundle_sha256(),
        family: contract.family(),
        environment: [contract.environment_id(), contract.environment_version()],
        control_period_s: contract.control_period_s(),
        decision: decision(contract.decision()),
        noise: noise(contract.noise()),
        channels: channels.iter().map(image_channel).collect(),
        context: contract.context_steps().map(|steps| Context {
            words: contract.words_len(),
            steps,
            beyond: name(contract.beyond()),
        }),
        language: [contract.encoder(), contract.encoder_sha256()],
        acceptance: Some(contract.acceptance()).filter(|&least| least <= 1.0),
        instructions: contract
            .instructions()
            .map(|known| Instruction::new(known.id, known.text, known.words))
            .collect(),
    };
    said.json()
}

fn image_channel<'a>(channel: &lads_core::Channel<'a>) -> Channel<'a> {
    let elements: Vec<_> = channel
        .elements()
        .map(|element| Element {
            name: element.name,
            unit: element.unit,
            min: element.limits.min,
            max: element.limits.max,
            joint: element.joint,
            interface: element.interface,
            scale: element.scale,
            offset: element.offset,
            physical_unit: element.physical_unit,
        })
        .collect();
    let alike = channel.limits().next().filter(|_| elements.is_empty());
    Channel {
        name: channel.name(),
        role: name(channel.role()),
        dtype: name(channel.dtype()),
        shape: channel.shape().iter().map(|&dim| dim as usize).collect(),
        quaternion_order: name(channel.quaternion_order()),
        reference: channel.reference(),
        limits: alike.map(|limits| [limits.min, limits.max]),
        elements,
    }
}

/// What an image of the bundle has to say.
pub fn of_bundle(bundle: &Bundle) -> Result<Value, CompileError> {
    let contract = bundle.contract();
    let language = contract.language.as_ref();
    let words = lads_compiler::words(bundle)?;
    let said = Said {
        bundle_sha256: bundle.sha256(),
        family: contract.family.name(),
        environment: [&contract.environment.id, &contract.environment.version],
        control_period_s: contract.control_period_s,
        decision: decision(contract.decision()),
        noise: noise(contract.noise()),
        channels: contract.channels.iter().map(bundle_channel).collect(),
        context: contract.context.map(|context| Context {
            words: context.words,
            steps: context.steps,
            beyond: name(context.beyond),
        }),
        language: language.map_or(["", ""], |known| [&known.encoder, &known.sha256]),
        acceptance: language
            .and_then(|known| known.acceptance)
            .map(|acceptance| acceptance.threshold),
        instructions: contract
            .instructions
            .iter()
            .zip(&words)
            .map(|(known, words)| Instruction::new(&known.id, &known.text, words))
            .collect(),
    };
    Ok(said.json())
}

fn bundle_channel(channel: &lads_compiler::contract::Channel) -> Channel<'_> {
    let (min, max) = channel.limits();
    Channel {
        name: &channel.name,
        role: name(channel.role),
        dtype: name(channel.dtype),
        shape: channel.shape.clone(),
        quaternion_order: name(channel.quaternion_order),
        reference: &channel.reference,
        limits: channel.elements.is_empty().then_some([min, max]),
        elements: channel
            .elements
            .iter()
            .map(|element| Element {
                name: &element.name,
                unit: &element.unit,
                min: element.min,
                max: element.max,
                joint: element.joint.as_deref().unwrap_or_default(),
                interface: element.interface.as_deref().unwrap_or_default(),
                scale: element.scale,
                offset: element.offset,
                physical_unit: element.physical_unit.as_deref().unwrap_or_default(),
            })
            .collect(),
    }
}

/// The rule that decides plans, in a word or two.
pub fn rule(contract: &Contract<'_>) -> String {
    match contract.decision() {
        Decision::Argmax => "argmax".to_owned(),
        Decision::Sample { temperature, .. } => format!("sampling at temperature {temperature}"),
    }
}
