//! Self-contained values: a policy with the image that it views, and a controller with the memory
//! that it borrows.

use std::sync::Arc;

use lads_core::{Controller, Isa};
use lads_host::{Memory, MemoryError, Opened};
use self_cell::{MutBorrow, self_cell};

type View<'a> = lads_core::Policy<'a>;
type Core<'a> = Controller<'a, 'a>;

self_cell!(
    /// An opened policy with its checked view.
    pub struct Checked {
        owner: Opened,
        #[covariant]
        dependent: View,
    }
);

impl Checked {
    /// Checks an opened policy; it was checked before, so this cannot fail.
    pub fn of(opened: Opened) -> Arc<Self> {
        Arc::new(Self::new(opened, Opened::policy))
    }

    /// Returns the opened policy.
    pub fn opened(&self) -> &Opened {
        self.borrow_owner()
    }

    /// Returns the checked view on the policy.
    pub fn view(&self) -> &View<'_> {
        self.borrow_dependent()
    }
}

/// Policy and memory that a controller borrows.
pub struct Ground {
    policy: Arc<Checked>,
    memory: MutBorrow<Memory>,
}

self_cell!(
    /// A controller with its memory.
    pub struct Working {
        owner: Ground,
        #[not_covariant]
        dependent: Core,
    }
);

impl Working {
    /// Makes a fresh controller on this instruction set.
    pub fn of(policy: &Arc<Checked>, isa: Isa) -> Result<Self, MemoryError> {
        let ground = Ground {
            memory: MutBorrow::new(Memory::of(policy.view())?),
            policy: Arc::clone(policy),
        };
        Self::try_new(ground, |ground| {
            let memory = ground.memory.borrow_mut();
            memory.controller_with(ground.policy.view(), isa)
        })
    }

    /// Calls `work` with the controller.
    pub fn with<R>(&mut self, work: impl for<'c> FnOnce(&mut Core<'c>) -> R) -> R {
        self.with_dependent_mut(|_, controller| work(controller))
    }
}
