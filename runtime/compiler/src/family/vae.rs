//! VAE, and LADS with a VAE: the plan is a vector, the mean of what the high level says or a draw from it.

use lads_image::records::{Event, NoiseRule};
use serde::Deserialize;

use super::{Blueprint, Call, Entry, Kind, Noise, instructed, lengths, one_noise};
use crate::contract::Contract;

/// Sizes of a plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Plan {
    /// Elements, `D`.
    pub dim: usize,
}

/// Which plan is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VaeRule {
    /// The mean.
    Mean,
    /// A draw.
    Sample,
}

/// The decision rule and its seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct VaeDecision {
    /// Which plan is taken.
    pub rule: VaeRule,
    /// Seed of the draws.
    #[serde(default)]
    pub seed: u64,
}

/// The fields of the family.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Vae {
    /// Control steps from one plan to the next, `H`.
    pub horizon: usize,
    /// Sizes of a plan.
    pub plan: Plan,
    /// Which plan is taken.
    pub decision: VaeDecision,
}

impl Kind for Vae {
    fn period(&self) -> Option<usize> {
        Some(self.horizon)
    }

    fn noise(&self) -> Noise {
        Noise {
            rule: match self.decision.rule {
                VaeRule::Mean => NoiseRule::Zero,
                VaeRule::Sample => NoiseRule::Seeded,
            },
            seed: self.decision.seed,
        }
    }

    fn check(&self, contract: &Contract) -> Result<(), String> {
        lengths([("horizon", self.horizon), ("plan.dim", self.plan.dim)])?;
        one_noise(contract)?;
        instructed(contract)
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (start, step, record) = ("high_level/start", "high_level/step", "high_level/record");
        let plan = ["plan_mean", "plan_log_std"];
        Blueprint::default()
            .kv("context", contract.network)
            .plain("plan")
            .wide(self.plan.dim, "family.plan.dim")
            .handed("plan_mean")
            .handed("plan_log_std")
            .entry(Entry::new(start, &plan).cache("context").acts())
            .entry(Entry::new(step, &plan).cache("context").acts())
            .entry(Entry::variant(record, step, &[]).cache("context").acts())
            .entry(Entry::new("plan/sample", &["plan"]).acts())
            .entry(Entry::new("low_level/act", &["action"]).acts())
            .entry(
                Entry::new("high_level/instruct", &[])
                    .cache("context")
                    .acts(),
            )
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(Call::step(start).first())
            .call(Call::step(step).every(self.horizon).otherwise())
            .call(Call::step(record).otherwise())
            .call(Call::step("plan/sample").every(self.horizon))
            .call(Call::step("low_level/act"))
    }
}
