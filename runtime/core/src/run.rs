//! Runs the calls of an event: fills the inputs of each entry from their sources, runs its program,
//! and stores its outputs.
//!
//! Invariants: the state in force is not written. Plain states and the action go to the next bank,
//! rows are written after the valid ones (a ring has one row to spare, a KV cache that calls clear
//! has a second half), and counters change in a copy; the controller takes all of it over at the
//! end, or drops it. Values that leave a program are finite ([`RunError::NotFinite`] otherwise);
//! the rows that a program appends to a KV cache are not checked.

use lads_image::place::{INT_SLOTS, Place, Span};
use lads_image::records::{
    self, CallRecord, EntryRecord, Event, Fill, MAX_ROW_STATES, PortRecord, Repeat, Scope, Source,
    SourceKind, StateKind, StateRecord,
};
use lads_image::{ExecError, Machine, Program, Tables};
use lads_kernels::assign;

use crate::contract::ChannelId;
use crate::errors::RunError;
use crate::inputs::Data;
use crate::normal::Normals;
use crate::policy::Policy;
use crate::workspace::Workspace;

/// Integer slots of a program.
type Ints = [u32; INT_SLOTS];

/// Valid rows of a ring or a KV cache, and their start.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Rows {
    /// Number of valid rows.
    pub len: u32,
    /// Start of the valid rows: for a ring, the row of its memory that holds the oldest; for a KV
    /// cache with two halves, the half in force.
    pub start: u32,
}

impl Rows {
    /// Returns a ring without valid rows: new rows go after those that were valid, which are kept.
    pub fn emptied(self, ring: &StateRecord) -> Self {
        Self {
            len: 0,
            start: wrapped(ring, self.start, self.len),
        }
    }
}

/// The counters that a step advances.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Counters {
    /// Number of control steps since the context began.
    pub timestep: u32,
    /// Selected index in force.
    pub selected: u32,
    /// Largest score of the last selection minus the second largest.
    pub margin: f32,
    pub rows: [Rows; MAX_ROW_STATES],
}

impl Counters {
    /// Counters of a new context, with nothing selected.
    pub const START: Self = Self {
        timestep: 0,
        selected: 0,
        margin: 0.0,
        rows: [Rows { len: 0, start: 0 }; MAX_ROW_STATES],
    };

    pub fn rows(&self, state: u32) -> Rows {
        self.rows.get(state as usize).copied().unwrap_or_default()
    }

    pub fn rows_mut(&mut self, state: u32) -> Option<&mut Rows> {
        self.rows.get_mut(state as usize)
    }
}

/// Source of the noise of a step.
#[derive(Debug, Clone)]
pub(crate) enum Draws<'d> {
    /// Noise of zeros.
    Zero,
    /// A seeded generator.
    Seeded(Normals),
    /// Recorded values that are not used yet.
    Given(&'d [f32]),
}

/// Execution of the calls of one event.
pub(crate) struct Run<'r, 'a, 'm, 'd> {
    pub tables: &'r Tables<'a>,
    pub memory: &'r mut Workspace<'m>,
    /// Number of the action channel.
    pub action: u32,
    /// Values that the caller gave, except for noise, which is drawn.
    pub given: &'r [(ChannelId, Data<'d>)],
    /// Number of the noise channel.
    pub noise: Option<u32>,
    pub draws: Draws<'d>,
    pub counters: Counters,
    /// Number of words of the instruction that is set.
    pub words: u32,
    /// Index that an entry has given as an output.
    pub given_index: Option<u32>,
}

/// Returns the elements of a span.
#[inline]
fn elements(arena: &mut [f32], span: Span) -> Result<&mut [f32], RunError> {
    let start = span.offset as usize;
    arena
        .get_mut(start..start.saturating_add(span.len as usize))
        .ok_or(RunError::Program(ExecError::Span))
}

/// Returns elements `at..at + len` of a state's memory.
#[inline]
fn part(memory: &[f32], at: usize, len: usize) -> Result<&[f32], RunError> {
    memory
        .get(at..at.saturating_add(len))
        .ok_or(RunError::Program(ExecError::Span))
}

#[inline]
fn part_mut(memory: &mut [f32], at: usize, len: usize) -> Result<&mut [f32], RunError> {
    memory
        .get_mut(at..at.saturating_add(len))
        .ok_or(RunError::Program(ExecError::Span))
}

/// Copies values to the front of a span and fills the rest with zeros.
#[inline]
fn fill(to: &mut [f32], from: &[f32]) {
    assign(to, from);
    to.get_mut(from.len()..).unwrap_or(&mut []).fill(0.0);
}

impl<'r, 'a, 'm, 'd> Run<'r, 'a, 'm, 'd> {
    /// Starts with no call run and noise of zero.
    pub fn new(
        policy: &'r Policy<'a>,
        memory: &'r mut Workspace<'m>,
        given: &'r [(ChannelId, Data<'d>)],
        counters: Counters,
    ) -> Self {
        let contract = policy.contract();
        Self {
            tables: policy.tables(),
            memory,
            action: contract.action_id(),
            given,
            noise: contract.noise_id(),
            draws: Draws::Zero,
            counters,
            words: 0,
            given_index: None,
        }
    }
}

impl Run<'_, '_, '_, '_> {
    /// Runs one call: clears its states, then runs its entry as often as the call says. The
    /// controller makes the selection.
    #[inline]
    pub fn call(&mut self, call: &CallRecord) -> Result<(), RunError> {
        let tables = self.tables;
        for &state in tables.clears(call) {
            self.clear(state)?;
        }
        let entry = tables
            .entry(call.entry as usize)
            .ok_or(RunError::Program(ExecError::Span))?;
        let times = match call.repeat {
            Repeat::Times => call.count,
            Repeat::Rows => self.counters.rows(call.count).len,
        };
        for pass in 0..times {
            let ints = self.entry(&entry, pass)?;
            self.store(&entry, ints)?;
            if entry.cache != records::NONE {
                let appended = match call.event {
                    Event::Instruct => self.words,
                    _ => entry.tokens,
                };
                if let Some(rows) = self.counters.rows_mut(entry.cache) {
                    rows.len = rows.len.saturating_add(appended);
                }
            }
        }
        Ok(())
    }

    /// Empties a state for the coming writes; the state in force stays.
    pub fn clear(&mut self, state: u32) -> Result<(), RunError> {
        let record = self.state(state)?;
        if record.kind == StateKind::Plain {
            let (at, len) = (record.offset as usize, record.width as usize);
            part_mut(self.memory.next.plain, at, len)?.fill(0.0);
        } else if let Some(rows) = self.counters.rows_mut(state) {
            *rows = match record.kind {
                StateKind::Kv => Rows {
                    len: 0,
                    start: 1_u32.saturating_sub(rows.start),
                },
                _ => rows.emptied(&record),
            };
        }
        Ok(())
    }

    /// Returns the values of a plain state, including this step's writes so far.
    #[inline]
    pub fn plain(&self, state: u32) -> Result<&[f32], RunError> {
        let record = self.state(state)?;
        let memory = if record.scope == Scope::Step {
            &*self.memory.scratch
        } else {
            &*self.memory.next.plain
        };
        part(memory, record.offset as usize, record.width as usize)
    }

    #[inline]
    fn state(&self, state: u32) -> Result<StateRecord, RunError> {
        self.tables
            .state(state as usize)
            .ok_or(RunError::Program(ExecError::Span))
    }

    /// Fills the inputs and runs the program; results are left in the arena.
    #[inline]
    pub fn entry(&mut self, entry: &EntryRecord, pass: u32) -> Result<Ints, RunError> {
        let mut ints = [0; INT_SLOTS];
        for PortRecord { source, place, .. } in self.tables.inputs(entry) {
            match place {
                Place::Span(span) => self.read(source, span, pass)?,
                Place::Int(slot) => {
                    if let Some(int) = ints.get_mut(usize::from(slot.0)) {
                        *int = self.int(source, pass);
                    }
                }
            }
        }
        let (mut cache, mut past, mut rows) = (&mut [][..], 0, 0);
        if entry.cache != records::NONE {
            let state = self.state(entry.cache)?;
            let Rows { len, start } = self.counters.rows(entry.cache);
            let width = state.width as usize;
            let at = (state.offset as usize).saturating_add(width.saturating_mul(start as usize));
            cache = part_mut(self.memory.rows, at, width)?;
            past = len as usize;
            rows = state.rows as usize;
        }
        let mut machine = Machine {
            arena: &mut *self.memory.arena,
            cache,
            ints,
            past,
            isa: self.memory.isa,
        };
        let ops = self.tables.ops(entry);
        Program::trusted(ops, entry.arena_len, entry.tokens, rows)
            .run(self.tables.weights(), &mut machine)
            .map_err(RunError::Program)?;
        Ok(machine.ints)
    }

    fn int(&self, source: Source, pass: u32) -> u32 {
        match source.kind {
            SourceKind::Timestep => self.counters.timestep,
            SourceKind::Phase => self.counters.timestep.checked_rem(source.of).unwrap_or(0),
            SourceKind::Pass => pass,
            SourceKind::Selected => self.counters.selected,
            SourceKind::Channel => match self.find(source.of) {
                Some(Data::I32(&[value])) => value.cast_unsigned(),
                _ => 0,
            },
            SourceKind::State | SourceKind::Row => 0,
        }
    }

    #[inline]
    fn find(&self, channel: u32) -> Option<Data<'_>> {
        self.given
            .iter()
            .find(|(id, _)| id.0 == channel)
            .map(|&(_, data)| data)
    }

    /// Fills one input.
    #[inline]
    fn read(&mut self, source: Source, span: Span, pass: u32) -> Result<(), RunError> {
        match source.kind {
            SourceKind::Channel => {
                let given = self.given.iter().find(|(id, _)| id.0 == source.of);
                let to = elements(self.memory.arena, span)?;
                match given {
                    _ if self.noise == Some(source.of) => self.draws.next(to),
                    Some(&(_, Data::F32(values))) => fill(to, values),
                    Some(&(_, Data::U8(values))) => {
                        to.iter_mut()
                            .zip(values)
                            .for_each(|(to, &value)| *to = f32::from(value));
                    }
                    Some(&(_, Data::I32(values))) => {
                        to.iter_mut()
                            .zip(values)
                            .for_each(|(to, &value)| *to = value as f32);
                    }
                    None if source.of == self.action => assign(to, self.memory.now.action),
                    // Only where nothing is given at all: to warm up.
                    None => to.fill(0.0),
                }
                Ok(())
            }
            SourceKind::State => {
                let state = self.state(source.of)?;
                if state.kind == StateKind::Ring {
                    return self.read_ring(source.of, &state, span);
                }
                let (at, len) = (state.offset as usize, state.width as usize);
                let memory = match state.scope {
                    Scope::Step => &*self.memory.scratch,
                    _ => &*self.memory.next.plain,
                };
                assign(elements(self.memory.arena, span)?, part(memory, at, len)?);
                Ok(())
            }
            SourceKind::Row => {
                let ring = self.state(source.of)?;
                let at = row_at(&ring, self.counters.rows(source.of).start, pass);
                let from = part(self.memory.rows, at, ring.width as usize)?;
                assign(elements(self.memory.arena, span)?, from);
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Reads all rows of a ring, the oldest first; missing rows come first and hold zeros or the
    /// oldest row, by the ring's `fill`.
    fn read_ring(&mut self, state: u32, ring: &StateRecord, span: Span) -> Result<(), RunError> {
        let Rows { len, start } = self.counters.rows(state);
        let missing = ring.rows.saturating_sub(len);
        let width = ring.width as usize;
        let to = elements(self.memory.arena, span)?;
        for (i, to) in (0_u32..).zip(to.chunks_exact_mut(width.max(1))) {
            // The same work for every row, so that it does not depend on how many there are.
            let row = i.saturating_sub(missing);
            let from = part(self.memory.rows, row_at(ring, start, row), width)?;
            assign(to, from);
            let blank = i < missing && (ring.fill == Fill::Zero || len == 0);
            for value in to {
                *value = if blank { 0.0 } else { *value };
            }
        }
        Ok(())
    }

    /// Stores the outputs of a program from the arena.
    #[inline]
    fn store(&mut self, entry: &EntryRecord, ints: Ints) -> Result<(), RunError> {
        for PortRecord { source, place, .. } in self.tables.outputs(entry) {
            let span = match place {
                Place::Span(span) => span,
                Place::Int(slot) => {
                    self.given_index = ints.get(usize::from(slot.0)).copied();
                    continue;
                }
            };
            let from = {
                let start = span.offset as usize;
                part(self.memory.arena, start, span.len as usize)?
            };
            if !from.iter().all(|x| x.is_finite()) {
                return Err(RunError::NotFinite);
            }
            if source.kind == SourceKind::Channel {
                assign(self.memory.next.action, from);
                continue;
            }
            let state = self
                .tables
                .state(source.of as usize)
                .ok_or(RunError::Program(ExecError::Span))?;
            let len = state.width as usize;
            let to = match (state.kind, state.scope) {
                (StateKind::Plain, Scope::Step) => {
                    part_mut(self.memory.scratch, state.offset as usize, len)?
                }
                (StateKind::Plain, _) => {
                    part_mut(self.memory.next.plain, state.offset as usize, len)?
                }
                _ => {
                    let rows = self
                        .counters
                        .rows_mut(source.of)
                        .ok_or(RunError::Program(ExecError::Span))?;
                    let at = row_at(&state, rows.start, rows.len);
                    if rows.len < state.rows {
                        rows.len = rows.len.saturating_add(1);
                    } else {
                        rows.start = wrapped(&state, rows.start, 1);
                    }
                    part_mut(self.memory.rows, at, len)?
                }
            };
            assign(to, from);
        }
        Ok(())
    }
}

impl Draws<'_> {
    fn next(&mut self, to: &mut [f32]) {
        match self {
            Self::Zero => to.fill(0.0),
            Self::Seeded(normals) => normals.fill(to),
            Self::Given(values) => {
                let (now, rest) = values.split_at_checked(to.len()).unwrap_or((values, &[]));
                fill(to, now);
                *values = rest;
            }
        }
    }
}

/// Returns the row of a ring's memory that is `by` rows after `start`.
fn wrapped(ring: &StateRecord, start: u32, by: u32) -> u32 {
    start
        .saturating_add(by)
        .checked_rem(ring.rows.saturating_add(1))
        .unwrap_or(0)
}

/// Returns the first element, in the row memory, of row `by` of a ring whose oldest row is `start`.
fn row_at(ring: &StateRecord, start: u32, by: u32) -> usize {
    let row = wrapped(ring, start, by) as usize;
    (ring.offset as usize).saturating_add(row.saturating_mul(ring.width as usize))
}
