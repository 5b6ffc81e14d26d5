//! Memory of a controller on a host that may allocate.
//!
//! Images are untrusted, and one may ask for more memory than there is: that is refused before any
//! of it is touched.

use lads_core::{Controller, Isa, Policy, Workspace, WorkspaceTooSmall};

use crate::pages::Pages;

/// Memory of one controller, allocated once.
#[derive(Debug)]
pub struct Memory {
    /// Scratch memory, then the state that survives a control step.
    pages: Pages,
    /// Number of elements of the scratch memory.
    arena: usize,
}

impl Memory {
    /// Allocates as much memory as `policy` asks for, up to [`Policy::MEMORY_LIMIT`].
    pub fn of(policy: &Policy<'_>) -> Result<Self, MemoryError> {
        let (arena, state) = (policy.arena_len(), policy.state_len());
        let bytes = Self::bytes_of(arena.saturating_add(state))?;
        let pages = Pages::zeroed(bytes).map_err(|_| MemoryError::Exhausted { bytes })?;
        Ok(Self { pages, arena })
    }

    /// Memory that a controller of `policy` may come to take, in bytes: what the policy asks for,
    /// in whole large pages where the system has them.
    pub fn bytes(policy: &Policy<'_>) -> usize {
        let elements = policy.arena_len().saturating_add(policy.state_len());
        let bytes = elements.saturating_mul(size_of::<f32>());
        Pages::taken(bytes)
    }

    /// Converts a number of f32 elements to bytes, if that is within a policy's limit.
    fn bytes_of(elements: usize) -> Result<usize, MemoryError> {
        let bytes = elements.saturating_mul(size_of::<f32>());
        if bytes > Policy::MEMORY_LIMIT {
            return Err(MemoryError::Excessive { bytes });
        }
        Ok(bytes)
    }

    /// Makes a controller that works in this memory; fails if the memory was made for a smaller
    /// policy.
    pub fn controller<'p, 'm>(
        &'m mut self,
        policy: &Policy<'p>,
    ) -> Result<Controller<'p, 'm>, MemoryError> {
        self.controller_with(policy, Isa::detect())
    }

    /// Makes a controller on a chosen instruction set that works in this memory.
    pub fn controller_with<'p, 'm>(
        &'m mut self,
        policy: &Policy<'p>,
        isa: Isa,
    ) -> Result<Controller<'p, 'm>, MemoryError> {
        let (arena, state) = self.pages.as_mut().split_at_mut(self.arena);
        let workspace = Workspace::new(policy, arena, state)?;
        Ok(Controller::with_isa(*policy, workspace, isa))
    }
}

/// Reason why there is no memory for a controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MemoryError {
    /// The policy asks for more memory than any policy gets.
    #[error(
        "the policy asks for a workspace of {bytes} bytes, and gets at most {most}; do not trust it, or export a bundle with a shorter context",
        most = Policy::MEMORY_LIMIT
    )]
    Excessive {
        /// Memory that the policy asks for, in bytes.
        bytes: usize,
    },
    /// This machine does not have the memory.
    #[error(
        "this machine has no {bytes} bytes left for the policy's workspace; end other programs, or export a bundle with a shorter context"
    )]
    Exhausted {
        /// Memory that the policy asks for, in bytes.
        bytes: usize,
    },
    /// The memory was made for a smaller policy.
    #[error("{0}; it was made for another policy")]
    Small(#[from] WorkspaceTooSmall),
}
