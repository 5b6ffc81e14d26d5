//! Proves that an image's channels, states, entries and calls make a policy that can be run blindly.
//!
//! Opening an image proves once that
//! - states are stored consecutively, so none overlap, and each is used;
//! - every entry is a sound program whose ports have the length of what they are bound to;
//! - every control step of a context writes the action, selects an index before it is read, reads nothing of the step that was
//!   not written before, appends at most one row to a ring, clears a KV cache at most once, and never fills one beyond its rows:
//!   the schedule is gone through step by step, with the longest instruction;
//! - the image asks for no more rows than that takes, and states the true amount of work of the
//!   worst step.
//!
//! What can fail: [`check`], with the record at fault ([`ScheduleError`]).

mod error;
mod walk;

use lads_image::place::Place;
use lads_image::records::{
    self, EntryRecord, Event, Fill, MAX_ROW_STATES, PortRecord, Repeat, Scope, Source, SourceKind,
    StateKind, StateRecord, When,
};
use lads_image::{Program, Spaces, Tables};

use crate::contract::{Contract, DType, Role, same_text};

pub use error::ScheduleError;

/// Largest number of states of an image: one bit each in a word.
const MAX_STATES: usize = 64;

/// Largest number of control steps of a bounded context, and of two periods of an unbounded one.
const MAX_STEPS: u32 = 1 << 14;

/// Largest number of entries and of calls of an image, and of ports on a side of an entry: walking
/// a context takes time in proportion.
const MAX_RECORDS: usize = 64;

/// Cost of a run of each entry, in multiply-adds; one more for every op.
type Work = [u64; MAX_RECORDS];

/// Largest number of runs of one call.
const MAX_REPEAT: u32 = 1 << 16;

/// Memory and work that a policy needs, computed while it is checked. Lengths count elements.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Sizes {
    /// Arena of the largest entry.
    pub arena_len: usize,
    /// Rings and KV caches together.
    pub rows_len: usize,
    /// Plain states that last longer than a step.
    pub bank_len: usize,
    /// Plain states that last one step.
    pub scratch_len: usize,
    /// Number of elements of noise of the step that draws most.
    pub noise_len: usize,
    /// Period of an unbounded context; 1 for others.
    pub period: u32,
    /// The scores that an index is selected from, if one is.
    pub scores: Option<StateRecord>,
    /// True if an action can be computed from an index alone.
    pub follows: bool,
    /// True if demonstrations can be encoded.
    pub encodes: bool,
    /// Work of the worst step or call of another event, in multiply-adds.
    pub work: u64,
}

type Checked<T = ()> = Result<T, ScheduleError>;

/// Checks everything and returns the sizes that the policy needs.
pub(crate) fn check(tables: &Tables, contract: &Contract) -> Checked<Sizes> {
    let mut sizes = Sizes {
        period: 1,
        ..Sizes::default()
    };
    few(tables)?;
    states(tables, &mut sizes)?;
    let work = entries(tables, contract, &mut sizes)?;
    calls(tables, contract, &mut sizes)?;
    walk::go_through(tables, contract, &work, &mut sizes)?;
    used(tables)?;
    if contract.worst_work() != sizes.work {
        return Err(ScheduleError::Work {
            stated: contract.worst_work(),
            counted: sizes.work,
        });
    }
    Ok(sizes)
}

/// Checks that there are few enough records to go through them at every step of a context.
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

/// Checks that the states are stored in order, without gaps.
#[inline(never)]
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

/// Returns whether a call clears a state.
pub(crate) fn is_cleared(tables: &Tables, state: usize) -> bool {
    tables
        .calls()
        .any(|call| tables.clears(&call).iter().any(|&i| i as usize == state))
}

/// Returns whether an instruction appends to a state.
fn is_instructed(tables: &Tables, state: usize) -> bool {
    tables
        .calls()
        .filter(|call| call.event == Event::Instruct)
        .filter_map(|call| tables.entry(call.entry as usize))
        .any(|entry| entry.cache as usize == state)
}

/// Checks that every entry is a sound program with sound ports, and that every KV cache is as large
/// as its programs use it.
#[inline(never)]
fn entries(tables: &Tables, contract: &Contract, sizes: &mut Sizes) -> Checked<Work> {
    let (mut work, mut used) = ([0; MAX_RECORDS], [0; MAX_ROW_STATES]);
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
        if let Some(work) = work.get_mut(i) {
            let products = program.work().multiply_adds;
            *work = products.saturating_add(u64::from(entry.ops_len));
        }
    }
    for (i, end) in (0_u32..).zip(used) {
        let kv = tables
            .state(i as usize)
            .filter(|state| state.kind == StateKind::Kv);
        if kv.is_some_and(|state| u64::from(state.width) != end) {
            return Err(ScheduleError::State { state: i });
        }
    }
    Ok(work)
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

/// Returns whether a port is bound to the right kind of thing and has its length.
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

/// Checks that every call names existing records and does only what its event allows.
#[inline(never)]
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

/// Returns whether an event's calls may read a channel of a role.
fn event_reads(event: Event, role: Role) -> bool {
    match event {
        Event::Instruct => role == Role::Instruction,
        Event::Step => matches!(role, Role::Observation | Role::Action | Role::Noise),
        Event::Follow => role == Role::Observation,
        Event::Encode => role == Role::Demonstration,
    }
}

/// Checks that every state is bound to a port of an entry, or is the cache of one.
#[inline(never)]
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
