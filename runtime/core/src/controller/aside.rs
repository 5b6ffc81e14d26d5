//! Calls that leave the episode unchanged: warming up, an action for an index that the caller
//! chose, encoding a demonstration.

use lads_image::records::{self, Event};
use lads_image::{ExecError, Tables};
use lads_kernels::assign;

use super::Controller;
use crate::contract::{ChannelId, Role};
use crate::errors::{EncodeError, FollowError, RunError};
use crate::inputs::{self, Data};
use crate::run::{Counters, Run};
use crate::workspace::Workspace;

impl Controller<'_, '_> {
    /// Brings code, weights and KV caches into the processor's caches, so that the next step,
    /// whichever kind it is, is as fast as the ones after it; call it right before the first step,
    /// or after a pause. Costs two to three control steps and changes nothing.
    pub fn warm(&mut self) {
        if !self.workspace.fits(&self.policy) {
            return;
        }
        // With a full context no step may follow, but code and weights are the same.
        let mut counters = self.begin().map_or(self.counters, |begun| begun.counters);
        let first = counters.timestep == 0;
        // A table by timestep has no row for what only comes later.
        counters.timestep = counters.timestep.max(1);
        let tables = *self.policy.tables();
        for call in tables.calls().filter(|call| call.event == Event::Step) {
            let only_first = call.when == records::When::First;
            let Some(entry) = tables.entry(call.entry as usize) else {
                continue;
            };
            let mut run = Run::new(&self.policy, &mut self.workspace, &[], counters);
            if only_first {
                run.counters.timestep = 0;
            }
            // A cache that the call clears has another half, which holds nothing that counts.
            let cleared = tables.clears(&call).iter();
            let cleared = cleared
                .map(|&state| run.clear(state))
                .all(|done| done.is_ok());
            // Appended rows follow the valid rows, where the next step writes too; nothing else is stored. A program
            // that fails does so again in the step, which reports it.
            let room = entry.cache == records::NONE || has_room(&tables, &entry, &run.counters);
            if cleared && room && (first || !only_first) {
                let _ = run.entry(&entry, 0);
            }
        }
    }

    /// Writes the action for an observation and an index that the caller chose, clipped to the
    /// contract's limits. Changes nothing in the episode under way, and needs no instruction.
    pub fn follow(
        &mut self,
        inputs: &[(ChannelId, Data)],
        index: u32,
        action: &mut [f32],
    ) -> Result<(), FollowError> {
        if !self.policy.follows() {
            return Err(FollowError::NotOffered);
        }
        let contract = self.policy.contract();
        let (got, needed) = (action.len(), contract.action_len());
        if got != needed {
            return Err(FollowError::ActionLength { got, needed });
        }
        let count = self.policy.index_count();
        if index >= count {
            return Err(FollowError::Index { got: index, count });
        }
        match *inputs {
            [(id, Data::F32(values))] if contract.only_observation() == Ok(id) => {
                contract.check_only(values)?;
            }
            _ => {
                inputs::check(contract, Role::Observation, inputs, 0)?;
            }
        }
        let mut counters = self.counters;
        counters.selected = index;
        self.aside(Event::Follow, inputs, counters)?;
        assign(action, self.workspace.next.action);
        self.policy.contract().action_bounds().clamp(action);
        Ok(())
    }

    /// Returns the index of the plan that a piece of a demonstration follows, from the values of
    /// all demonstration channels. Changes nothing in the episode under way.
    pub fn encode(&mut self, inputs: &[(ChannelId, Data)]) -> Result<u32, EncodeError> {
        if !self.policy.encodes() {
            return Err(EncodeError::NoEncoder);
        }
        inputs::check(self.policy.contract(), Role::Demonstration, inputs, 0)?;
        let selected = self.aside(Event::Encode, inputs, self.counters)?;
        Ok(selected.unwrap_or(0))
    }

    /// Runs the calls of an event that leaves the episode unchanged: the second bank is unused
    /// between two steps.
    fn aside(
        &mut self,
        event: Event,
        given: &[(ChannelId, Data)],
        counters: Counters,
    ) -> Result<Option<u32>, RunError> {
        if !self.workspace.fits(&self.policy) {
            return Err(RunError::Program(ExecError::Span));
        }
        let Workspace { now, next, .. } = &mut self.workspace;
        next.copy_from(now);
        let mut run = Run::new(&self.policy, &mut self.workspace, given, counters);
        for call in run.tables.due(event, 0) {
            run.call(&call)?;
        }
        Ok(run.given_index)
    }
}

/// Returns whether a program can append to its KV cache past the valid rows.
fn has_room(tables: &Tables, entry: &records::EntryRecord, counters: &Counters) -> bool {
    let rows = tables
        .state(entry.cache as usize)
        .map_or(0, |state| state.rows);
    counters.rows(entry.cache).len.saturating_add(entry.tokens) <= rows
}
