//! Structure of a policy before shapes are known: states, entries and calls by their names.

use lads_image::records::{Event, Fill, Scope, When};

use crate::contract::{Contract, Network, Role};

/// States, entries and calls of a policy.
#[derive(Debug, Clone, Default)]
pub(crate) struct Blueprint {
    pub states: Vec<State>,
    pub entries: Vec<Entry>,
    pub calls: Vec<Call>,
    /// Number of control steps of a phase, if an entry reads one.
    pub period: usize,
}

/// Way in which a state is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Keep {
    Plain,
    Ring { rows: usize, fill: Fill },
    Kv(Network),
}

impl Blueprint {
    /// Returns the events that make an entry run.
    pub fn events_of(&self, entry: &str) -> impl Iterator<Item = Event> {
        let calls = self.calls.iter().filter(move |call| call.entry == entry);
        calls.map(|call| call.event)
    }
}

/// State whose width follows from the values that are bound to it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct State {
    pub name: String,
    pub keep: Keep,
    pub scope: Scope,
    /// Number of elements of the state or of its row, and the field of the contract that states it.
    pub width: Option<(usize, String)>,
}

/// Source that a program is compiled from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Origin {
    /// Graph of the bundle.
    Graph(String),
    /// A copy of a channel, to be appended to a ring.
    Copy { channel: String },
}

/// One program of the policy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Entry {
    pub name: String,
    pub origin: Origin,
    /// Outputs of the graph that are kept, besides the cache.
    pub outputs: Vec<String>,
    /// Name of the KV cache that the entry appends to.
    pub cache: Option<String>,
    /// True if the action depends on the entry's weights.
    pub acts: bool,
    /// True if a bundle may leave the entry's graph out.
    pub optional: bool,
}

impl Entry {
    /// Makes an entry under its graph's name.
    pub fn new(graph: &str, outputs: &[&str]) -> Self {
        Self::variant(graph, graph, outputs)
    }

    /// Makes an entry that keeps only some outputs of its graph.
    pub fn variant(name: &str, graph: &str, outputs: &[&str]) -> Self {
        Self {
            name: name.into(),
            origin: Origin::Graph(graph.into()),
            outputs: outputs.iter().map(|&output| output.into()).collect(),
            cache: None,
            acts: false,
            optional: false,
        }
    }

    pub fn cache(mut self, state: &str) -> Self {
        self.cache = Some(state.into());
        self
    }

    pub fn acts(mut self) -> Self {
        self.acts = true;
        self
    }

    pub fn optional(mut self) -> Self {
        self.optional = true;
        self
    }

    /// Returns the graph that the entry is compiled from, if it is compiled from one.
    pub fn graph(&self) -> Option<&str> {
        match &self.origin {
            Origin::Graph(graph) => Some(graph),
            Origin::Copy { .. } => None,
        }
    }
}

/// Number of times that a call runs its entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Times {
    Times(usize),
    /// One run for each valid row of the named ring.
    Rows(String),
}

/// One line of the schedule.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Call {
    pub event: Event,
    pub entry: String,
    pub when: When,
    pub every: usize,
    pub otherwise: bool,
    pub times: Times,
    pub select: Option<String>,
    pub clears: Vec<String>,
}

impl Call {
    /// Makes a call that runs at every occurrence of an event.
    pub fn on(event: Event, entry: &str) -> Self {
        Self {
            event,
            entry: entry.into(),
            when: When::Always,
            every: 0,
            otherwise: false,
            times: Times::Times(1),
            select: None,
            clears: vec![],
        }
    }

    /// Makes a call that runs in every control step.
    pub fn step(entry: &str) -> Self {
        Self::on(Event::Step, entry)
    }

    /// Restricts the call to the first step of a context.
    pub fn first(mut self) -> Self {
        self.when = When::First;
        self
    }

    /// Restricts the call to multiples of a period.
    pub fn every(mut self, period: usize) -> Self {
        (self.when, self.every) = (When::Every, period);
        self
    }

    /// Restricts the call to steps in which no earlier call of its chain has run.
    pub fn otherwise(mut self) -> Self {
        self.otherwise = true;
        self
    }

    pub fn times(mut self, count: usize) -> Self {
        self.times = Times::Times(count);
        self
    }

    pub fn rows(mut self, ring: &str) -> Self {
        self.times = Times::Rows(ring.into());
        self
    }

    pub fn select(mut self, scores: &str) -> Self {
        self.select = Some(scores.into());
        self
    }

    pub fn clears(mut self, state: &str) -> Self {
        self.clears.push(state.into());
        self
    }
}

/// Binding of a graph's input or output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Bound {
    /// Index into the contract's channels.
    Channel(usize),
    /// Index into the blueprint's states.
    State(usize),
    /// A row of the ring with this index.
    Row(usize),
    Timestep,
    Phase,
    Pass,
    Selected,
    /// Keys or values of a layer.
    Cache,
}

/// Names with the same meaning in every graph; no observation or state may have one of them.
pub const RESERVED: [&str; 6] = [
    "action",
    "previous_action",
    "timestep",
    "phase",
    "pass",
    "index",
];

impl Blueprint {
    /// Begins with an encoder of the observations, such as camera frames, which runs first at each of
    /// the events and hands its features to the other entries; without `features` there is none.
    pub fn observed(features: Option<usize>, events: &[Event]) -> Self {
        let (encoder, handed) = ("observation_encoder/encode", "features");
        let Some(width) = features else {
            return Self::default();
        };
        let begun = Self::default()
            .handed(handed)
            .wide(width, "family.features")
            .entry(Entry::new(encoder, &[handed]).acts());
        let calls = events.iter().map(|&event| Call::on(event, encoder));
        calls.fold(begun, Self::call)
    }

    pub fn state(mut self, name: &str, keep: Keep, scope: Scope) -> Self {
        self.states.push(State {
            name: name.into(),
            keep,
            scope,
            width: None,
        });
        self
    }

    /// Sets the width of the last state, and the field of the contract that states it.
    pub fn wide(mut self, width: usize, field: &str) -> Self {
        if let Some(state) = self.states.last_mut() {
            state.width = Some((width, field.into()));
        }
        self
    }

    /// Adds a KV cache.
    pub fn kv(self, name: &str, network: Option<Network>) -> Self {
        // Contracts without one were refused.
        let network = network.unwrap_or(Network {
            layers: 0,
            heads: 0,
            head_dim: 0,
        });
        self.state(name, Keep::Kv(network), Scope::Episode)
    }

    /// Adds a state that is replaced as a whole and lasts an episode.
    pub fn plain(self, name: &str) -> Self {
        self.state(name, Keep::Plain, Scope::Episode)
    }

    /// Adds a value that one entry hands to another within a step.
    pub fn handed(self, name: &str) -> Self {
        self.state(name, Keep::Plain, Scope::Step)
    }

    pub fn entry(mut self, entry: Entry) -> Self {
        self.entries.push(entry);
        self
    }

    pub fn call(mut self, call: Call) -> Self {
        self.calls.push(call);
        self
    }

    /// Returns the binding of a value of an entry's graph, by its name; `None` for an unknown name.
    pub fn bind(&self, contract: &Contract, entry: &str, name: &str, input: bool) -> Option<Bound> {
        let channel = |found: &dyn Fn(&crate::contract::Channel) -> bool| {
            contract.channels.iter().position(found).map(Bound::Channel)
        };
        let state = |name: &str| self.states.iter().position(|state| state.name == name);
        if name.starts_with("past_key_values.") || name.starts_with("present.") {
            return Some(Bound::Cache);
        }
        if matches!(name, "action") || (input && name == "previous_action") {
            return channel(&|channel| channel.role == Role::Action);
        }
        if input {
            let int = match name {
                "timestep" => Some(Bound::Timestep),
                "phase" => Some(Bound::Phase),
                "pass" => Some(Bound::Pass),
                "index" => Some(Bound::Selected),
                _ => None,
            };
            if int.is_some() {
                return int;
            }
            if let Some(found) = channel(&|channel| channel.name == name) {
                return Some(found);
            }
            let ring = state(name)?;
            let row = self
                .calls
                .iter()
                .any(|call| call.entry == entry && call.times == Times::Rows(name.into()));
            return Some(if row {
                Bound::Row(ring)
            } else {
                Bound::State(ring)
            });
        }
        if name == "index" {
            return Some(Bound::Selected);
        }
        channel(&|channel| channel.role == Role::Action && channel.name == name).or_else(|| {
            state(name.strip_prefix("next_").unwrap_or(name))
                .or_else(|| state(name))
                .map(Bound::State)
        })
    }

    /// Returns the number of rows that each KV cache needs, in the order of the states, by walking
    /// the schedule step by step with the longest instruction. `tokens` returns the number of rows
    /// that a run of an entry appends.
    pub fn rows(&self, contract: &Contract, tokens: impl Fn(&Entry) -> usize) -> Vec<usize> {
        let (mut now, mut most) = (vec![0; self.states.len()], vec![0; self.states.len()]);
        let index = |name: &str| self.states.iter().position(|state| state.name == name);
        self.walk(contract, |call, entry, _| {
            for state in call.clears.iter().filter_map(|name| index(name)) {
                now[state] = 0;
            }
            let times = match &call.times {
                Times::Times(times) => *times,
                Times::Rows(ring) => index(ring).map_or(0, |ring| now[ring]),
            };
            if let Some(cache) = entry.cache.as_deref().and_then(index) {
                now[cache] += times * tokens(entry);
                most[cache] = most[cache].max(now[cache]);
            }
            for output in &entry.outputs {
                let name = output.strip_prefix("next_").unwrap_or(output);
                if let Some(state) = index(name)
                    && let Keep::Ring { rows, .. } = self.states[state].keep
                {
                    now[state] = (now[state] + 1).min(rows);
                }
            }
        });
        most
    }

    /// Returns the entries with a cache that never run, such as later steps under plans of one: they have no rows there.
    pub fn idle(&self, contract: &Contract) -> Vec<String> {
        let cached = self.entries.iter().filter(|entry| entry.cache.is_some());
        let mut idle: Vec<String> = cached.map(|entry| entry.name.clone()).collect();
        self.walk(contract, |_, entry, _| {
            idle.retain(|name| *name != entry.name);
        });
        idle
    }

    /// Walks an instruction and all control steps of a context, or one period without a context,
    /// and reports each call that runs, with its entry and the timestep.
    pub fn walk(&self, contract: &Contract, mut see: impl FnMut(&Call, &Entry, usize)) {
        let mut run = |event: Event, timestep: usize| {
            let mut taken = false;
            for call in self.calls.iter().filter(|call| call.event == event) {
                let due = match call.when {
                    When::Always => true,
                    When::First => timestep == 0,
                    When::Every => timestep.is_multiple_of(call.every.max(1)),
                };
                let runs = due && !(call.otherwise && taken);
                taken = runs || (call.otherwise && taken);
                let found = self.entries.iter().find(|entry| entry.name == call.entry);
                if let (Some(entry), true) = (found, runs) {
                    see(call, entry, timestep);
                }
            }
        };
        run(Event::Instruct, 0);
        let steps = contract
            .context
            .map_or(self.period.max(1), |context| context.steps);
        for timestep in 0..steps {
            run(Event::Step, timestep);
        }
    }
}
