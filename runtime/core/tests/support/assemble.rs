//! Puts the programs of a [`Model`], which the tests of lads-image assemble by hand, into the parts of an image, with the schedule of
//! LADS around them.

use lads_image::place::Place;
use lads_image::records::{self, DType, Event, Role, Scope, Source, SourceKind};

use super::draft::bound;
use super::model::Model;
use super::programs::{self, Kind};
use super::writer::{Call, Entry, Parts};

/// Numbers of the image's entries.
pub const INSTRUCT: usize = 0;
pub const START: usize = 1;
pub const DECIDE: usize = 2;
pub const RECORD: usize = 3;
pub const LOOKUP: usize = 4;
pub const ACT: usize = 5;
pub const ENCODE: usize = 6;

/// Numbers of the image's states.
pub const CONTEXT: u32 = 0;
pub const LOGITS: u32 = 1;
pub const PLAN: u32 = 2;

/// Numbers of the image's channels.
pub const OBSERVATION: u32 = 0;
pub const WORDS: u32 = 1;
pub const OBSERVATIONS: u32 = 2;
pub const ACTIONS: u32 = 3;
pub const ACTION: u32 = 4;

/// Entries in their order, with their programs.
const ENTRIES: [(&str, Kind); 7] = [
    ("high_level/instruct", Kind::Instruct),
    ("high_level/start", Kind::Start),
    ("high_level/step", Kind::StepDecide),
    ("high_level/record", Kind::StepRecord),
    ("codebook/lookup", Kind::Lookup),
    ("low_level/act", Kind::Act),
    ("trajectory_encoder/encode", Kind::Encode),
];

/// Returns the parts of an image of a model.
pub fn parts(model: &Model) -> Parts {
    let spec = model.spec;
    let assembled = programs::assemble(model);
    let mut parts = Parts::new("lads");
    // First, because the programs say where their weights lie.
    parts.weights(&assembled.weights);
    let [o, a] = [spec.observation_len as u32, spec.action_len as u32];
    let h = spec.horizon as u32;
    let words = [spec.words_len as u32, spec.word_dim as u32];
    for (name, role, shape, most) in [
        ("observation", Role::Observation, &[o][..], 3.0),
        ("words", Role::Instruction, &words, 9.0),
        ("observations", Role::Demonstration, &[h, o], 3.0),
        ("actions", Role::Demonstration, &[h, a], 1.0),
        ("action", Role::Action, &[a], 1.0),
    ] {
        parts.channel(name, role, DType::F32, shape, [-most, most]);
    }
    parts.contract.context_steps = spec.steps as u32;
    for words in &model.instructions {
        parts.instruction(spec.word_dim, words);
    }
    parts.kv("context", assembled.cache_len, assembled.rows);
    parts.plain("logits", Scope::Episode, spec.codebook_len as u32);
    parts.plain("plan", Scope::Episode, spec.plan_len as u32);
    for (name, kind) in ENTRIES {
        let draft = assembled.draft(kind);
        let ports = |ports: &[(&str, Place)]| {
            let bind = |&(name, place): &(&str, Place)| source(name).map(|source| (source, place));
            ports.iter().filter_map(bind).collect()
        };
        parts.entry(Entry {
            name: name.into(),
            ops: draft.ops.clone(),
            arena_len: draft.arena_len,
            cache: if draft.tokens > 0 {
                CONTEXT
            } else {
                records::NONE
            },
            tokens: draft.tokens,
            inputs: ports(&draft.inputs),
            outputs: ports(&draft.outputs),
        });
    }
    schedule(&mut parts, h);
    parts.sealed()
}

/// Returns the source that a port of the programs is bound to; `None` for the encoder's latent,
/// which no image keeps.
fn source(port: &str) -> Option<Source> {
    let (kind, of) = match port {
        "observation" => (SourceKind::Channel, OBSERVATION),
        "words" => (SourceKind::Channel, WORDS),
        "observations" => (SourceKind::Channel, OBSERVATIONS),
        "actions" => (SourceKind::Channel, ACTIONS),
        "action" => (SourceKind::Channel, ACTION),
        "logits" => (SourceKind::State, LOGITS),
        "plan" => (SourceKind::State, PLAN),
        "timestep" => (SourceKind::Timestep, 0),
        "plan_index" => (SourceKind::Selected, 0),
        "latent" => return None,
        _ => panic!("no program has a port {port}"),
    };
    Some(bound(kind, of))
}

fn schedule(parts: &mut Parts, h: u32) {
    let entry = |entry: usize| entry as u32;
    parts.calls = vec![
        Call::on(Event::Instruct, entry(INSTRUCT)),
        Call::step(entry(START)).first().select(LOGITS),
        Call::step(entry(DECIDE))
            .every(h)
            .otherwise()
            .select(LOGITS),
        Call::step(entry(RECORD)).otherwise(),
        Call::step(entry(LOOKUP)).every(h),
        Call::step(entry(ACT)),
        Call::on(Event::Follow, entry(LOOKUP)),
        Call::on(Event::Follow, entry(ACT)),
        Call::on(Event::Encode, entry(ENCODE)),
    ];
}
