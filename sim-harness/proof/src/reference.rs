//! Reads and checks reference rollouts, which `lads_exporter reference` writes.
//!
//! Invariants of a [`Reference`] that was read: every instruction has the same number of episodes, numbered from 0, at least one of them
//! traced; every trace holds as many observations or frames, actions and states as its lengths say. What can fail: no such file, another format or
//! version of it, numbers that contradict each other. Whether it is of *this* policy and environment is [`Reference::check`]'s to say,
//! by name.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;
use thiserror::Error;

use super::purpose;
use crate::answers::CLOSE_CALL;

mod trace;

pub use trace::Trace;

/// Value of the JSON's `format`.
const FORMAT: &str = "lads-reference";
/// Versions of the JSON form that can be read. The first records neither contract nor logits, so that less can be proved by it.
const FORMAT_VERSIONS: [u32; 2] = [1, 2];

/// Largest float noise of a reference, relative to the largest of its own numbers that it moves.
const MOST_NOISE: f64 = 0.01;

/// Why a reference is refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReferenceError {
    /// The file cannot be read.
    #[error("{path}: cannot be read ({source}); name a reference, or make one", path = path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not a reference, or is damaged.
    #[error("{path}: {problem}; make it again", path = path.display())]
    Content {
        /// Path of the file.
        path: PathBuf,
        /// What is wrong with the content.
        problem: String,
    },
    /// The reference is of something else.
    #[error("{path}: the reference's {field} is {reference}, {whose} is {other}; use the reference that was made for this", path = path.display())]
    Other {
        /// Path of the file.
        path: PathBuf,
        /// Name of the field that differs.
        field: &'static str,
        /// The reference's value.
        reference: String,
        /// Owner of the value that the reference's is compared with.
        whose: &'static str,
        /// Value that the reference's is compared with.
        other: String,
    },
}

/// Results of the exporter's reference rollouts.
#[derive(Debug, Deserialize)]
pub struct Reference {
    format: String,
    format_version: u32,
    /// SHA-256 of the bundle whose weights were rolled out.
    pub bundle_sha256: String,
    purpose_sha256: String,
    environment: EnvironmentUsed,
    /// Seed of the whole run.
    pub seed: u64,
    /// Noise level, as the environment names it.
    pub noise: String,
    /// Control steps from one selection to the next; `None` of a policy that selects nothing.
    #[serde(rename = "horizon")]
    pub period: Option<usize>,
    /// Episodes of each instruction.
    pub episodes_per_instruction: u32,
    /// Number of episodes per instruction that have a trace.
    pub traced_episodes: u32,
    /// Where the reference's weights came from.
    pub weights_from: String,
    /// Where the reference's word embeddings came from.
    pub words_from: String,
    /// The contract that was rolled out; `None` in files of version 1.
    pub contract: Option<Value>,
    /// Where the weights behind the recorded logits came from, if they were added later.
    pub logits_from: Option<String>,
    /// Effect of float noise on the reference itself.
    pub float_noise: Option<FloatNoise>,
    /// Versions of everything that took part.
    pub versions: std::collections::BTreeMap<String, String>,
    /// Versions of what drew the frames, by name; none of a policy without cameras.
    #[serde(default)]
    pub renderer: std::collections::BTreeMap<String, String>,
    /// Instructions with their episodes, in the contract's order.
    pub instructions: Vec<Instruction>,
    #[serde(skip)]
    path: PathBuf,
}

#[derive(Debug, Deserialize)]
struct EnvironmentUsed {
    id: String,
    version: String,
}

/// Effect of small noise on all weights of the reference on its own answers to the traced questions: the largest differences.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
pub struct FloatNoise {
    /// Standard deviation of the noise, relative to each weight.
    pub relative: f64,
    /// Largest difference of an action element.
    pub action: f64,
    /// Largest difference of a logit, up to a constant.
    pub logit: f64,
    /// Largest difference of an element of a plan that is a vector; 0 of a policy whose plans are none.
    #[serde(default)]
    pub plan_vector: f64,
}

/// All episodes of one instruction.
#[derive(Debug, Deserialize)]
pub struct Instruction {
    /// Id in the contract.
    pub id: String,
    /// Text of the instruction.
    pub text: String,
    /// Episodes in order of their numbers.
    pub episodes: Vec<Episode>,
}

/// An episode of the reference.
#[derive(Debug, Deserialize)]
pub struct Episode {
    #[serde(rename = "episode")]
    number: u64,
    /// Control steps executed.
    pub steps: usize,
    /// Whether the instruction was carried out.
    pub success: bool,
    /// Completed sub-tasks, in order of time.
    pub completions: Vec<Completion>,
    /// Plan indices in the order in which they were decided.
    pub plans: Vec<u32>,
    /// Control steps at which the plans were decided; absent where they come once a period from the episode's start.
    pub decided_at: Option<Vec<usize>>,
    /// Lead of the largest logit over the second largest, for each decision.
    pub margins: Vec<f64>,
    /// Noise-free state after the last step.
    pub final_state: Vec<f64>,
    /// Seed of the noise that the policy drew; `None` of one that draws none.
    pub noise_seed: Option<u64>,
    /// Observations and actions step by step, in the first episodes of each instruction.
    pub trace: Option<Trace>,
}

impl Episode {
    /// Refuses numbers that no episode can have whose plans come once a `period`, where it does not say when.
    fn check(&self, period: Option<usize>) -> Result<(), &'static str> {
        // Counted, not listed: a damaged number of steps could be any.
        let decisions = match &self.decided_at {
            Some(decided) => decided.len(),
            None => period.map_or(0, |period| self.steps.div_ceil(period)),
        };
        let decided = self.decided_at.as_deref().unwrap_or_default();
        let in_order = decided.is_sorted_by(|a, b| a < b)
            && decided.last().is_none_or(|&last| last < self.steps);
        if !in_order || [self.plans.len(), self.margins.len()] != [decisions; 2] {
            return Err("its plans are not one per decision");
        }
        let mut times = self.completions.iter().map(|done| done.step);
        if !times.all(|step| (1..=self.steps).contains(&step)) {
            return Err("a completion is at no step of its episode");
        }
        if self.margins.iter().any(|&margin| margin < 0.0) {
            return Err("a margin is negative");
        }
        let Some(trace) = &self.trace else {
            return Ok(());
        };
        let lists: [&[f32]; 4] = [
            &trace.observations,
            &trace.actions,
            &trace.logits,
            &trace.plan_vectors,
        ];
        let states = self.final_state.iter().chain(&trace.states);
        let finite = lists.into_iter().flatten().all(|it| it.is_finite())
            && states.chain(&self.margins).all(|it| it.is_finite());
        if !finite {
            return Err("it holds a number that is not finite");
        }
        if !trace.logits.len().is_multiple_of(decisions.max(1)) {
            return Err("the logits of a trace are not the same number for each decision");
        }
        let of_each = trace
            .logits
            .chunks((trace.logits.len() / decisions.max(1)).max(1));
        let selects = |(logits, &plan): (&[f32], &u32)| {
            let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let lead = logits
                .get(plan as usize)
                .map(|&own| f64::from(largest - own));
            lead.is_none_or(|lead| lead <= CLOSE_CALL)
        };
        if !of_each.zip(&self.plans).all(selects) {
            return Err("a plan is not that of the largest logit");
        }
        let segments = period.map_or(0, |period| self.steps / period);
        let margins = trace.encoded_margins.as_ref().map(Vec::len);
        let counted = [trace.encoded.as_ref().map(Vec::len), margins];
        if counted.into_iter().flatten().any(|it| it != segments) {
            return Err("what its trajectory encoder sees is not one plan per whole segment");
        }
        Ok(())
    }
}

/// A completed sub-task.
#[derive(Debug, Deserialize)]
pub struct Completion {
    /// Name of the sub-task.
    pub sub_task: String,
    /// Control step, from 1, after which the sub-task was done.
    pub step: usize,
}

/// Description of the policy to verify, as far as its reference must agree with it.
#[derive(Debug, Clone)]
pub struct Subject<'s> {
    /// Contract as JSON, exactly as in the bundle.
    pub contract: &'s str,
    /// Texts of the contract's instructions.
    pub instructions: Vec<&'s str>,
    /// Id of the environment.
    pub environment_id: &'s str,
    /// Version of the environment.
    pub environment_version: &'s str,
    /// Number of elements of the environment's noise-free state.
    pub state_len: usize,
    /// Number of elements of the observed vector, beside cameras of the first ones of the state; 0 of a policy that sees by cameras alone.
    pub observation_len: usize,
    /// Whether the policy has cameras.
    pub sees: bool,
    /// Whether the policy draws noise from a seed.
    pub draws: bool,
    /// Number of elements of an action.
    pub action_len: usize,
}

impl Reference {
    /// Reads and checks a reference file.
    pub fn open(path: &Path) -> Result<Self, ReferenceError> {
        let bytes = lads_host::input::read(path).map_err(|source| ReferenceError::File {
            path: path.into(),
            source,
        })?;
        Self::read(&bytes, path)
    }

    /// Reads and checks the bytes of a reference file; `path` names it in errors.
    pub fn read(bytes: &[u8], path: &Path) -> Result<Self, ReferenceError> {
        let content = |problem: String| ReferenceError::Content {
            path: path.into(),
            problem,
        };
        let mut read: Self = serde_json::from_slice(bytes)
            .map_err(|error| content(format!("not a reference of lads ({error})")))?;
        path.clone_into(&mut read.path);
        if read.format != FORMAT || !FORMAT_VERSIONS.contains(&read.format_version) {
            return Err(content(format!(
                "its format is {} {}, this program reads {FORMAT} 1 and 2",
                read.format, read.format_version
            )));
        }
        read.consistent().map_err(content)?;
        Ok(read)
    }

    fn consistent(&self) -> Result<(), String> {
        if self.instructions.is_empty() || self.period == Some(0) || self.traced_episodes == 0 {
            return Err(
                "it has no instruction, no traced episode or decisions every 0 steps".to_owned(),
            );
        }
        self.noise_is_little()?;
        let codes = self.codes();
        for instruction in &self.instructions {
            let wrong =
                |what: &'static str| Err(format!("instruction '{}': {what}", instruction.id));
            if instruction.episodes.len() != self.episodes_per_instruction as usize {
                return wrong("its number of episodes is not the heading's");
            }
            for (number, episode) in (0..).zip(&instruction.episodes) {
                let traced = number < u64::from(self.traced_episodes);
                if episode.number != number || episode.trace.is_some() != traced {
                    return wrong(
                        "its episodes are not in order, or not traced as the heading says",
                    );
                }
                episode.check(self.period).or_else(wrong)?;
                let encoded = episode.trace.iter().flat_map(|it| &it.encoded).flatten();
                let mut indices = episode.plans.iter().chain(encoded);
                if codes.is_some_and(|codes| indices.any(|&plan| plan as usize >= codes)) {
                    return wrong("an index of a plan has no logit");
                }
            }
        }
        Ok(())
    }

    /// Refuses float noise that would allow any answer.
    fn noise_is_little(&self) -> Result<(), String> {
        let noise = self.float_noise.unwrap_or_default();
        let moved = [noise.action, noise.logit, noise.plan_vector];
        let mut numbers = moved.iter().chain([&noise.relative]);
        if !numbers.all(|&it| it.is_finite() && it >= 0.0) {
            return Err("a number of its float noise is negative".to_owned());
        }
        let mut largest = [0.0_f64; 3];
        for (_, trace) in self.traces() {
            let lists = [&trace.actions, &trace.logits, &trace.plan_vectors];
            for (largest, list) in largest.iter_mut().zip(lists) {
                let all = list.iter().map(|&it| f64::from(it.abs()));
                *largest = all.fold(*largest, f64::max);
            }
        }
        let parts = ["actions", "logits", "plans"]
            .iter()
            .zip(moved)
            .zip(largest);
        for ((what, moved), largest) in parts {
            if largest > 0.0 && moved > MOST_NOISE * largest {
                return Err(format!(
                    "its float noise moves its own {what} by {moved:.1e}, and the largest is {largest:.1e}: it would allow any"
                ));
            }
        }
        Ok(())
    }

    /// Episodes that have a trace.
    fn traces(&self) -> impl Iterator<Item = (&Episode, &Trace)> {
        let episodes = self.instructions.iter().flat_map(|row| &row.episodes);
        episodes.filter_map(|episode| Some((episode, episode.trace.as_ref()?)))
    }

    /// Number of logits of a decision; `None` where none were recorded.
    fn codes(&self) -> Option<usize> {
        let mut decided = self.traces().filter(|(_, trace)| !trace.logits.is_empty());
        let (episode, trace) = decided.next()?;
        trace.logits.len().checked_div(episode.plans.len())
    }

    /// Control steps at which the plans of an episode were decided.
    pub fn decided_at(&self, episode: &Episode) -> Vec<usize> {
        let grid = || {
            let period = self.period.map(|period| period.max(1));
            period.map_or_else(Vec::new, |period| {
                (0..episode.steps).step_by(period).collect()
            })
        };
        episode.decided_at.clone().unwrap_or_else(grid)
    }

    /// Refuses a reference of another environment, of other instructions, or of a policy for something else than this bundle's. Where the
    /// reference records its contract, that is compared field by field by the certificate, and only what would leave nothing to
    /// compare is refused here.
    pub fn check(&self, subject: &Subject<'_>) -> Result<(), ReferenceError> {
        let same = |field, reference: &str, whose, other: &str| {
            if reference == other {
                return Ok(());
            }
            Err(ReferenceError::Other {
                path: self.path.clone(),
                field,
                reference: format!("'{reference}'"),
                whose,
                other: format!("'{other}'"),
            })
        };
        let used = &self.environment;
        same(
            "environment",
            &used.id,
            "the bundle's",
            subject.environment_id,
        )?;
        let version = subject.environment_version;
        same(
            "environment version",
            &used.version,
            "the simulator's",
            version,
        )?;
        let known = &subject.instructions;
        let texts = |list: Vec<&str>| list.join("; ");
        let ours = texts(
            self.instructions
                .iter()
                .map(|row| row.text.as_str())
                .collect(),
        );
        let theirs = texts(known.clone());
        if ours != theirs {
            let place = self.instructions.iter().zip(known);
            let differ = place.into_iter().find(|(a, b)| a.text != **b);
            let (a, b) = differ.map_or(
                (self.instructions.len().to_string(), known.len().to_string()),
                |(a, b)| (a.text.clone(), (*b).to_owned()),
            );
            same("instruction list", &a, "the bundle's", &b)?;
        }
        let (whose, contract) = match &self.contract {
            None => ("the bundle's", subject.contract.to_owned()),
            Some(recorded) => ("its own contract's", recorded.to_string()),
        };
        let purpose = purpose::sha256(&contract).unwrap_or_default();
        same("contract hash", &self.purpose_sha256, whose, &purpose)?;
        let content = |problem: &str| ReferenceError::Content {
            path: self.path.clone(),
            problem: problem.to_owned(),
        };
        for episode in self.instructions.iter().flat_map(|row| &row.episodes) {
            if episode.final_state.len() != subject.state_len {
                return Err(content(
                    "the length of a final state is not the environment's",
                ));
            }
            if episode.noise_seed.is_some() != subject.draws {
                return Err(content(if subject.draws {
                    "the policy draws noise, and its episodes do not say from which seed"
                } else {
                    "its episodes were drawn from seeds, and the policy draws no noise"
                }));
            }
            if let Some(trace) = &episode.trace {
                trace.check(episode.steps, subject).map_err(content)?;
            }
        }
        Ok(())
    }
}
