//! The certificate: what was compared, what came out, and the verdict with its reasons. Its JSON form is documented in
//! certificate.schema.json.
//!
//! The rules, in this order:
//!
//! 1. **DIFFERENT** if the policy answers the reference's questions otherwise (an action beyond the tolerance while the same plan
//!    is in force, another plan although the reference's margin is no close call, decisions at other steps), if the reference's actions lead
//!    through other states, if McNemar's test finds a sub-task's outcomes different (5 % over all of them together), or if the 95 % interval
//!    of a paired difference lies wholly beyond its margin.
//! 2. **EQUIVALENT** if none of this holds, actions and states were compared at all, and every paired difference is equivalent: two one-sided tests at 5 %, within 0.05 for rates and
//!    0.1 for the N-rate.
//! 3. **INCONCLUSIVE** otherwise; then it says how many more episodes of each instruction would decide, if it stays as it is.
//!
//! Paired differences are judged because run and reference are the same episodes; differences as of two independent samples stand beside
//! them, for comparisons with numbers from elsewhere.

use std::collections::BTreeMap;

use serde::Serialize;

use super::pairs::Paired;
use super::physics::Physics;
use super::policy::Answers;

/// Value of the JSON's `format`.
pub const FORMAT: &str = "lads-certificate";
/// Version of the JSON form; changes when a field changes its meaning or goes.
pub const FORMAT_VERSION: u32 = 1;

/// Chance of McNemar's tests together to call something different that is not.
const SIGNIFICANCE: f64 = 0.05;

/// What a verification says in a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum Verdict {
    /// The policy is the reference's, as far as it was looked.
    Equivalent,
    /// It is another.
    Different,
    /// The episodes were too few to tell.
    Inconclusive,
}

impl Verdict {
    /// Exit code of the program that found it.
    pub fn exit_code(self) -> u8 {
        match self {
            Self::Equivalent => 0,
            Self::Different => 1,
            Self::Inconclusive => 3,
        }
    }

    /// In capitals.
    pub fn word(self) -> &'static str {
        match self {
            Self::Equivalent => "EQUIVALENT",
            Self::Different => "DIFFERENT",
            Self::Inconclusive => "INCONCLUSIVE",
        }
    }
}

/// Where the reference came from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReferenceUsed {
    /// SHA-256 of the bundle whose weights it ran.
    pub bundle_sha256: String,
    /// Whether that is the verified bundle.
    pub same_bundle: bool,
    /// Where its weights came from.
    pub weights_from: String,
    /// Where its word embeddings came from.
    pub words_from: String,
    /// Versions of everything that took part.
    pub versions: BTreeMap<String, String>,
}

/// What was run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Setting {
    /// Id of the environment.
    pub environment: String,
    /// SHA-256 of the verified bundle.
    pub bundle_sha256: String,
    /// The instruction set that the kernels ran on.
    pub isa: String,
    /// Seed of the whole run, the reference's.
    pub seed: u64,
    /// Noise level, the reference's.
    pub noise: String,
    /// Episodes of each instruction.
    pub episodes_per_instruction: u32,
    /// Instructions.
    pub instructions: usize,
    /// Versions of what ran.
    pub versions: BTreeMap<&'static str, String>,
}

/// A whole verification.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Certificate {
    /// [`FORMAT`].
    pub format: &'static str,
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// The verdict.
    pub verdict: Verdict,
    /// Why, one sentence each.
    pub reasons: Vec<String>,
    /// Episodes of each instruction that would decide, beyond those that were run; only where inconclusive, and only if any number would.
    pub more_episodes_per_instruction: Option<u32>,
    /// What was run.
    pub setting: Setting,
    /// What it was compared with.
    pub reference: ReferenceUsed,
    /// Open loop, the policy alone.
    pub policy: Answers,
    /// Open loop, the environment alone.
    pub environment: Physics,
    /// Closed loop, both together.
    pub rollouts: Paired,
}

impl Certificate {
    /// Judges what was found.
    pub fn new(
        setting: Setting,
        reference: ReferenceUsed,
        policy: Answers,
        environment: Physics,
        rollouts: Paired,
    ) -> Self {
        let different = differences(&policy, &environment, &rollouts);
        let mut undecided = undecided(&rollouts);
        let uncompared = uncompared(&policy, &environment);
        let more_would_help = uncompared.is_empty();
        undecided.extend(uncompared);
        let (verdict, reasons) = if !different.is_empty() {
            (Verdict::Different, different)
        } else if undecided.is_empty() {
            (
                Verdict::Equivalent,
                vec![agreement(&policy, &environment, &rollouts)],
            )
        } else {
            (Verdict::Inconclusive, undecided)
        };
        let more = (verdict == Verdict::Inconclusive && more_would_help)
            .then(|| more_episodes(&rollouts, setting.episodes_per_instruction))
            .flatten();
        Self {
            format: FORMAT,
            format_version: FORMAT_VERSION,
            verdict,
            reasons,
            more_episodes_per_instruction: more,
            setting,
            reference,
            policy,
            environment,
            rollouts,
        }
    }
}

fn differences(policy: &Answers, environment: &Physics, rollouts: &Paired) -> Vec<String> {
    let mut reasons = Vec::new();
    if let Some(answer) = &policy.first_difference {
        reasons.push(format!(
            "the policy answers otherwise in {} of {} replayed episodes, first in {answer}",
            policy.differing_episodes, policy.episodes
        ));
    }
    if let Some(answer) = &environment.first_difference {
        reasons.push(format!(
            "the environment moves otherwise under the reference's actions, first in {answer}"
        ));
    }
    // Bonferroni's correction: all tests together have the significance.
    let level = SIGNIFICANCE / rollouts.rates.len().max(1) as f64;
    for rate in &rollouts.rates {
        let [run, reference] = rate.shares();
        if rate.mcnemar_p < level {
            reasons.push(format!(
                "{}: {run:.3} against {reference:.3}, McNemar's p = {:.2e} below {level:.4}",
                rate.name, rate.mcnemar_p
            ));
        } else if rate.paired.beyond_margin() {
            reasons.push(format!(
                "{}: {run:.3} against {reference:.3}, beyond the margin",
                rate.name
            ));
        }
    }
    if rollouts.n_rate.paired.beyond_margin() {
        let n_rate = &rollouts.n_rate;
        reasons.push(format!(
            "N-rate: {:.3} against {:.3}, beyond the margin",
            n_rate.run, n_rate.reference
        ));
    }
    reasons
}

/// What nothing was found about: silence is no agreement.
fn uncompared(policy: &Answers, environment: &Physics) -> Vec<String> {
    let counts = [
        ("action", policy.compared_steps),
        ("state", environment.states),
    ];
    let none = counts.iter().filter(|(_, compared)| *compared == 0);
    none.map(|(what, _)| format!("no {what} was compared: the traces hold none that could be"))
        .collect()
}

fn undecided(rollouts: &Paired) -> Vec<String> {
    let rates = rollouts
        .rates
        .iter()
        .map(|rate| (rate.name.as_str(), &rate.paired));
    rates
        .chain([("N-rate", &rollouts.n_rate.paired)])
        .filter(|(_, difference)| !difference.equivalent)
        .map(|(name, difference)| {
            format!(
                "{name}: the difference is {:+.3} with 90 % interval {:+.3} to {:+.3}, not inside ±{}",
                difference.estimate, difference.interval_90.0, difference.interval_90.1, difference.margin
            )
        })
        .collect()
}

fn agreement(policy: &Answers, environment: &Physics, rollouts: &Paired) -> String {
    let physics = if environment.identical_bits {
        "the same bits".to_owned()
    } else {
        format!("within {:.1e}", environment.largest_state_difference)
    };
    format!(
        "actions within {:.1e} over {} steps, states {physics} over {} states, {:.1} % of {} episodes with identical completions",
        policy.largest_action_difference,
        policy.compared_steps,
        environment.states,
        100.0 * rollouts.identical_completions,
        rollouts.episodes
    )
}

/// How many more episodes of each instruction narrow every interval into its margin; `None` where some estimate leaves no room.
fn more_episodes(rollouts: &Paired, episodes: u32) -> Option<u32> {
    let differences = rollouts.rates.iter().map(|rate| &rate.paired);
    let growth = differences
        .chain([&rollouts.n_rate.paired])
        .filter(|difference| !difference.equivalent)
        .map(super::statistics::Difference::growth_needed)
        .try_fold(1.0_f64, |most, growth| Some(most.max(growth?)))?;
    let more = ((growth - 1.0) * f64::from(episodes)).ceil();
    Some((more as u32).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_compared_is_not_agreement() {
        let (mut policy, mut environment) = (Answers::default(), Physics::default());
        assert_eq!(uncompared(&policy, &environment).len(), 2);
        policy.compared_steps = 1;
        let only = uncompared(&policy, &environment);
        assert!(only.len() == 1 && only[0].contains("no state"), "{only:?}");
        environment.states = 1;
        assert!(uncompared(&policy, &environment).is_empty());
    }
}
