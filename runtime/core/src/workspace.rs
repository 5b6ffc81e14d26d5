//! The memory of a controller, which belongs to the caller.

use core::error::Error;
use core::fmt;

use lads_kernels::{Isa, assign};

use crate::exec::Machine;
use crate::op::INT_SLOTS;
use crate::policy::Policy;

/// What a control step replaces as a whole: the plan, the action and the logits.
#[derive(Debug)]
pub(crate) struct Bank<'m> {
    pub plan: &'m mut [f32],
    pub action: &'m mut [f32],
    pub logits: &'m mut [f32],
}

impl Bank<'_> {
    /// Takes over another bank's values.
    pub fn copy_from(&mut self, other: &Bank) {
        assign(self.plan, other.plan);
        assign(self.action, other.action);
        assign(self.logits, other.logits);
    }
}

/// Memory for one controller: the arena, which holds nothing between two calls, and the state, which does.
#[derive(Debug)]
pub struct Workspace<'m> {
    pub(crate) machine: Machine<'m>,
    /// The state in force.
    pub(crate) now: Bank<'m>,
    /// What the step that is being computed would make of it.
    pub(crate) next: Bank<'m>,
}

impl<'m> Workspace<'m> {
    /// Takes [`Policy::arena_len`] and [`Policy::state_len`] elements and sets them to zero; what is longer is left alone.
    pub fn new(
        policy: &Policy,
        arena: &'m mut [f32],
        state: &'m mut [f32],
    ) -> Result<Self, WorkspaceTooSmall> {
        let arena = take(arena, policy.arena_len())?;
        let state = take(state, policy.state_len())?;
        let (got, needed) = (state.len(), policy.state_len());
        let parts = split(state, policy.contract().cache_len(), policy.bank_lens());
        let (cache, now, next) = parts.ok_or(WorkspaceTooSmall { got, needed })?;
        Ok(Self {
            machine: Machine {
                arena,
                cache,
                ints: [0; INT_SLOTS],
                isa: Isa::portable(),
            },
            now,
            next,
        })
    }

    /// Elements of the plan, the action and the logits, as [`Policy::bank_lens`] has them.
    pub(crate) fn bank_lens(&self) -> [usize; 3] {
        [&self.now.plan, &self.now.action, &self.now.logits].map(|part| part.len())
    }
}

/// The state: the cache, then both banks.
fn split(
    state: &mut [f32],
    cache_len: usize,
    bank_lens: [usize; 3],
) -> Option<(&mut [f32], Bank<'_>, Bank<'_>)> {
    let (cache, rest) = state.split_at_mut_checked(cache_len)?;
    let (now, rest) = bank(rest, bank_lens)?;
    let (next, _) = bank(rest, bank_lens)?;
    Some((cache, now, next))
}

/// The first `needed` elements, set to zero.
fn take(memory: &mut [f32], needed: usize) -> Result<&mut [f32], WorkspaceTooSmall> {
    let got = memory.len();
    let taken = memory
        .get_mut(..needed)
        .ok_or(WorkspaceTooSmall { got, needed })?;
    taken.fill(0.0);
    Ok(taken)
}

/// Cuts a bank off the front.
fn bank(memory: &mut [f32], [plan, action, logits]: [usize; 3]) -> Option<(Bank<'_>, &mut [f32])> {
    let (plan, rest) = memory.split_at_mut_checked(plan)?;
    let (action, rest) = rest.split_at_mut_checked(action)?;
    let (logits, rest) = rest.split_at_mut_checked(logits)?;
    Some((
        Bank {
            plan,
            action,
            logits,
        },
        rest,
    ))
}

/// The arena or the state has too few elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkspaceTooSmall {
    /// Elements that there are.
    pub got: usize,
    /// Elements that are needed.
    pub needed: usize,
}

impl fmt::Display for WorkspaceTooSmall {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "the workspace has {} elements, {} are needed",
            self.got, self.needed
        )
    }
}

impl Error for WorkspaceTooSmall {}
