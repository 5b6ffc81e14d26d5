//! LADS with a history: a low level that attends to a window of earlier steps and to those under
//! its plan (the paper's Kitchen setting with images).
//!
//! Where the contract says `features`, an encoder runs first in every step, and all levels read what it gives instead of the observations.
//! Where it says `actions`, the high level hears actions too, as LADS' does: its first step, before which there was none, is the entry
//! `high_level/start`.

use lads_image::records::Event;
use serde::Deserialize;

use super::recall::Recall;
use super::{Blueprint, Call, Codebook, Decision, Entry, Kind, Selection, instructed, lengths};
use crate::contract::{Contract, Faults};

/// Every field of this family in a contract.
pub(crate) const EXAMPLE: &str = r#"{"kind": "history", "horizon": 1, "codebook": {"size": 1, "dim": 1}, "decision": {"rule": "argmax", "temperature": 1, "seed": 0},
    "window": 1, "memory": {"dim": 1}, "low_level": {"layers": 1, "heads": 1, "head_dim": 1}, "features": 1, "actions": false}"#;

/// Contract fields of the family with a history.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct History {
    /// Number of control steps from one decision to the next, `H`.
    pub horizon: usize,
    /// Sizes of the codebook of latent plans.
    pub codebook: Codebook,
    /// Rule by which plans are picked.
    pub decision: Decision,
    /// Sizes of the low level.
    #[serde(flatten)]
    pub recall: Recall,
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

    fn check(&self, contract: &Contract, faults: &mut Faults) {
        lengths(
            [
                ("horizon", self.horizon),
                ("features", self.features.unwrap_or(1)),
            ],
            faults,
        );
        self.recall.check("", faults);
        self.codebook.check(faults);
        self.decision.check(faults);
        instructed(contract, faults);
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (start, step, record) = ("high_level/start", "high_level/step", "high_level/record");
        let h = self.horizon;
        let blueprint =
            Blueprint::observed(self.features, &[Event::Step]).kv("context", contract.network);
        let mut blueprint = self
            .recall
            .states(blueprint, "")
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
            .entry(Entry::variant(record, step, &[]).cache("context"));
        blueprint = Recall::entries(blueprint)
            .entry(Entry::new("high_level/instruct", &[]).cache("context"))
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(decided)
            .call(Call::step(record).otherwise());
        blueprint = Recall::calls(blueprint, h);
        blueprint.period = h;
        blueprint
    }
}
