//! The memory of a controller on a host that may allocate.
//!
//! Images are untrusted, and one may ask for more than there is: that is refused before any of it is touched.

use lads_core::{Controller, Isa, Policy, Workspace, WorkspaceTooSmall};

use crate::pages::Pages;

/// What one controller works in, allocated once.
#[derive(Debug)]
pub struct Memory {
    /// Scratch, then what survives a control step.
    pages: Pages,
    /// Elements of the scratch.
    arena: usize,
}

impl Memory {
    /// As much as `policy` asks for, up to [`Policy::MEMORY_LIMIT`].
    pub fn of(policy: &Policy<'_>) -> Result<Self, MemoryError> {
        let (arena, state) = (policy.arena_len(), policy.state_len());
        let bytes = Self::bytes_of(arena.saturating_add(state))?;
        let pages = Pages::zeroed(bytes).map_err(|_| MemoryError::Exhausted { bytes })?;
        Ok(Self { pages, arena })
    }

    /// Bytes of so many f32 elements, if that is not more than a policy gets.
    fn bytes_of(elements: usize) -> Result<usize, MemoryError> {
        let bytes = elements.saturating_mul(size_of::<f32>());
        if bytes > Policy::MEMORY_LIMIT {
            return Err(MemoryError::Excessive { bytes });
        }
        Ok(bytes)
    }

    /// A controller that works in this memory; refused when it was made for a smaller policy.
    pub fn controller<'p, 'm>(
        &'m mut self,
        policy: &Policy<'p>,
    ) -> Result<Controller<'p, 'm>, MemoryError> {
        self.controller_with(policy, Isa::detect())
    }

    /// The same on chosen instructions.
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

/// Why there is no memory for a controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MemoryError {
    /// The policy asks for more than any policy gets.
    #[error(
        "the policy asks for a workspace of {bytes} bytes, and gets at most {most}; do not trust it, or export a bundle with a shorter context",
        most = Policy::MEMORY_LIMIT
    )]
    Excessive {
        /// What it asks for.
        bytes: usize,
    },
    /// This machine does not have it.
    #[error(
        "this machine has no {bytes} bytes left for the policy's workspace; end other programs, or export a bundle with a shorter context"
    )]
    Exhausted {
        /// What the policy asks for.
        bytes: usize,
    },
    /// The memory was made for a smaller policy.
    #[error("{0}; it was made for another policy")]
    Small(#[from] WorkspaceTooSmall),
}
