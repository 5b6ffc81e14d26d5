//! LISA: a high level that sees one token a step, and a low level that attends to the steps under the plan in force.
//!
//! ```text
//! t % H == 0   step:      s_t -> logits, select        otherwise   record:   s_t
//! t % H == 0   low start: (index, s_t) -> a_t          otherwise   low step: (a_{t-1}, index, s_t) -> a_t
//! ```
//!
//! The low level's cache is emptied when the plan changes. Where the contract says `features`, an encoder runs first in every step, and both
//! levels read what it gives instead.

use lads_image::records::Event;
use serde::Deserialize;

use super::{
    Blueprint, Call, Codebook, Decision, Entry, Kind, Selection, instructed, lengths, network,
};
use crate::contract::{Contract, Faults, Network};

/// Every field of this family in a contract.
pub(crate) const EXAMPLE: &str = r#"{"kind": "lisa", "horizon": 1, "codebook": {"size": 1, "dim": 1}, "decision": {"rule": "argmax", "temperature": 1, "seed": 0},
    "low_level": {"layers": 1, "heads": 1, "head_dim": 1}, "features": 1}"#;

/// Contract fields of LISA.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Lisa {
    /// Number of control steps from one decision to the next, `H`.
    pub horizon: usize,
    /// Sizes of the codebook of latent plans.
    pub codebook: Codebook,
    /// Rule by which plans are picked.
    pub decision: Decision,
    /// Sizes of the low level's transformer.
    pub low_level: Network,
    /// Elements of what an encoder makes of the observations, such as camera frames, once in a control step for all levels; without it
    /// they read the observations themselves.
    #[serde(default)]
    pub features: Option<usize>,
}

impl Kind for Lisa {
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
        network(Some(self.low_level), "family.low_level", faults);
        self.codebook.check(faults);
        self.decision.check(faults);
        instructed(contract, faults);
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (step, record) = ("high_level/step", "high_level/record");
        let (low_start, low_step) = ("low_level/start", "low_level/step");
        let h = self.horizon;
        Blueprint::observed(self.features, &[Event::Step])
            .kv("context", contract.network)
            .kv("chunk", Some(self.low_level))
            .plain("logits")
            .wide(self.codebook.size, "family.codebook.size")
            .entry(Entry::new(step, &["logits"]).cache("context"))
            .entry(Entry::variant(record, step, &[]).cache("context"))
            .entry(Entry::new(low_start, &["action"]).cache("chunk").acts())
            .entry(Entry::new(low_step, &["action"]).cache("chunk").acts())
            .entry(Entry::new("high_level/instruct", &[]).cache("context"))
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(Call::step(step).every(h).select("logits"))
            .call(Call::step(record).otherwise())
            .call(Call::step(low_start).every(h).clears("chunk"))
            .call(Call::step(low_step).otherwise())
    }
}
