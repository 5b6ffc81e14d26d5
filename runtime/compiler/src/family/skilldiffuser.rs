//! `SkillDiffuser`: every `H` steps a chunk of states by denoising and the actions between them, which are then executed open loop.

use lads_image::records::Event;
use serde::Deserialize;

use super::{
    Blueprint, Call, Codebook, Decision, Denoise, Entry, Kind, Noise, NoiseSource, Selection,
    instructed, lengths, one_noise,
};
use crate::contract::{Contract, Faults};

/// Every field of this family in a contract.
pub(crate) const EXAMPLE: &str = r#"{"kind": "skilldiffuser", "horizon": 1, "codebook": {"size": 1, "dim": 1}, "decision": {"rule": "argmax", "temperature": 1, "seed": 0},
    "denoise": {"steps": 1}, "noise": {"rule": "zero", "seed": 0}}"#;

/// Contract fields of `SkillDiffuser`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct SkillDiffuser {
    /// Number of actions of a chunk, and of control steps from one decision to the next.
    pub horizon: usize,
    /// Sizes of the codebook of latent plans.
    pub codebook: Codebook,
    /// Rule by which plans are picked.
    pub decision: Decision,
    /// Denoising of a chunk.
    pub denoise: Denoise,
    /// Source of the denoising's noise.
    pub noise: NoiseSource,
}

impl Kind for SkillDiffuser {
    fn period(&self) -> Option<usize> {
        Some(self.horizon)
    }

    fn selection(&self) -> Selection {
        self.decision.selection()
    }

    fn noise(&self) -> Noise {
        self.noise.noise()
    }

    fn check(&self, contract: &Contract, faults: &mut Faults) {
        lengths(
            [
                ("horizon", self.horizon),
                ("denoise.steps", self.denoise.steps),
            ],
            faults,
        );
        self.codebook.check(faults);
        self.decision.check(faults);
        one_noise(contract, faults);
        instructed(contract, faults);
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (step, record) = ("high_level/step", "high_level/record");
        let (init, denoise) = ("low_level/init", "low_level/denoise");
        let (inverse, pop) = ("low_level/inverse", "low_level/pop");
        let h = self.horizon;
        let mut blueprint = Blueprint::default()
            .kv("context", contract.network)
            .plain("logits")
            .wide(self.codebook.size, "family.codebook.size")
            .plain("queue")
            .handed("embedding")
            .handed("x")
            .entry(
                Entry::new(step, &["logits", "embedding"])
                    .cache("context")
                    .acts(),
            )
            .entry(Entry::variant(record, step, &[]).cache("context"))
            .entry(Entry::new(init, &["x"]).acts())
            .entry(Entry::new(denoise, &["next_x"]).acts())
            .entry(Entry::new(inverse, &["queue"]).acts())
            .entry(Entry::new(pop, &["action"]).acts())
            .entry(Entry::new("high_level/instruct", &[]).cache("context"))
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(Call::step(step).every(h).select("logits"))
            .call(Call::step(record).otherwise())
            .call(Call::step(init).every(h))
            .call(Call::step(denoise).every(h).times(self.denoise.steps))
            .call(Call::step(inverse).every(h))
            .call(Call::step(pop));
        blueprint.period = h;
        blueprint
    }
}
