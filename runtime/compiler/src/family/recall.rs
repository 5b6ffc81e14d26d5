//! A low level that attends to the steps under its plan and to a window of those before it.
//!
//! The window is kept as a ring of rows. When the plan changes the low level's cache is emptied and filled again: with the plan, then
//! with the rows of the window, the oldest first, then with the steps as they come.

use lads_image::records::{Fill, Scope};
use serde::Deserialize;

use super::{Blueprint, Call, Entry, Keep, lengths, network};
use crate::contract::{Faults, Network};

/// Sizes of a row of the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Memory {
    /// Number of elements, `R`.
    pub dim: usize,
}

/// Sizes of such a low level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Recall {
    /// Number of steps of the window, `W`.
    pub window: usize,
    /// Sizes of a row of the window.
    pub memory: Memory,
    /// Sizes of the transformer.
    pub low_level: Network,
}

impl Recall {
    /// Checks the sizes, which the contract has `within` the family: nothing, or a field with a point behind it.
    pub(crate) fn check(self, within: &str, faults: &mut Faults) {
        let (window, memory) = (format!("{within}window"), format!("{within}memory.dim"));
        lengths([(&window, self.window), (&memory, self.memory.dim)], faults);
        let low_level = format!("family.{within}low_level");
        network(Some(self.low_level), &low_level, faults);
    }

    /// Adds the transformer's cache and the window.
    pub(crate) fn states(self, blueprint: Blueprint, within: &str) -> Blueprint {
        let ring = Keep::Ring {
            rows: self.window,
            fill: Fill::Zero,
        };
        blueprint
            .kv("chunk", Some(self.low_level))
            .state("row", ring, Scope::Episode)
            .wide(self.memory.dim, &format!("family.{within}memory.dim"))
    }

    /// Adds the entries, of a transformer that hears a plan, then rows of the window, then steps.
    pub(crate) fn entries(blueprint: Blueprint) -> Blueprint {
        let hears = |name: &str| Entry::new(name, &[]).cache("chunk").acts();
        blueprint
            .entry(hears("low_level/plan"))
            .entry(hears("low_level/recall"))
            .entry(
                Entry::new("low_level/step", &["action"])
                    .cache("chunk")
                    .acts(),
            )
            .entry(Entry::new("memory/append", &["next_row"]).acts())
    }

    /// Adds the calls, after those that decide on a plan once a `period`.
    pub(crate) fn calls(blueprint: Blueprint, period: usize) -> Blueprint {
        let decided = |name: &str| Call::step(name).every(period);
        blueprint
            .call(decided("low_level/plan").clears("chunk"))
            .call(decided("low_level/recall").rows("row"))
            .call(Call::step("low_level/step"))
            .call(Call::step("memory/append"))
    }
}
