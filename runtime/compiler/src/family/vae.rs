//! VAE, and LADS with a VAE: the plan is a vector, the mean of the high level's distribution or a
//! draw from it.
//!
//! Where the contract says `features`, an encoder runs first in every step, and both levels read what it gives instead. Where it says
//! `history`, the low level attends to a window of earlier steps, as that of family `history` does.

use lads_image::records::{Event, NoiseRule};
use serde::Deserialize;

use super::recall::Recall;
use super::{Blueprint, Call, Entry, Kind, Noise, instructed, lengths, one_noise};
use crate::contract::{Contract, Faults};

/// Sizes of a plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Plan {
    /// Number of elements, `D`.
    pub dim: usize,
}

/// Rule by which a plan is taken from the distribution.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VaeRule {
    /// The mean of the distribution.
    Mean,
    /// A draw from the distribution.
    Sample,
}

/// The decision rule and its seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct VaeDecision {
    /// Rule by which a plan is taken.
    pub rule: VaeRule,
    /// Seed of the draws.
    #[serde(default)]
    pub seed: u64,
}

/// Every field of this family in a contract.
pub(crate) const EXAMPLE: &str = r#"{"kind": "vae", "horizon": 1, "plan": {"dim": 1}, "decision": {"rule": "mean", "seed": 0}, "features": 1,
    "history": {"window": 1, "memory": {"dim": 1}, "low_level": {"layers": 1, "heads": 1, "head_dim": 1}}}"#;

/// Contract fields of the VAE family.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Vae {
    /// Number of control steps from one plan to the next, `H`.
    pub horizon: usize,
    /// Sizes of a plan.
    pub plan: Plan,
    /// Rule by which a plan is taken.
    pub decision: VaeDecision,
    /// Elements of what an encoder makes of the observations, such as camera frames, once in a control step for all levels; without it
    /// they read the observations themselves.
    #[serde(default)]
    pub features: Option<usize>,
    /// Sizes of a low level that remembers; without it that is a function of observation and plan.
    #[serde(default)]
    pub history: Option<Recall>,
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

    fn check(&self, contract: &Contract, faults: &mut Faults) {
        lengths(
            [
                ("horizon", self.horizon),
                ("plan.dim", self.plan.dim),
                ("features", self.features.unwrap_or(1)),
            ],
            faults,
        );
        if let Some(recall) = self.history {
            recall.check("history.", faults);
        }
        one_noise(contract, faults);
        instructed(contract, faults);
    }

    fn blueprint(&self, contract: &Contract) -> Blueprint {
        let (start, step, record) = ("high_level/start", "high_level/step", "high_level/record");
        let plan = ["plan_mean", "plan_log_std"];
        let mut blueprint =
            Blueprint::observed(self.features, &[Event::Step]).kv("context", contract.network);
        if let Some(recall) = self.history {
            blueprint = recall.states(blueprint, "history.");
        }
        blueprint = blueprint
            .plain("plan")
            .wide(self.plan.dim, "family.plan.dim")
            .handed("plan_mean")
            .handed("plan_log_std")
            .entry(Entry::new(start, &plan).cache("context").acts())
            .entry(Entry::new(step, &plan).cache("context").acts())
            .entry(Entry::variant(record, step, &[]).cache("context").acts())
            .entry(Entry::new("plan/sample", &["plan"]).acts());
        blueprint = match self.history {
            Some(_) => Recall::entries(blueprint),
            None => blueprint.entry(Entry::new("low_level/act", &["action"]).acts()),
        };
        blueprint = blueprint
            .entry(
                Entry::new("high_level/instruct", &[])
                    .cache("context")
                    .acts(),
            )
            .call(Call::on(Event::Instruct, "high_level/instruct"))
            .call(Call::step(start).first())
            .call(Call::step(step).every(self.horizon).otherwise())
            .call(Call::step(record).otherwise())
            .call(Call::step("plan/sample").every(self.horizon));
        if self.history.is_none() {
            return blueprint.call(Call::step("low_level/act"));
        }
        blueprint = Recall::calls(blueprint, self.horizon);
        blueprint.period = self.horizon;
        blueprint
    }
}
