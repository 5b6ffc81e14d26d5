//! A policy with the image that it views, and a controller with the memory that it borrows, each as one value.

use std::sync::Arc;

use lads_core::{Controller, Isa};
use lads_host::{Memory, MemoryError, Opened};
use self_cell::{MutBorrow, self_cell};

type View<'a> = lads_core::Policy<'a>;
type Core<'a> = Controller<'a, 'a>;

self_cell!(
    /// A policy that was opened, and the view on it that was checked once.
    pub struct Checked {
        owner: Opened,
        #[covariant]
        dependent: View,
    }
);

impl Checked {
    /// Checks what was opened; it was checked before, so that this cannot fail.
    pub fn of(opened: Opened) -> Arc<Self> {
        Arc::new(Self::new(opened, Opened::policy))
    }

    /// What was opened.
    pub fn opened(&self) -> &Opened {
        self.borrow_owner()
    }

    /// The view on it.
    pub fn view(&self) -> &View<'_> {
        self.borrow_dependent()
    }
}

/// What a controller borrows.
pub struct Ground {
    policy: Arc<Checked>,
    memory: MutBorrow<Memory>,
}

self_cell!(
    /// A controller and its memory.
    pub struct Working {
        owner: Ground,
        #[not_covariant]
        dependent: Core,
    }
);

impl Working {
    /// A fresh controller on these instructions of the processor.
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

    /// Works with the controller.
    pub fn with<R>(&mut self, work: impl for<'c> FnOnce(&mut Core<'c>) -> R) -> R {
        self.with_dependent_mut(|_, controller| work(controller))
    }
}
