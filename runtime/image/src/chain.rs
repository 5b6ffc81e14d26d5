//! Selects the calls of an event that run at a timestep: if, else if, else.

use crate::records::{CallRecord, Event, When};
use crate::tables::Tables;

/// State of one pass over the calls of an event, in order, at one timestep.
#[derive(Debug, Clone, Copy, Default)]
pub struct Chain {
    taken: bool,
}

impl Chain {
    /// Returns whether the next call of the event runs at a timestep. A period of 0 steps, which no
    /// sound image has, means timestep 0 only.
    #[inline]
    pub fn runs(&mut self, call: &CallRecord, timestep: u32) -> bool {
        let due = match call.when {
            When::Always => true,
            When::First => timestep == 0,
            When::Every => timestep.is_multiple_of(call.every),
        };
        let runs = due && !(call.otherwise && self.taken);
        self.taken = runs || (call.otherwise && self.taken);
        runs
    }
}

impl<'a> Tables<'a> {
    /// Returns the calls of an event that run at a timestep, in order. In a sound image the calls
    /// of each event are consecutive; others are left out.
    #[inline]
    pub fn due(&self, event: Event, timestep: u32) -> impl Iterator<Item = CallRecord> + use<'a> {
        let mut chain = Chain::default();
        self.calls()
            .skip_while(move |call| call.event != event)
            .take_while(move |call| call.event == event)
            .filter(move |call| chain.runs(call, timestep))
    }
}
