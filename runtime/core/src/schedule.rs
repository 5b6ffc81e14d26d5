//! Proves that an image's channels, states, entries and calls make a policy that can be run blindly.
//!
//! What is proven, once, when an image is opened:
//! - states lie one behind the other, so none overlap, and each is used;
//! - every entry is a sound program whose ports have the length of what they are bound to;
//! - every control step of a context writes the action, selects an index before it is read, reads nothing of the step that was
//!   not written before, appends at most one row to a ring, clears a KV cache at most once, and never fills one beyond its rows:
//!   the schedule is gone through step by step, with the longest instruction;
//! - the image asks for no more rows than that takes, and says truly how much the worst step computes.
//!
//! What can fail: [`check`], with the record that is at fault ([`ScheduleError`]).

use core::error::Error;
use core::fmt;

use lads_image::place::Place;
use lads_image::records::{
    self, CallRecord, EntryRecord, Event, Fill, MAX_ROW_STATES, PortRecord, Repeat, Scope, Source,
    SourceKind, StateKind, StateRecord, When,
};
use lads_image::{Chain, Program, ProgramError, Spaces, Tables};

use crate::contract::{Contract, DType, Role, same_text};

/// The most states of an image: one bit each in a word.
const MAX_STATES: usize = 64;

/// The most control steps of a bounded context, and of two periods of an unbounded one.
const MAX_STEPS: u32 = 1 << 14;

/// The most entries and the most calls of an image, and the most ports on a side of an entry: going through a context takes time
/// in proportion.
const MAX_RECORDS: usize = 128;

/// The most runs of one call.
const MAX_REPEAT: u32 = 1 << 16;

/// What a policy needs, found while it is checked. Lengths count elements.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Sizes {
    /// The largest entry's arena.
    pub arena_len: usize,
    /// Rings and KV caches.
    pub rows_len: usize,
    /// Plain states that last longer than a step.
    pub bank_len: usize,
    /// Plain states of a step.
    pub scratch_len: usize,
    /// Noise of the step that draws most.
    pub noise_len: usize,
    /// Period of an unbounded context; 1 for others.
    pub period: u32,
    /// The scores that an index is selected from, if one is.
    pub scores: Option<StateRecord>,
    /// Whether an index alone gives an action.
    pub follows: bool,
    /// Whether demonstrations can be encoded.
    pub encodes: bool,
    /// Of the worst step or call of another event, in multiply-adds.
    pub work: u64,
}

type Checked<T = ()> = Result<T, ScheduleError>;

/// Checks everything and says what the policy needs.
pub(crate) fn check(tables: &Tables, contract: &Contract) -> Checked<Sizes> {
    let mut sizes = Sizes {
        period: 1,
        ..Sizes::default()
    };
    few(tables)?;
    states(tables, &mut sizes)?;
    entries(tables, contract, &mut sizes)?;
    calls(tables, contract, &mut sizes)?;
    go_through(tables, contract, &mut sizes)?;
    used(tables)?;
    if contract.worst_work() != sizes.work {
        return Err(ScheduleError::Work {
            stated: contract.worst_work(),
            counted: sizes.work,
        });
    }
    Ok(sizes)
}

/// There are no more records than can be gone through at every step of a context.
fn few(tables: &Tables) -> Checked {
    let lists = tables.states_len() <= MAX_STATES
        && tables.entries_len() <= MAX_RECORDS
        && tables.calls_len() <= MAX_RECORDS;
    if !lists {
        return Err(ScheduleError::TooMany);
    }
    let ports = |entry: EntryRecord| {
        entry.inputs_len as usize <= MAX_RECORDS && entry.outputs_len as usize <= MAX_RECORDS
    };
    let entries = (0..tables.entries_len())
        .filter_map(|i| tables.entry(i))
        .all(ports);
    let clears = tables
        .calls()
        .all(|call| call.clears_len as usize <= MAX_STATES);
    if entries && clears {
        Ok(())
    } else {
        Err(ScheduleError::TooMany)
    }
}

/// States lie where their order puts them.
fn states(tables: &Tables, sizes: &mut Sizes) -> Checked {
    let count = tables.states_len();
    let (mut rows, mut bank, mut scratch) = (0_u64, 0_u64, 0_u64);
    let mut plain_before = false;
    for i in 0..count {
        let refused = ScheduleError::State { state: i as u32 };
        let state = tables.state(i).ok_or(refused)?;
        let width = u64::from(state.width);
        let twice = (0..i).any(|j| {
            tables
                .state(j)
                .is_some_and(|other| same_text(tables.text(other.name), tables.text(state.name)))
        });
        let (end, words, sound) = match state.kind {
            StateKind::Plain => {
                plain_before = true;
                let end = if state.scope == Scope::Step {
                    &mut scratch
                } else {
                    &mut bank
                };
                (end, width, state.rows == 1 && state.fill == Fill::Zero)
            }
            StateKind::Ring => {
                let physical = u64::from(state.rows).saturating_add(1);
                let sound = state.scope != Scope::Step && !plain_before && i < MAX_ROW_STATES;
                (&mut rows, width.saturating_mul(physical), sound)
            }
            StateKind::Kv => {
                // Half of a cache that calls clear is the next one's, so no row of an instruction would last.
                let cleared = is_cleared(tables, i);
                let halves = if cleared { 2 } else { 1 };
                let sound = state.scope == Scope::Episode
                    && !(cleared && is_instructed(tables, i))
                    && state.fill == Fill::Zero
                    && !plain_before
                    && i < MAX_ROW_STATES;
                (&mut rows, width.saturating_mul(halves), sound)
            }
        };
        let fits = u64::from(state.offset) == *end && state.width > 0 && state.rows > 0;
        if !sound || !fits || twice {
            return Err(refused);
        }
        *end = end.saturating_add(words);
        if *end > u64::from(u32::MAX >> 2) {
            return Err(refused);
        }
    }
    sizes.rows_len = rows as usize;
    sizes.bank_len = bank as usize;
    sizes.scratch_len = scratch as usize;
    Ok(())
}

/// Whether a call clears a state.
pub(crate) fn is_cleared(tables: &Tables, state: usize) -> bool {
    tables
        .calls()
        .any(|call| tables.clears(&call).iter().any(|&i| i as usize == state))
}

/// Whether an instruction appends to a state.
fn is_instructed(tables: &Tables, state: usize) -> bool {
    tables
        .calls()
        .filter(|call| call.event == Event::Instruct)
        .filter_map(|call| tables.entry(call.entry as usize))
        .any(|entry| entry.cache as usize == state)
}

/// Every entry is a sound program with sound ports, and every KV cache is as large as what the programs use of it.
fn entries(tables: &Tables, contract: &Contract, sizes: &mut Sizes) -> Checked {
    let mut used = [0; MAX_ROW_STATES];
    for i in 0..tables.entries_len() {
        let at = i as u32;
        let entry = tables.entry(i).ok_or(ScheduleError::Entry { entry: at })?;
        let cache = match entry.cache {
            records::NONE => None,
            state => Some(
                tables
                    .state(state as usize)
                    .filter(|state| state.kind == StateKind::Kv)
                    .ok_or(ScheduleError::Entry { entry: at })?,
            ),
        };
        let spaces = Spaces {
            weights_len: tables.weights().len(),
            cache_len: cache.map_or(0, |state| state.width as usize),
            rows: cache.map_or(0, |state| state.rows as usize),
        };
        let ports = tables.inputs(&entry).chain(tables.outputs(&entry));
        let program = Program::new_checked(
            tables.ops(&entry),
            entry.arena_len,
            entry.tokens,
            spaces,
            ports.map(|port| port.place),
        )
        .map_err(|error| ScheduleError::Program { entry: at, error })?;
        let appends = entry.tokens > 0;
        if program.is_empty() || appends != cache.is_some() {
            return Err(ScheduleError::Entry { entry: at });
        }
        if let Some(end) = used.get_mut(entry.cache as usize) {
            *end = program.cache_end().max(*end);
        }
        for (side, ports) in [
            (Side::Input, entry.inputs_len),
            (Side::Output, entry.outputs_len),
        ] {
            for index in 0..ports as usize {
                let refused = ScheduleError::Port {
                    entry: at,
                    port: index as u32,
                    output: side == Side::Output,
                };
                let port = side.port(tables, &entry, index).ok_or(refused)?;
                if !port_is_sound(tables, contract, &port, side) {
                    return Err(refused);
                }
            }
        }
        sizes.arena_len = sizes.arena_len.max(program.arena_len());
    }
    for (i, end) in (0_u32..).zip(used) {
        let kv = tables
            .state(i as usize)
            .filter(|state| state.kind == StateKind::Kv);
        if kv.is_some_and(|state| u64::from(state.width) != end) {
            return Err(ScheduleError::State { state: i });
        }
    }
    Ok(())
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Side {
    Input,
    Output,
}

impl Side {
    fn port(self, tables: &Tables, entry: &EntryRecord, index: usize) -> Option<PortRecord> {
        match self {
            Self::Input => tables.inputs(entry).nth(index),
            Self::Output => tables.outputs(entry).nth(index),
        }
    }
}

/// A port lives in the right kind of place and is as long as what it is bound to.
fn port_is_sound(tables: &Tables, contract: &Contract, port: &PortRecord, side: Side) -> bool {
    let Source { kind, of } = port.source;
    let span = match port.place {
        Place::Span(span) => Some(u64::from(span.len)),
        Place::Int(_) => None,
    };
    let state = |kind: StateKind| tables.state(of as usize).filter(|state| state.kind == kind);
    let input = side == Side::Input;
    match kind {
        SourceKind::Channel => {
            let Some(channel) = contract.channel(crate::ChannelId(of)) else {
                return false;
            };
            let role_fits = input || channel.role() == Role::Action;
            let place_fits = match span {
                Some(len) => len == channel.len() as u64,
                None => input && channel.dtype() == DType::I32 && channel.len() == 1,
            };
            role_fits && place_fits
        }
        SourceKind::State => {
            let whole = state(StateKind::Plain).map(|state| u64::from(state.width));
            let ring = state(StateKind::Ring).map(|ring| {
                let rows = if input { ring.rows } else { 1 };
                u64::from(ring.width).saturating_mul(u64::from(rows))
            });
            span.is_some() && span == whole.or(ring)
        }
        SourceKind::Row => {
            let ring = state(StateKind::Ring).map(|ring| u64::from(ring.width));
            input && span.is_some() && span == ring
        }
        SourceKind::Phase => input && span.is_none() && of > 0,
        SourceKind::Timestep | SourceKind::Pass => input && span.is_none() && of == 0,
        SourceKind::Selected => span.is_none() && of == 0,
    }
}

/// Every call names what there is, and does what its event allows.
fn calls(tables: &Tables, contract: &Contract, sizes: &mut Sizes) -> Checked {
    let mut first_of = [true; 4];
    let mut last_event = Event::Instruct;
    let bounded = contract.context_steps().is_some();
    for (i, call) in (0_u32..).zip(tables.calls()) {
        let refused = ScheduleError::Call { call: i };
        let entry = tables.entry(call.entry as usize).ok_or(refused)?;
        let first = first_of.get_mut(call.event as usize).ok_or(refused)?;
        // Calls of an event stand together, so that running one needs no search among the others.
        let ordered = call.event as u32 >= last_event as u32;
        let period = (call.when == When::Every) == (call.every > 0);
        let chained = !(call.otherwise && *first);
        *first = false;
        last_event = call.event;
        let step = call.event == Event::Step;
        let plain = step
            || (call.when == When::Always
                && !call.otherwise
                && call.repeat == Repeat::Times
                && call.count == 1
                && call.select == records::NONE
                && call.clears_len == 0);
        let repeats = match call.repeat {
            Repeat::Times => (1..=MAX_REPEAT).contains(&call.count),
            Repeat::Rows => tables
                .state(call.count as usize)
                .is_some_and(|state| state.kind == StateKind::Ring && state.rows <= MAX_REPEAT),
        };
        let clears = tables.clears(&call).iter().all(|&state| {
            tables
                .state(state as usize)
                .is_some_and(|state| state.scope != Scope::Step)
        });
        if !ordered || !period || !chained || !plain || !repeats || !clears {
            return Err(refused);
        }
        let phases = tables
            .inputs(&entry)
            .filter(|port| port.source.kind == SourceKind::Phase);
        let periods = phases.map(|port| port.source.of);
        let own = (call.when == When::Every).then_some(call.every);
        for period in periods
            .chain(own)
            .filter(|&period| step && !bounded && period > 1)
        {
            // Timesteps without end go back by whole periods.
            if sizes.period > 1 && period != sizes.period {
                return Err(refused);
            }
            sizes.period = period;
        }
        if call.select != records::NONE {
            let state = tables.state(call.select as usize).ok_or(refused)?;
            let same = sizes.scores.is_none_or(|scores| scores == state);
            // Scores are shown until the next selection.
            if state.kind != StateKind::Plain || state.scope == Scope::Step || !same {
                return Err(refused);
            }
            sizes.scores = Some(state);
        }
        sizes.follows |= call.event == Event::Follow;
        sizes.encodes |= call.event == Event::Encode;
        for port in tables.inputs(&entry) {
            let fits = match port.source.kind {
                SourceKind::Channel => contract
                    .channel(crate::ChannelId(port.source.of))
                    .is_some_and(|channel| event_reads(call.event, channel.role())),
                SourceKind::Row => call.repeat == Repeat::Rows && call.count == port.source.of,
                SourceKind::Timestep | SourceKind::Phase | SourceKind::Pass => step,
                SourceKind::Selected => step || call.event == Event::Follow,
                SourceKind::State => true,
            };
            if !fits {
                return Err(refused);
            }
        }
        for port in tables.outputs(&entry) {
            let ring = tables
                .state(port.source.of as usize)
                .is_some_and(|state| state.kind == StateKind::Ring);
            let fits = match port.source.kind {
                SourceKind::Channel => step || call.event == Event::Follow,
                SourceKind::Selected => call.event == Event::Encode,
                SourceKind::State => {
                    !ring || (step && call.repeat == Repeat::Times && call.count == 1)
                }
                _ => false,
            };
            if !fits {
                return Err(refused);
            }
        }
        let aside = matches!(call.event, Event::Follow | Event::Encode);
        if aside && entry.cache != records::NONE {
            return Err(refused);
        }
    }
    if sizes.follows && sizes.scores.is_none() {
        return Err(ScheduleError::NothingSelected);
    }
    Ok(())
}

/// Whether an event's calls may read a channel of a role.
fn event_reads(event: Event, role: Role) -> bool {
    match event {
        Event::Instruct => role == Role::Instruction,
        Event::Step => matches!(role, Role::Observation | Role::Action | Role::Noise),
        Event::Follow => role == Role::Observation,
        Event::Encode => role == Role::Demonstration,
    }
}

/// The schedule on its way through a context.
#[expect(
    clippy::struct_excessive_bools,
    reason = "facts about a step, independent of each other"
)]
struct Walk<'t, 'a> {
    tables: &'t Tables<'a>,
    contract: &'t Contract<'a>,
    bounded: bool,
    /// Valid rows of rings and KV caches.
    rows: [u32; MAX_ROW_STATES],
    /// The most that there were.
    most: [u32; MAX_ROW_STATES],
    selected: bool,
    /// Of one step, one bit per state.
    written: u64,
    cleared: u64,
    appended: u64,
    acts: bool,
    encodes: bool,
    draws: u64,
    work: u64,
}

fn bit(state: u32) -> u64 {
    1_u64.checked_shl(state).unwrap_or(0)
}

impl Walk<'_, '_> {
    fn begin(&mut self) {
        (self.written, self.cleared, self.appended) = (0, 0, 0);
        (self.acts, self.encodes) = (false, false);
        (self.draws, self.work) = (0, 0);
    }

    fn rows(&mut self, state: u32) -> Option<&mut u32> {
        self.rows.get_mut(state as usize)
    }

    fn call(&mut self, at: u32, call: &CallRecord) -> Checked {
        let refused = ScheduleError::Call { call: at };
        for &state in self.tables.clears(call) {
            let twice = self.cleared & bit(state) != 0;
            let kind = self.tables.state(state as usize).map(|state| state.kind);
            if twice && kind == Some(StateKind::Kv) {
                return Err(refused);
            }
            self.cleared |= bit(state);
            if let Some(rows) = self.rows(state) {
                *rows = 0;
            }
        }
        let (least, times, most) = self.runs(call).ok_or(refused)?;
        let entry = self.tables.entry(call.entry as usize).ok_or(refused)?;
        self.reads(&entry, times, refused)?;
        if entry.cache != records::NONE {
            self.append(&entry, call.event, times, refused)?;
        }
        let program = Program::trusted(self.tables.ops(&entry), entry.arena_len, entry.tokens, 0);
        let run = program
            .work()
            .multiply_adds
            .saturating_add(u64::from(entry.ops_len));
        self.work = self
            .work
            .saturating_add(run.saturating_mul(u64::from(most)));
        if least > 0 {
            self.writes(&entry, refused)?;
        }
        self.selected |= call.select != records::NONE;
        Ok(())
    }

    /// How often a call runs: at least, at most at this step of a context, at most at any step.
    fn runs(&mut self, call: &CallRecord) -> Option<(u32, u32, u32)> {
        if call.repeat == Repeat::Times {
            return Some((call.count, call.count, call.count));
        }
        let ring = self.tables.state(call.count as usize)?;
        let rows = *self.rows(call.count)?;
        // One that outlives the context, or knows no end of it, may be full already.
        let known = self.bounded && ring.scope == Scope::Episode;
        Some((rows, if known { rows } else { ring.rows }, ring.rows))
    }

    /// What an entry reads is there.
    fn reads(&mut self, entry: &EntryRecord, times: u32, refused: ScheduleError) -> Checked {
        for PortRecord { source, .. } in self.tables.inputs(entry) {
            match source.kind {
                SourceKind::Selected if !self.selected => {
                    return Err(ScheduleError::NothingSelected);
                }
                SourceKind::State => {
                    let state = self.tables.state(source.of as usize).ok_or(refused)?;
                    if state.scope == Scope::Step && self.written & bit(source.of) == 0 {
                        return Err(refused);
                    }
                }
                SourceKind::Channel => {
                    let channel = self.contract.channel(crate::ChannelId(source.of));
                    let noise = channel.filter(|channel| channel.role() == Role::Noise);
                    let len = noise.map_or(0, |channel| channel.len() as u64);
                    self.draws = self
                        .draws
                        .saturating_add(len.saturating_mul(u64::from(times)));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// The KV cache has room for all runs.
    fn append(
        &mut self,
        entry: &EntryRecord,
        event: Event,
        times: u32,
        refused: ScheduleError,
    ) -> Checked {
        let state = self.tables.state(entry.cache as usize).ok_or(refused)?;
        let again = self.appended & bit(entry.cache) != 0;
        if event == Event::Instruct {
            // How many of its rows count is known once an instruction is set: nothing may stand behind them.
            let words = self.contract.words_len() as u32;
            if again || entry.tokens != words {
                return Err(refused);
            }
        }
        self.appended |= bit(entry.cache);
        let added = u64::from(entry.tokens).saturating_mul(u64::from(times));
        let rows = self.rows(entry.cache).ok_or(refused)?;
        let end = added.saturating_add(u64::from(*rows));
        if end > u64::from(state.rows) {
            return Err(ScheduleError::Rows {
                state: entry.cache,
                stated: state.rows,
                needed: end.min(u64::from(u32::MAX)) as u32,
            });
        }
        *rows = end as u32;
        if let Some(most) = self.most.get_mut(entry.cache as usize) {
            *most = (*most).max(end as u32);
        }
        Ok(())
    }

    fn writes(&mut self, entry: &EntryRecord, refused: ScheduleError) -> Checked {
        for PortRecord { source, .. } in self.tables.outputs(entry) {
            match source.kind {
                SourceKind::Channel => self.acts = true,
                SourceKind::Selected => self.encodes = true,
                SourceKind::State => {
                    let state = self.tables.state(source.of as usize).ok_or(refused)?;
                    let again = self.appended & bit(source.of) != 0;
                    if state.kind == StateKind::Ring {
                        if again {
                            return Err(refused);
                        }
                        self.appended |= bit(source.of);
                        let rows = self.rows(source.of).ok_or(refused)?;
                        *rows = rows.saturating_add(1).min(state.rows);
                    }
                    self.written |= bit(source.of);
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// The calls of one event, at a timestep.
    fn event(&mut self, event: Event, timestep: u32) -> Checked {
        self.begin();
        let mut chain = Chain::default();
        let tables = self.tables;
        for (at, call) in (0_u32..).zip(tables.calls()) {
            if call.event == event && chain.runs(&call, timestep) {
                self.call(at, &call)?;
            }
        }
        Ok(())
    }
}

/// Goes through every kind of event, and through every step of a context.
fn go_through(tables: &Tables, contract: &Contract, sizes: &mut Sizes) -> Checked {
    let bounded = contract.context_steps().is_some();
    let steps = match contract.context_steps() {
        Some(steps) => steps as u64,
        None => u64::from(sizes.period).saturating_mul(2),
    };
    if steps > u64::from(MAX_STEPS) {
        return Err(ScheduleError::TooMany);
    }
    let mut walk = Walk {
        tables,
        contract,
        bounded,
        rows: [0; MAX_ROW_STATES],
        most: [0; MAX_ROW_STATES],
        selected: false,
        written: 0,
        cleared: 0,
        appended: 0,
        acts: false,
        encodes: false,
        draws: 0,
        work: 0,
    };
    walk.event(Event::Instruct, 0)?;
    sizes.work = sizes.work.max(walk.work);
    let mut halfway = walk.rows;
    for timestep in 0..steps as u32 {
        walk.event(Event::Step, timestep)?;
        if !walk.acts {
            return Err(ScheduleError::NoAction { timestep });
        }
        sizes.work = sizes.work.max(walk.work);
        sizes.noise_len = sizes
            .noise_len
            .max(usize::try_from(walk.draws).unwrap_or(usize::MAX));
        if timestep.saturating_add(1) == sizes.period {
            halfway = walk.rows;
        }
    }
    let count = tables.states_len().min(MAX_ROW_STATES);
    for (i, ((&end, half), &most)) in (0_u32..)
        .zip(walk.rows.iter().zip(halfway).zip(&walk.most))
        .take(count)
    {
        let Some(state) = tables.state(i as usize) else {
            continue;
        };
        let kv = state.kind == StateKind::Kv;
        // A cache that grows from one period to the next would grow for ever; one with rows to spare asks for too much.
        if kv && ((!bounded && end != half) || most != state.rows) {
            return Err(ScheduleError::Rows {
                state: i,
                stated: state.rows,
                needed: most,
            });
        }
    }
    if sizes.follows {
        walk.selected = true;
        walk.event(Event::Follow, 0)?;
        sizes.work = sizes.work.max(walk.work);
        if !walk.acts {
            return Err(ScheduleError::NoAction { timestep: 0 });
        }
    }
    if sizes.encodes {
        walk.event(Event::Encode, 0)?;
        sizes.work = sizes.work.max(walk.work);
        if !walk.encodes {
            return Err(ScheduleError::NothingSelected);
        }
    }
    Ok(())
}

/// Every state is bound to a port of an entry, or is the cache of one.
fn used(tables: &Tables) -> Checked {
    for i in 0..tables.states_len() as u32 {
        let mut entries = (0..tables.entries_len()).filter_map(|entry| tables.entry(entry));
        let found = entries.any(|entry| {
            entry.cache == i
                || tables
                    .inputs(&entry)
                    .chain(tables.outputs(&entry))
                    .any(|port| {
                        let of_state =
                            matches!(port.source.kind, SourceKind::State | SourceKind::Row);
                        of_state && port.source.of == i
                    })
        });
        if !found {
            return Err(ScheduleError::State { state: i });
        }
    }
    Ok(())
}

/// Why the parts of an image make no policy. Indices count the image's records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ScheduleError {
    /// More states, or more steps of a context, than an image may have.
    TooMany,
    /// A state is of no use, has a name twice, lies in the wrong place or lasts as its kind cannot.
    State {
        /// Which one.
        state: u32,
    },
    /// An entry has no ops, or a KV cache that is none.
    Entry {
        /// Which one.
        entry: u32,
    },
    /// The program of an entry is not well formed.
    Program {
        /// Which one.
        entry: u32,
        /// What is wrong with it.
        error: ProgramError,
    },
    /// A port is bound to nothing, or is not as long as what it is bound to.
    Port {
        /// Of which entry.
        entry: u32,
        /// Its number among the inputs or outputs.
        port: u32,
        /// Whether it is an output.
        output: bool,
    },
    /// A call names what is not there, or does what its event does not allow.
    Call {
        /// Which one.
        call: u32,
    },
    /// An index is read and none has been selected.
    NothingSelected,
    /// A control step writes no action.
    NoAction {
        /// At this timestep.
        timestep: u32,
    },
    /// A KV cache has not the rows that the longest context needs.
    Rows {
        /// Which state.
        state: u32,
        /// Rows that it has.
        stated: u32,
        /// Rows that are needed.
        needed: u32,
    },
    /// The image states another amount of work than its worst step has.
    Work {
        /// Multiply-adds stated.
        stated: u64,
        /// Multiply-adds counted.
        counted: u64,
    },
}

impl fmt::Display for ScheduleError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::TooMany => f.write_str("there are more states or steps than an image may have"),
            Self::State { state } => write!(f, "state {state} makes no sense"),
            Self::Entry { entry } => write!(f, "entry {entry} makes no sense"),
            Self::Program { entry, error } => write!(f, "entry {entry}, {error}"),
            Self::Port {
                entry,
                port,
                output,
            } => {
                let side = if *output { "output" } else { "input" };
                write!(
                    f,
                    "entry {entry}, {side} {port} is bound to nothing that fits"
                )
            }
            Self::Call { call } => write!(f, "call {call} of the schedule makes no sense"),
            Self::NothingSelected => f.write_str("an index is read before one is selected"),
            Self::NoAction { timestep } => {
                write!(f, "the step at timestep {timestep} writes no action")
            }
            Self::Rows {
                state,
                stated,
                needed,
            } => write!(
                f,
                "state {state} has {stated} rows, the longest context needs {needed}"
            ),
            Self::Work { stated, counted } => write!(
                f,
                "{stated} multiply-adds are stated for the worst step, it has {counted}"
            ),
        }
    }
}

impl Error for ScheduleError {}
