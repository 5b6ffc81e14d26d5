//! The memory of a controller on a host that may allocate.

use lads_core::{Controller, Isa, Policy, Workspace, WorkspaceTooSmall};

/// What one controller works in, allocated once.
#[derive(Debug, Clone)]
pub struct Memory {
    /// Scratch, in f32 elements.
    pub arena: Vec<f32>,
    /// What survives a control step, in f32 elements.
    pub state: Vec<f32>,
}

impl Memory {
    /// As much as `policy` asks for.
    pub fn of(policy: &Policy<'_>) -> Self {
        Self {
            arena: vec![0.0; policy.arena_len()],
            state: vec![0.0; policy.state_len()],
        }
    }

    /// A controller that works in this memory; refused when it was made for a smaller policy.
    pub fn controller<'p, 'm>(
        &'m mut self,
        policy: &Policy<'p>,
    ) -> Result<Controller<'p, 'm>, WorkspaceTooSmall> {
        self.controller_with(policy, Isa::detect())
    }

    /// The same on chosen instructions.
    pub fn controller_with<'p, 'm>(
        &'m mut self,
        policy: &Policy<'p>,
        isa: Isa,
    ) -> Result<Controller<'p, 'm>, WorkspaceTooSmall> {
        let workspace = Workspace::new(policy, &mut self.arena, &mut self.state)?;
        Ok(Controller::with_isa(*policy, workspace, isa))
    }
}
