//! Walks the schedule step by step through a context.

use lads_image::records::{
    self, CallRecord, EntryRecord, Event, MAX_ROW_STATES, PortRecord, Repeat, Scope, SourceKind,
    StateKind,
};
use lads_image::{Chain, Tables};

use super::{Checked, MAX_STEPS, ScheduleError, Sizes, Work};
use crate::contract::{Contract, Role};

/// A walk of the schedule through a context.
#[expect(
    clippy::struct_excessive_bools,
    reason = "facts about a step, independent of each other"
)]
struct Walk<'t, 'a> {
    tables: &'t Tables<'a>,
    contract: &'t Contract<'a>,
    costs: &'t Work,
    bounded: bool,
    /// Valid rows of rings and KV caches.
    rows: [u32; MAX_ROW_STATES],
    /// Largest number of valid rows so far.
    most: [u32; MAX_ROW_STATES],
    selected: bool,
    /// States written in the current step, one bit per state.
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
        let run = self.costs.get(call.entry as usize).copied().unwrap_or(0);
        self.work = self
            .work
            .saturating_add(run.saturating_mul(u64::from(most)));
        if least > 0 {
            self.writes(&entry, refused)?;
        }
        self.selected |= call.select != records::NONE;
        Ok(())
    }

    /// Returns how often a call runs: at least, at most at this step of a context, at most at any
    /// step.
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

    /// Checks that everything that an entry reads has been written.
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

    /// Checks that the KV cache has room for all runs.
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
            // The number of its valid rows is known once an instruction is set: no rows may follow them.
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

    /// Walks the calls of one event, at a timestep.
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

/// Walks every kind of event, and every step of a context.
#[inline(never)]
pub(super) fn go_through(
    tables: &Tables,
    contract: &Contract,
    costs: &Work,
    sizes: &mut Sizes,
) -> Checked {
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
        costs,
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
