//! `lads inspect`: prints a policy's channels, its schedule, and its memory.
//!
//! Everything is read from the compiled image, so a bundle and the image made from it give the same
//! report, except for the file's name. For an ONNX file that is not a policy, everything that it
//! lacks is listed instead ([`foreign`]).

pub mod foreign;
mod json;
mod text;

use std::path::Path;

use lads_core::{Beyond, Controller, DType, Data, Decision, Noise, Policy, QuaternionOrder, Role};
use lads_host::Opened;
use lads_host::schedule::{self, Cost, Place, Steps};
use lads_image::records::{
    EntryRecord, Event, PortRecord, Scope, SourceKind, StateKind, StateRecord,
};
use lads_image::{Tables, records};

use crate::line::{self, Form};
use crate::model::Model;
use crate::refusal::Refusal;

/// Formats the observations of the golden episode as lines of CSV, with the shortest decimal form
/// of each element; all channels, one after the other.
pub fn observations(model: &Model) -> Result<String, Refusal> {
    let golden = model.policy().golden().ok_or_else(|| {
        Refusal::new(
            model.path.display(),
            "it carries no golden episode, so there are no observations to show",
            "export the bundle with one",
        )
    })?;
    let (mut text, mut row, mut numbers) = (String::new(), String::new(), vec![]);
    for step in golden.steps() {
        numbers.clear();
        for (_, data) in step.observations() {
            match data {
                Data::F32(values) => numbers.extend_from_slice(values),
                Data::U8(values) => numbers.extend(values.iter().map(|&value| f32::from(value))),
                Data::I32(values) => numbers.extend(values.iter().map(|&value| value as f32)),
            }
        }
        line::format(Form::Csv, &numbers, None, &mut row);
        text.push_str(&row);
    }
    Ok(text)
}

/// Report on a policy, for people or as JSON.
pub struct Report<'m> {
    path: &'m Path,
    opened: &'m Opened,
    policy: Policy<'m>,
    tables: Tables<'m>,
    places: Vec<Place>,
}

impl<'m> Report<'m> {
    /// Makes the report on a policy that was read from `path`.
    pub fn of(path: &'m Path, opened: &'m Opened) -> Self {
        let policy = opened.policy();
        let tables = match Tables::new(policy.image()) {
            Ok(tables) => tables,
            Err(error) => unreachable!("they were checked when the policy was opened: {error}"),
        };
        Self {
            path,
            opened,
            policy,
            tables,
            places: schedule::places(&policy),
        }
    }

    fn form(&self) -> &'static str {
        if self.opened.is_bundle() {
            "bundle"
        } else {
            "image"
        }
    }

    fn entries(&self) -> impl Iterator<Item = EntryRecord> + '_ {
        (0..self.tables.entries_len()).filter_map(|i| self.tables.entry(i))
    }

    fn cost(&self, entry: &EntryRecord) -> Cost {
        schedule::cost(&self.tables, entry)
    }

    fn states(&self) -> impl Iterator<Item = State<'m>> + '_ {
        (0..self.tables.states_len()).filter_map(|i| {
            let record = self.tables.state(i)?;
            let mut calls = self.tables.calls();
            let cleared = calls.any(|call| self.tables.clears(&call).contains(&(i as u32)));
            Some(State {
                name: self.tables.text(record.name),
                record,
                cleared,
            })
        })
    }

    /// Describes the binding of a port.
    fn source(&self, port: &PortRecord) -> String {
        let of = port.source.of;
        let state = || {
            let state = self.tables.state(of as usize);
            state.map_or("", |state| self.tables.text(state.name))
        };
        match port.source.kind {
            SourceKind::Channel => {
                let channel = self.tables.channel(of as usize);
                let name = channel.map_or("", |channel| self.tables.text(channel.name));
                format!("channel {name}")
            }
            SourceKind::State => format!("state {}", state()),
            SourceKind::Row => format!("row of {}", state()),
            SourceKind::Timestep => "timestep".into(),
            SourceKind::Phase => format!("timestep modulo {of}"),
            SourceKind::Pass => "pass".into(),
            SourceKind::Selected => "selected index".into(),
        }
    }

    /// Returns the name of the KV cache of an entry.
    fn cache(&self, entry: &EntryRecord) -> Option<&'m str> {
        let state = self.tables.state(entry.cache as usize);
        state
            .filter(|_| entry.cache != records::NONE)
            .map(|state| self.tables.text(state.name))
    }

    fn weights_bytes(&self) -> usize {
        size_of_val(self.tables.weights())
    }

    fn controller_bytes() -> usize {
        size_of::<Controller<'_, '_>>()
    }
}

/// A state of the image.
struct State<'m> {
    name: &'m str,
    record: StateRecord,
    /// True if calls clear the state.
    cleared: bool,
}

impl State<'_> {
    fn kind(&self) -> &'static str {
        match self.record.kind {
            StateKind::Plain => "plain",
            StateKind::Ring => "ring",
            StateKind::Kv => "kv",
        }
    }

    /// Returns the lifetime of the state.
    fn scope(&self) -> &'static str {
        match self.record.scope {
            Scope::Instruction => "instruction",
            Scope::Episode => "episode",
            Scope::Step => "step",
        }
    }

    /// Returns the size of the state in a controller's memory, in bytes: a ring has one row to
    /// spare, a cache that calls clear two halves, and a state that lasts longer than a step a
    /// second bank.
    fn bytes(&self) -> u64 {
        let (width, rows) = (u64::from(self.record.width), u64::from(self.record.rows));
        let words = match (self.record.kind, self.record.scope) {
            (StateKind::Plain, Scope::Step) => width,
            (StateKind::Plain, _) => 2 * width,
            (StateKind::Ring, _) => width * (rows + 1),
            (StateKind::Kv, _) if self.cleared => 2 * width,
            (StateKind::Kv, _) => width,
        };
        4 * words
    }
}

fn event(event: Event) -> &'static str {
    match event {
        Event::Instruct => "instruct",
        Event::Step => "step",
        Event::Follow => "follow",
        Event::Encode => "encode",
    }
}

fn steps(steps: Steps) -> String {
    match steps {
        Steps::All => "all".into(),
        Steps::First => "first".into(),
        Steps::Every(every) => format!("every {every}"),
        Steps::Other => "other".into(),
    }
}

fn role(role: Role) -> &'static str {
    match role {
        Role::Observation => "observation",
        Role::Action => "action",
        Role::Instruction => "instruction",
        Role::Noise => "noise",
        Role::Demonstration => "demonstration",
    }
}

fn dtype(dtype: DType) -> &'static str {
    match dtype {
        DType::F32 => "f32",
        DType::U8 => "u8",
        DType::I32 => "i32",
    }
}

fn quaternions(order: QuaternionOrder) -> &'static str {
    match order {
        QuaternionOrder::None => "none",
        QuaternionOrder::Wxyz => "wxyz",
        QuaternionOrder::Xyzw => "xyzw",
    }
}

fn beyond(beyond: Beyond) -> &'static str {
    match beyond {
        Beyond::Restart => "restart",
        Beyond::Refuse => "refuse",
    }
}

fn decision(decision: Decision) -> String {
    match decision {
        Decision::Argmax => "the index of the largest score".into(),
        Decision::Sample { temperature, seed } => {
            format!("an index sampled at temperature {temperature} with seed {seed}")
        }
    }
}

fn noise(noise: Noise) -> String {
    match noise {
        Noise::Zero => "zeros".into(),
        Noise::Seeded { seed } => format!("standard normals with seed {seed}"),
    }
}

fn bytes(len: usize) -> usize {
    len * size_of::<f32>()
}
