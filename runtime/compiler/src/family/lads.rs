//! LADS (section 4 of the paper), and policies of its shape: without semantic regularisation,
//! without categorical planning, Cluster.
//!
//! ```text
//! t = 0        start:  s_0               -> logits, select
//! t % H == 0   step:   (a_{t-1}, s_t)    -> logits, select
//! otherwise    record: (a_{t-1}, s_t)
//! t % H == 0   lookup: index             -> plan
//! every t      act:    (s_t, plan)       -> a_t
//! ```
//!
//! Where the contract says `features`, an encoder runs first in every step, and both levels read what it gives instead.

use lads_image::records::Event;
use serde::Deserialize;

use super::{Blueprint, Call, Codebook, Decision, Entry, Kind, Selection, instructed, lengths};
use crate::contract::{Contract, Faults};

/// Every field of this family in a contract.
pub(crate) const EXAMPLE: &str = r#"{"kind": "lads", "horizon": 1, "codebook": {"size": 1, "dim": 1}, "decision": {"rule": "argmax", "temperature": 1, "seed": 0}, "features": 1}"#;

/// Contract fields of LADS.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Lads {
    /// Number of control steps from one decision to the next, `H`.
    pub horizon: usize,
    /// Sizes of the codebook of latent plans.
    pub codebook: Codebook,
    /// Rule by which plans are picked.
    pub decision: Decision,
    /// Elements of what an encoder makes of the observations, such as camera frames, once in a control step for both levels; without it
    /// they read the observations themselves.
    #[serde(default)]
    pub features: Option<usize>,
}

impl Kind for Lads {
    fn period(&self) -> Option<usize> {
        Some(self.horizon)
    }

    fn selection(&self) -> Selection {
        self.decision.selection()
    }

    fn check(&self, contract: &Contract, faults: &mut Faults) {
        lengths([("horizon", self.horizon)], faults);
        lengths([("features", self.features.unwrap_or(1))], faults);
        self.codebook.check(faults);
        self.decision.check(faults);
        instructed(contract, faults);
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (start, step, record) = ("high_level/start", "high_level/step", "high_level/record");
        let (lookup, act) = ("codebook/lookup", "low_level/act");
        let encode = "trajectory_encoder/encode";
        Blueprint::observed(self.features, &[Event::Step, Event::Follow])
            .kv("context", contract.network)
            .plain("logits")
            .wide(self.codebook.size, "family.codebook.size")
            .plain("plan")
            .wide(self.codebook.dim, "family.codebook.dim")
            .entry(Entry::new(start, &["logits"]).cache("context"))
            .entry(Entry::new(step, &["logits"]).cache("context"))
            .entry(Entry::variant(record, step, &[]).cache("context"))
            .entry(Entry::new(lookup, &["plan"]))
            .entry(Entry::new(act, &["action"]).acts())
            .entry(Entry::new(encode, &["index"]).optional())
            .entry(Entry::new("high_level/instruct", &[]).cache("context"))
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(Call::step(start).first().select("logits"))
            .call(
                Call::step(step)
                    .every(self.horizon)
                    .otherwise()
                    .select("logits"),
            )
            .call(Call::step(record).otherwise())
            .call(Call::step(lookup).every(self.horizon))
            .call(Call::step(act))
            .call(Call::on(Event::Follow, lookup))
            .call(Call::on(Event::Follow, act))
            .call(Call::on(Event::Encode, encode))
    }
}
