//! Lang DT: a causal transformer over words, observations and actions that outputs the action
//! itself, in every step.
//!
//! Where the contract says `features`, an encoder runs first in every step, and the transformer reads what it gives instead.

use lads_image::records::Event;
use serde::Deserialize;

use super::{Blueprint, Call, Entry, Kind, instructed, lengths};
use crate::contract::{Contract, Faults};

/// Every field of this family in a contract.
pub(crate) const EXAMPLE: &str = r#"{"kind": "lang_dt", "features": 1}"#;

/// Contract fields of Lang DT.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct LangDt {
    /// Elements of what an encoder makes of the observations, such as camera frames, once in a control step; without it the transformer
    /// reads the observations themselves.
    #[serde(default)]
    pub features: Option<usize>,
}

impl Kind for LangDt {
    fn check(&self, contract: &Contract, faults: &mut Faults) {
        lengths([("features", self.features.unwrap_or(1))], faults);
        instructed(contract, faults);
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (start, step) = ("high_level/start", "high_level/step");
        Blueprint::observed(self.features, &[Event::Step])
            .kv("context", contract.network)
            .entry(Entry::new(start, &["action"]).cache("context").acts())
            .entry(Entry::new(step, &["action"]).cache("context").acts())
            .entry(
                Entry::new("high_level/instruct", &[])
                    .cache("context")
                    .acts(),
            )
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(Call::step(start).first())
            .call(Call::step(step).otherwise())
    }
}
