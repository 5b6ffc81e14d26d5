//! Lang DT: a causal transformer over words, observations and actions that outputs the action
//! itself, in every step.

use lads_image::records::Event;
use serde::Deserialize;

use super::{Blueprint, Call, Entry, Kind, instructed};
use crate::contract::Contract;

/// Contract fields of Lang DT, which has none of its own.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct LangDt {}

impl Kind for LangDt {
    fn check(&self, contract: &Contract) -> Result<(), String> {
        instructed(contract)
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (start, step) = ("high_level/start", "high_level/step");
        Blueprint::default()
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
