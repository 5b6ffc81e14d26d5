//! The certificate of a verification: what was compared, the results, and the verdict with its reasons. Its JSON form is documented in
//! certificate.schema.json.
//!
//! The rules, in this order:
//!
//! 1. **DIFFERENT** if the contract says otherwise than the reference's did, or the image otherwise than the bundle; if the policy answers the
//!    reference's questions otherwise (a logit or an action beyond its tolerance, another plan although the reference's margin is not a close call,
//!    decisions at other steps, another encoding of a trajectory); if an image with fewer bits than 32 is of a bundle that does so with 32, or is not
//!    the same policy as with 32 ([`rounding`](super::rounding): of its logits counts what they decide); if the reference's actions lead through other states; or if a test finds a paired
//!    difference larger than its margin (1 % over all of them together).
//! 2. **EQUIVALENT** if none of this holds, contract, actions, states and, where the reference decides, logits were compared at all, every frame of a policy with cameras is the reference's, and every paired difference is
//!    equivalent: two one-sided tests at 5 %, within 0.05 for rates and 0.1 for the N-rate. Of an image with fewer bits, at least 99 % of the decisions
//!    are clear; fewer are DIFFERENT only if a binomial test shows it (1 %).
//! 3. **INCONCLUSIVE** otherwise; then it says how many more episodes of each instruction would decide, at these rates. So it is where a frame
//!    is drawn otherwise than the reference's: the policy was not asked what the reference was ([`frames`](super::frames)).
//!
//! A difference that is significant (McNemar's test, 5 % over all rates together) and yet negligible is noted as such: with enough episodes
//! every difference is significant, and the margin says which ones matter. What was not looked at is listed.
//!
//! Paired differences are judged because run and reference are the same episodes; differences as of two independent samples stand beside
//! them, for comparisons with numbers from elsewhere.

use std::collections::BTreeMap;

use serde::Serialize;

use super::answers::Answers;
use super::contract::{Compared, FieldDifference};
use super::frames::Frames;
use super::pairs::Paired;
use super::physics::Physics;
use super::rounding::{Asked, Rounding};

/// Value of the JSON's `format`.
pub const FORMAT: &str = "lads-certificate";
/// Version of the JSON form; changes when a field changes its meaning or goes.
pub const FORMAT_VERSION: u32 = 3;

/// Chance of a false alarm of McNemar's tests, all together.
const SIGNIFICANCE: f64 = 0.05;
/// Chance of a false alarm of all tests of a difference beyond its margin, together.
pub(crate) const DIFFERENCE: f64 = 0.01;
/// Number of differing fields that are named before the rest is only counted.
const NAMED: usize = 5;

/// Verdict of a verification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum Verdict {
    /// The policy is the reference's, as far as it was compared.
    Equivalent,
    /// The policy is not the reference's.
    Different,
    /// The episodes were too few to tell.
    Inconclusive,
}

impl Verdict {
    /// Exit code of the program that reached this verdict.
    pub fn exit_code(self) -> u8 {
        match self {
            Self::Equivalent => 0,
            Self::Different => 1,
            Self::Inconclusive => 3,
        }
    }

    /// The verdict as a word in capitals.
    pub fn word(self) -> &'static str {
        match self {
            Self::Equivalent => "EQUIVALENT",
            Self::Different => "DIFFERENT",
            Self::Inconclusive => "INCONCLUSIVE",
        }
    }
}

/// Origin of the reference.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReferenceUsed {
    /// SHA-256 of the bundle whose weights the reference ran; empty where it is not known to be any bundle's.
    pub bundle_sha256: String,
    /// Whether the reference's bundle is the verified bundle.
    pub same_bundle: bool,
    /// Where the reference's weights came from.
    pub weights_from: String,
    /// Where the reference's word embeddings came from.
    pub words_from: String,
    /// Where the weights that made the recorded logits came from, if those were added later.
    pub logits_from: Option<String>,
    /// Versions of everything that took part.
    pub versions: BTreeMap<String, String>,
}

impl ReferenceUsed {
    /// Whether the reference's weights were read back from the bundle that is to be verified, instead of from where they were trained.
    fn circular(&self) -> bool {
        let from = |source: &str| source.contains("bundle");
        from(&self.weights_from) || self.logits_from.as_deref().is_some_and(from)
    }
}

/// Setting of the run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Setting {
    /// Id of the environment.
    pub environment: String,
    /// SHA-256 of the verified bundle.
    pub bundle_sha256: String,
    /// SHA-256 of the program image that ran, which may be put into the machine.
    pub image_sha256: String,
    /// Formats of the image's weights and caches.
    pub image_stored: String,
    /// Rule that decided plans, as in the contract.
    pub decision: String,
    /// Instruction set that the kernels ran on.
    pub isa: String,
    /// Seed of the whole run, the same as the reference's.
    pub seed: u64,
    /// Noise level, the same as the reference's.
    pub noise: String,
    /// Episodes of each instruction.
    pub episodes_per_instruction: u32,
    /// Number of instructions.
    pub instructions: usize,
    /// Versions of the software that ran.
    pub versions: BTreeMap<String, String>,
}

/// Certificate of a verification.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Certificate {
    /// [`FORMAT`].
    pub format: &'static str,
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// The verdict.
    pub verdict: Verdict,
    /// Reasons of the verdict, one sentence each.
    pub reasons: Vec<String>,
    /// Further episodes of each instruction that would decide, beyond those that were run; only where inconclusive, and only if any number
    /// would.
    pub more_episodes_per_instruction: Option<u32>,
    /// Setting of the run.
    pub setting: Setting,
    /// Origin of the reference.
    pub reference: ReferenceUsed,
    /// Notes beside the verdict, one sentence each.
    pub notes: Vec<String>,
    /// Limits of the certificate: what it says nothing about, one sentence each.
    pub not_covered: Vec<String>,
    /// Comparison of the contracts, field by field.
    pub contract: Compared,
    /// Open-loop comparison of the policy alone.
    pub policy: Answers,
    /// Open-loop comparison of the same policy with all numbers stored with 32 bits, if the image that ran has fewer and selects the largest logit.
    pub exact: Option<Answers>,
    /// Comparison of the image with the same bundle at 32 bits.
    pub rounding: Option<Rounding>,
    /// Open-loop comparison of the environment alone.
    pub environment: Physics,
    /// Comparison of what its cameras show; `None` of a policy without.
    pub frames: Option<Frames>,
    /// Closed-loop comparison of policy and environment together.
    pub rollouts: Paired,
}

impl Certificate {
    /// Judges the comparisons; `not_covered` lists what the caller knows that it did not look at.
    pub fn new(
        setting: Setting,
        reference: ReferenceUsed,
        contract: Compared,
        asked: Asked,
        (environment, frames): (Physics, Option<Frames>),
        rollouts: Paired,
        mut not_covered: Vec<String>,
    ) -> Self {
        let different = differences(&contract, &asked, &environment, &rollouts);
        let unclear = asked.undecided();
        let Asked {
            policy,
            exact,
            rounding,
        } = asked;
        let mut undecided = undecided(&rollouts);
        let uncompared = uncompared(&contract, &policy, &environment);
        not_covered.extend(unseen(&reference, &policy, rounding.as_ref()));
        let unlike = frames.as_ref().and_then(Frames::undecided);
        let more_would_help = uncompared.is_empty() && unclear.is_none() && unlike.is_none();
        undecided.extend(uncompared);
        undecided.extend(unlike.clone());
        undecided.extend(unclear);
        let (verdict, reasons) = if !different.is_empty() {
            (Verdict::Different, different)
        } else if undecided.is_empty() {
            (
                Verdict::Equivalent,
                vec![agreement(
                    &policy,
                    rounding.as_ref(),
                    (&environment, frames.as_ref()),
                    &rollouts,
                )],
            )
        } else {
            (Verdict::Inconclusive, undecided)
        };
        let more = (verdict == Verdict::Inconclusive && more_would_help)
            .then(|| more_episodes(&rollouts, setting.episodes_per_instruction))
            .flatten();
        let mut notes = notes(&reference, &contract, &policy, &rollouts);
        if verdict == Verdict::Different {
            // What is shown by other means stands, and this may be why.
            notes.extend(unlike);
        }
        Self {
            format: FORMAT,
            format_version: FORMAT_VERSION,
            verdict,
            reasons,
            more_episodes_per_instruction: more,
            setting,
            reference,
            notes,
            not_covered,
            contract,
            policy,
            exact,
            rounding,
            environment,
            frames,
            rollouts,
        }
    }
}

fn differences(
    contract: &Compared,
    asked: &Asked,
    environment: &Physics,
    rollouts: &Paired,
) -> Vec<String> {
    let mut reasons = Vec::new();
    let fields = [
        (
            "the contract differs from the reference's",
            &contract.differing,
        ),
        (
            "the image that ran differs from the bundle's contract",
            &contract.image_differing,
        ),
    ];
    for (what, differing) in fields
        .into_iter()
        .filter(|(_, differing)| !differing.is_empty())
    {
        reasons.push(format!("{what} in {}", list(differing)));
    }
    reasons.extend(asked.differences());
    if let Some(answer) = &environment.first_difference {
        reasons.push(format!(
            "the environment moves otherwise under the reference's actions, first in {answer}"
        ));
    }
    // Bonferroni's correction: all tests together have the level.
    let level = DIFFERENCE / (rollouts.rates.len() + 1) as f64;
    for rate in rollouts
        .rates
        .iter()
        .filter(|rate| rate.paired.beyond_margin(level))
    {
        let [run, reference] = rate.shares();
        reasons.push(format!(
            "{}: {run:.3} against {reference:.3}, beyond the margin",
            rate.name
        ));
    }
    let n_rate = &rollouts.n_rate;
    if n_rate.paired.beyond_margin(level) {
        reasons.push(format!(
            "N-rate: {:.3} against {:.3}, beyond the margin",
            n_rate.run, n_rate.reference
        ));
    }
    reasons
}

/// Lists the first fields that differ, and how many more there are.
fn list(differing: &[FieldDifference]) -> String {
    let named = differing.iter().take(NAMED);
    let named = named.map(|it| format!("{} ({}, the other {})", it.field, it.run, it.reference));
    let named = named.collect::<Vec<_>>().join(", ");
    match differing.len().saturating_sub(NAMED) {
        0 => named,
        more => format!("{named} and {more} more"),
    }
}

/// Lists the notes beside the verdict.
fn notes(
    reference: &ReferenceUsed,
    contract: &Compared,
    policy: &Answers,
    rollouts: &Paired,
) -> Vec<String> {
    let mut notes = Vec::new();
    if reference.circular() {
        notes.push(format!(
            "the reference's weights come from {}{}: a fault in how they got into the bundle would be in both; a reference from the run's checkpoint proves \
             that too",
            reference.weights_from,
            reference.logits_from.as_ref().map_or(String::new(), |from| format!(", its logits' from {from}"))
        ));
    }
    if !contract.history.is_empty() {
        notes.push(format!(
            "not judged, because it says only where the policy is from: {}",
            list(&contract.history)
        ));
    }
    if policy.renumbered {
        notes.push(
            "the plans are the reference's under other numbers, throughout: harmless".to_owned(),
        );
    }
    let level = SIGNIFICANCE / rollouts.rates.len().max(1) as f64;
    for rate in rollouts
        .rates
        .iter()
        .filter(|rate| rate.mcnemar_p < level && rate.paired.equivalent)
    {
        let [run, reference] = rate.shares();
        notes.push(format!(
            "{}: {run:.4} against {reference:.4} is significant (McNemar's p = {:.1e}) and negligible: inside the margin of {}",
            rate.name, rate.mcnemar_p, rate.paired.margin
        ));
    }
    notes
}

/// Lists the comparisons that had nothing to compare: silence is not agreement.
fn uncompared(contract: &Compared, policy: &Answers, environment: &Physics) -> Vec<String> {
    let counts = [
        ("action", policy.compared_steps, true),
        ("logit", policy.compared_decisions, policy.decisions > 0),
        (
            "plan",
            policy.compared_plan_vectors,
            policy.unrecorded_plan_vectors,
        ),
        ("state", environment.states, true),
    ];
    let none = counts
        .iter()
        .filter(|&&(_, compared, wanted)| wanted && compared == 0);
    let none = none.map(|(what, ..)| {
        format!("no {what} was compared: the reference's traces hold none that could be")
    });
    let unrecorded = contract.fields.is_empty().then(|| {
        let remedy = contract.remedy;
        format!("the contract was not compared: the reference records none; {remedy}")
    });
    none.chain(unrecorded).collect()
}

/// Lists what no verification looks at, and what this one could not.
fn unseen(reference: &ReferenceUsed, policy: &Answers, rounding: Option<&Rounding>) -> Vec<String> {
    let mut unseen = vec![
        "observations other than those of the reference's episodes".to_owned(),
        "what a machine adds around the policy: guard, fallback, sensors, actuators, timing"
            .to_owned(),
        "the golden episode and its tolerance: the self-test replays it before a policy runs"
            .to_owned(),
    ];
    if let Some(rounding) = rounding.filter(|it| it.decisions > 0) {
        unseen.push(format!(
            "what reads the logits for more than the largest, such as a draw or a monitor of margins: fewer bits move them by up to {:.1e}",
            rounding.largest_logit_difference
        ));
    }
    if policy.compared_segments == 0 {
        unseen.push("the trajectory encoder, which plans are read from executed motion with: the reference records no encodings, or there is none".to_owned());
    }
    if reference.circular() {
        unseen
            .push("export of the weights: the reference's were read back from a bundle".to_owned());
    }
    if reference.words_from.contains("bundle") {
        unseen.push("the word embeddings: the reference's were read from a bundle too".to_owned());
    }
    unseen
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
                "{name}: the difference is {:+.3} (90 % interval {:+.3} to {:+.3}), not shown to be inside ±{} (p = {:.3})",
                difference.estimate,
                difference.interval_90.0,
                difference.interval_90.1,
                difference.margin,
                difference.p_equivalence.unwrap_or(1.0)
            )
        })
        .collect()
}

fn agreement(
    policy: &Answers,
    rounding: Option<&Rounding>,
    (environment, frames): (&Physics, Option<&Frames>),
    rollouts: &Paired,
) -> String {
    let frames = frames.map_or(String::new(), |it| {
        format!(", the same bytes in {} frames", it.steps)
    });
    let physics = if environment.identical_bits {
        "the same bits".to_owned()
    } else {
        format!("within {:.1e}", environment.largest_state_difference)
    };
    let plans = match policy.compared_plan_vectors {
        0 => String::new(),
        steps => format!(
            ", plans within {:.1e} over {steps} steps",
            policy.largest_plan_difference
        ),
    };
    let clear = rounding
        .filter(|it| it.smallest_margin.is_some())
        .map_or(String::new(), |it| {
            format!(
                " ({:.1} % of them clear by {} times what fewer bits move a logit)",
                100.0 * it.clear_share,
                it.margin_factor
            )
        });
    format!(
        "logits within {:.1e} over {} decisions{clear}{plans}, actions within {:.1e} over {} steps, states {physics} over {} states{frames}, {:.1} % of {} episodes with identical completions",
        policy.largest_logit_difference,
        policy.compared_decisions,
        policy.largest_action_difference,
        policy.compared_steps,
        environment.states,
        100.0 * rollouts.identical_completions,
        rollouts.episodes
    )
}

/// Computes how many more episodes of each instruction would narrow every interval into its margin; `None` where some estimate leaves no
/// room.
fn more_episodes(rollouts: &Paired, episodes: u32) -> Option<u32> {
    let differences = rollouts.rates.iter().map(|rate| &rate.paired);
    let growth = differences
        .chain([&rollouts.n_rate.paired])
        .filter(|difference| !difference.equivalent)
        .map(|difference| difference.growth_needed)
        .try_fold(1.0_f64, |most, growth| Some(most.max(growth?)))?;
    let more = ((growth - 1.0) * f64::from(episodes)).ceil();
    Some((more as u32).max(1))
}

#[cfg(test)]
mod tests;
