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
    /// SHA-256 of the program image that ran: what may be put into the machine.
    pub image_sha256: String,
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
    use super::super::pairs::{N_RATE_MARGIN, NRatePair, RATE_MARGIN, RatePair};
    use super::super::policy::Answer;
    use super::super::statistics::{Counts, Pairs};
    use super::*;

    /// A verification of `n` episodes in which one sub-task was done in `both`, in the run only, and in the reference only.
    fn certificate(n: usize, both: usize, run_only: usize, reference_only: usize) -> Certificate {
        let policy = Answers {
            episodes: 2,
            compared_steps: 9,
            ..Answers::default()
        };
        let environment = Physics {
            states: 9,
            identical_bits: true,
            ..Physics::default()
        };
        judged(policy, environment, [n, both, run_only, reference_only])
    }

    fn judged(policy: Answers, environment: Physics, outcome: [usize; 4]) -> Certificate {
        let [n, both, run_only, reference_only] = outcome;
        let mut pairs = Pairs::default();
        let mut counts = Counts::default();
        for episode in 0..n {
            let run = episode < both + run_only;
            let reference = episode < both
                || (both + run_only..both + run_only + reference_only).contains(&episode);
            pairs.add(run, reference);
            counts.add(usize::from(run), usize::from(reference));
        }
        let [run, reference] = counts.means();
        let rollouts = Paired {
            episodes: n,
            identical_completions: 1.0 - (run_only + reference_only) as f64 / n as f64,
            identical_steps: 1.0,
            identical_plans: 1.0,
            same_final_state: 1.0,
            median_first_plan_difference: None,
            earliest_plan_difference: None,
            largest_action_difference: 0.0,
            agreeing_steps: [9, 9],
            n_rate: NRatePair {
                run,
                reference,
                paired: counts.paired(N_RATE_MARGIN),
                unpaired: counts.unpaired(N_RATE_MARGIN),
            },
            rates: vec![RatePair {
                name: "kettle".to_owned(),
                pairs,
                mcnemar_p: pairs.mcnemar(),
                paired: pairs.paired(RATE_MARGIN),
                unpaired: pairs.unpaired(RATE_MARGIN),
            }],
        };
        let setting = Setting {
            environment: "tiny-bench".to_owned(),
            bundle_sha256: String::new(),
            image_sha256: String::new(),
            isa: "portable".to_owned(),
            seed: 0,
            noise: "none".to_owned(),
            episodes_per_instruction: n as u32,
            instructions: 1,
            versions: BTreeMap::new(),
        };
        let used = ReferenceUsed {
            bundle_sha256: String::new(),
            same_bundle: true,
            weights_from: String::new(),
            words_from: String::new(),
            versions: BTreeMap::new(),
        };
        Certificate::new(setting, used, policy, environment, rollouts)
    }

    fn reason(certificate: &Certificate, part: &str) {
        let found = certificate
            .reasons
            .iter()
            .any(|reason| reason.contains(part));
        assert!(found, "'{part}' is not in {:?}", certificate.reasons);
    }

    #[test]
    fn enough_equal_episodes_are_equivalent() {
        let found = certificate(500, 400, 0, 0);
        assert_eq!(found.verdict, Verdict::Equivalent);
        assert_eq!(found.more_episodes_per_instruction, None);
        reason(&found, "100.0 % of 500 episodes");
        // A few that fell out otherwise, either way, do not matter.
        assert_eq!(certificate(500, 397, 2, 1).verdict, Verdict::Equivalent);
    }

    #[test]
    fn few_equal_episodes_decide_nothing_and_the_asked_number_does() {
        let found = certificate(20, 16, 0, 0);
        assert_eq!(found.verdict, Verdict::Inconclusive);
        reason(&found, "not inside");
        let more = found.more_episodes_per_instruction.unwrap() as usize;
        let enough = 20 + more;
        assert_eq!(
            certificate(enough, enough * 4 / 5, 0, 0).verdict,
            Verdict::Equivalent
        );
        assert!(more < 500, "{more}");
    }

    #[test]
    fn outcomes_that_change_one_way_are_different() {
        let found = certificate(500, 370, 0, 30);
        assert_eq!(found.verdict, Verdict::Different);
        reason(&found, "McNemar's p");
    }

    #[test]
    fn a_difference_beyond_the_margin_is_different() {
        let found = certificate(500, 200, 0, 200);
        assert_eq!(found.verdict, Verdict::Different);
        reason(&found, "N-rate: 0.400 against 0.800, beyond the margin");
    }

    #[test]
    fn equal_rates_do_not_excuse_a_policy_or_an_environment_that_differs() {
        let place = |what: &str| Answer {
            instruction: "a".to_owned(),
            episode: 0,
            step: 3,
            what: what.to_owned(),
        };
        let sound = certificate(500, 400, 0, 0);
        let policy = Answers {
            differing_episodes: 1,
            first_difference: Some(place("another plan")),
            ..sound.policy.clone()
        };
        let found = judged(policy, sound.environment.clone(), [500, 400, 0, 0]);
        assert_eq!(found.verdict, Verdict::Different);
        reason(&found, "instruction a, episode 0, step 3: another plan");
        let environment = Physics {
            first_difference: Some(place("another state")),
            ..sound.environment
        };
        let found = judged(sound.policy, environment, [500, 400, 0, 0]);
        assert_eq!(found.verdict, Verdict::Different);
        reason(&found, "another state");
    }

    #[test]
    fn nothing_compared_is_not_agreement() {
        let found = judged(Answers::default(), Physics::default(), [500, 400, 0, 0]);
        assert_eq!(found.verdict, Verdict::Inconclusive);
        assert_eq!(
            found.more_episodes_per_instruction, None,
            "more would not help"
        );
        reason(&found, "no action was compared");
        reason(&found, "no state was compared");
    }
}
