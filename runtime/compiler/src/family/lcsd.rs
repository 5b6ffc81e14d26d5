//! LCSD (our reading of it): a plan in every step, and one action by denoising.

use lads_image::records::Event;
use serde::Deserialize;

use super::{
    Blueprint, Call, Codebook, Decision, Denoise, Entry, Kind, Noise, NoiseSource, Selection,
    instructed, lengths, one_noise,
};
use crate::contract::{Contract, Faults};

/// Every field of this family in a contract.
pub(crate) const EXAMPLE: &str = r#"{"kind": "lcsd", "codebook": {"size": 1, "dim": 1}, "decision": {"rule": "argmax", "temperature": 1, "seed": 0},
    "denoise": {"steps": 1}, "noise": {"rule": "zero", "seed": 0}}"#;

/// Contract fields of LCSD.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Lcsd {
    /// Sizes of the codebook of latent plans.
    pub codebook: Codebook,
    /// Rule by which plans are picked.
    pub decision: Decision,
    /// Denoising of an action.
    pub denoise: Denoise,
    /// Source of the denoising's noise.
    pub noise: NoiseSource,
}

impl Kind for Lcsd {
    fn period(&self) -> Option<usize> {
        Some(1)
    }

    fn selection(&self) -> Selection {
        self.decision.selection()
    }

    fn noise(&self) -> Noise {
        self.noise.noise()
    }

    fn check(&self, contract: &Contract, faults: &mut Faults) {
        lengths([("denoise.steps", self.denoise.steps)], faults);
        self.codebook.check(faults);
        self.decision.check(faults);
        one_noise(contract, faults);
        instructed(contract, faults);
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (init, denoise, act) = ("low_level/init", "low_level/denoise", "low_level/act");
        Blueprint::default()
            .kv("context", contract.network)
            .plain("logits")
            .wide(self.codebook.size, "family.codebook.size")
            .handed("x")
            .entry(Entry::new("high_level/step", &["logits"]).cache("context"))
            .entry(Entry::new(init, &["x"]).acts())
            .entry(Entry::new(denoise, &["next_x"]).acts())
            .entry(Entry::new(act, &["action"]).acts())
            .entry(Entry::new("high_level/instruct", &[]).cache("context"))
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(Call::step("high_level/step").select("logits"))
            .call(Call::step(init))
            .call(Call::step(denoise).times(self.denoise.steps))
            .call(Call::step(act))
    }
}
