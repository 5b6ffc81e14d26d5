//! LADS with a history: a low level that attends to a window of earlier steps and to those under
//! its plan (the paper's Kitchen setting with images).
//!
//! The window is kept as a ring of rows. When the plan changes the low level's cache is emptied and filled again: with the plan, then
//! with the rows of the window, the oldest first, then with the steps as they come.
//!
//! Where the contract says `features`, an encoder runs first in every step, and all levels read what it gives instead of the observations.
//! Where it says `actions`, the high level hears actions too, as LADS' does: its first step, before which there was none, is the entry
//! `high_level/start`.

use lads_image::records::{Event, Fill, Scope};
use serde::Deserialize;

use super::{
    Blueprint, Call, Codebook, Decision, Entry, Keep, Kind, Selection, instructed, lengths, network,
};
use crate::contract::{Contract, Network};

/// Sizes of a row of the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Memory {
    /// Number of elements, `R`.
    pub dim: usize,
}

/// Contract fields of the family with a history.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct History {
    /// Number of control steps from one decision to the next, `H`.
    pub horizon: usize,
    /// Sizes of the codebook of latent plans.
    pub codebook: Codebook,
    /// Rule by which plans are picked.
    pub decision: Decision,
    /// Number of steps of the window, `W`.
    pub window: usize,
    /// Sizes of a row of the window.
    pub memory: Memory,
    /// Sizes of the low level's transformer.
    pub low_level: Network,
    /// Number of elements of what an encoder makes of the observations, once in a control step for all levels; without it they read the
    /// observations themselves.
    #[serde(default)]
    pub features: Option<usize>,
    /// True if the high level's history has the executed actions besides the observations.
    #[serde(default)]
    pub actions: bool,
}

impl Kind for History {
    fn period(&self) -> Option<usize> {
        Some(self.horizon)
    }

    fn selection(&self) -> Selection {
        self.decision.selection()
    }

    fn check(&self, contract: &Contract) -> Result<(), String> {
        lengths([
            ("horizon", self.horizon),
            ("codebook.size", self.codebook.size),
            ("codebook.dim", self.codebook.dim),
            ("window", self.window),
            ("memory.dim", self.memory.dim),
            ("features", self.features.unwrap_or(1)),
        ])?;
        network(Some(self.low_level), "family.low_level")?;
        self.decision.check()?;
        instructed(contract)
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (start, step, record) = ("high_level/start", "high_level/step", "high_level/record");
        let (plan, recall, low_step) = ("low_level/plan", "low_level/recall", "low_level/step");
        let h = self.horizon;
        let ring = Keep::Ring {
            rows: self.window,
            fill: Fill::Zero,
        };
        let mut blueprint = Blueprint::observed(self.features, &[Event::Step])
            .kv("context", contract.network)
            .kv("chunk", Some(self.low_level))
            .state("row", ring, Scope::Episode)
            .wide(self.memory.dim, "family.memory.dim")
            .plain("logits")
            .wide(self.codebook.size, "family.codebook.size");
        let mut decided = Call::step(step).every(h).select("logits");
        if self.actions {
            blueprint = blueprint
                .entry(Entry::new(start, &["logits"]).cache("context"))
                .call(Call::step(start).first().select("logits"));
            decided = decided.otherwise();
        }
        blueprint = blueprint
            .entry(Entry::new(step, &["logits"]).cache("context"))
            .entry(Entry::variant(record, step, &[]).cache("context"))
            .entry(Entry::new(plan, &[]).cache("chunk").acts())
            .entry(Entry::new(recall, &[]).cache("chunk").acts())
            .entry(Entry::new(low_step, &["action"]).cache("chunk").acts())
            .entry(Entry::new("memory/append", &["next_row"]).acts())
            .entry(Entry::new("high_level/instruct", &[]).cache("context"))
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(decided)
            .call(Call::step(record).otherwise())
            .call(Call::step(plan).every(h).clears("chunk"))
            .call(Call::step(recall).every(h).rows("row"))
            .call(Call::step(low_step))
            .call(Call::step("memory/append"));
        blueprint.period = h;
        blueprint
    }
}
