//! Memory of a controller, which belongs to the caller.

use core::error::Error;
use core::fmt;

use lads_kernels::{Isa, assign};

use crate::policy::Policy;

/// State that a control step replaces as a whole: the plain states that last longer than a step,
/// and the action.
#[derive(Debug)]
pub(crate) struct Bank<'m> {
    pub plain: &'m mut [f32],
    pub action: &'m mut [f32],
}

impl Bank<'_> {
    /// Copies another bank's values.
    pub fn copy_from(&mut self, other: &Bank) {
        assign(self.plain, other.plain);
        assign(self.action, other.action);
    }
}

/// Memory for one controller: the arena, which is unused between two calls, and the state, which
/// persists.
#[derive(Debug)]
pub struct Workspace<'m> {
    /// Scratch memory of the running program.
    pub(crate) arena: &'m mut [f32],
    /// Memory of rings and KV caches.
    pub(crate) rows: &'m mut [f32],
    /// The state in force.
    pub(crate) now: Bank<'m>,
    /// The state that the running step computes.
    pub(crate) next: Bank<'m>,
    /// Values that the programs of one step hand to each other.
    pub(crate) scratch: &'m mut [f32],
    /// Instruction set that the kernels run on.
    pub(crate) isa: Isa,
}

impl<'m> Workspace<'m> {
    /// Takes [`Policy::arena_len`] and [`Policy::state_len`] elements and sets them to zero;
    /// elements past these are left alone.
    pub fn new(
        policy: &Policy,
        arena: &'m mut [f32],
        state: &'m mut [f32],
    ) -> Result<Self, WorkspaceTooSmall> {
        let arena = take(arena, policy.arena_len())?;
        let state = take(state, policy.state_len())?;
        let (got, needed) = (state.len(), policy.state_len());
        Self::split(policy, arena, state).ok_or(WorkspaceTooSmall { got, needed })
    }

    fn split(policy: &Policy, arena: &'m mut [f32], state: &'m mut [f32]) -> Option<Self> {
        let (plain, action) = (policy.sizes.bank_len, policy.contract().action_len());
        let (rows, rest) = state.split_at_mut_checked(policy.sizes.rows_len)?;
        let (now, rest) = bank(rest, plain, action)?;
        let (next, rest) = bank(rest, plain, action)?;
        let (scratch, _) = rest.split_at_mut_checked(policy.sizes.scratch_len)?;
        Some(Self {
            arena,
            rows,
            now,
            next,
            scratch,
            isa: Isa::portable(),
        })
    }

    /// Returns whether the workspace was made for a policy of these sizes.
    pub(crate) fn fits(&self, policy: &Policy) -> bool {
        self.arena.len() >= policy.arena_len()
            && self.rows.len() == policy.sizes.rows_len
            && self.now.plain.len() == policy.sizes.bank_len
            && self.now.action.len() == policy.contract().action_len()
            && self.scratch.len() == policy.sizes.scratch_len
    }
}

/// Returns the first `needed` elements, set to zero.
fn take(memory: &mut [f32], needed: usize) -> Result<&mut [f32], WorkspaceTooSmall> {
    let got = memory.len();
    let taken = memory
        .get_mut(..needed)
        .ok_or(WorkspaceTooSmall { got, needed })?;
    taken.fill(0.0);
    Ok(taken)
}

/// Cuts a bank off the front.
fn bank(memory: &mut [f32], plain: usize, action: usize) -> Option<(Bank<'_>, &mut [f32])> {
    let (plain, rest) = memory.split_at_mut_checked(plain)?;
    let (action, rest) = rest.split_at_mut_checked(action)?;
    Some((Bank { plain, action }, rest))
}

/// The arena or the state has too few elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkspaceTooSmall {
    /// Number of elements given.
    pub got: usize,
    /// Number of elements needed.
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
