//! Traces of a reference: what a policy saw and did, step by step, as little-endian numbers in base64.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;

use super::Subject;
use crate::frames::{DIGEST_LEN, Digest};

/// A traced episode, step by step.
#[derive(Debug, Deserialize)]
#[serde(try_from = "Written")]
pub struct Trace {
    /// Observed vectors, `[steps, O]`, of a policy with cameras those beside their frames; empty of one that sees by cameras alone.
    pub observations: Vec<f32>,
    /// Digest of what the cameras showed at each step; empty of a policy without.
    pub frames: Vec<Digest>,
    /// Actions of the policy, `[steps, A]`.
    pub actions: Vec<f32>,
    /// Noise-free states before the first steps' actions, `[n, S]`; of a policy with cameras, whose frames are drawn of them, all steps'.
    pub states: Vec<f64>,
    /// Logits of each decision, `[decisions, M]`; empty where none were recorded.
    pub logits: Vec<f32>,
    /// Plan in force at each step, `[steps, D]`, of a policy whose plans are vectors; empty of others.
    pub plan_vectors: Vec<f32>,
    /// Plan that the trajectory encoder sees in each full segment.
    pub encoded: Option<Vec<u32>>,
    /// Extra distance of the second nearest code in each segment, relative to the nearest's squared distance.
    pub encoded_margins: Option<Vec<f64>>,
}

#[derive(Deserialize)]
struct Written {
    observations: String,
    #[serde(default)]
    frames: String,
    actions: String,
    states: String,
    #[serde(default)]
    logits: String,
    #[serde(default)]
    plan_vectors: String,
    encoded: Option<Vec<u32>>,
    encoded_margins: Option<Vec<f64>>,
}

impl Trace {
    /// Returns the logits of one of `decisions` decisions; empty where none were recorded.
    pub fn logits_of(&self, number: usize, decisions: usize) -> &[f32] {
        let len = self.logits.len() / decisions.max(1);
        self.logits
            .get(number * len..(number + 1) * len)
            .unwrap_or_default()
    }

    /// Refuses other lengths than those of an episode of `steps` control steps.
    pub(super) fn check(&self, steps: usize, subject: &Subject<'_>) -> Result<(), &'static str> {
        if self.frames.is_empty() == (subject.sees && steps > 0) {
            return Err(if subject.sees {
                "its traces hold no frames, and the policy has cameras"
            } else {
                "its traces hold frames, and the policy has no camera"
            });
        }
        // Saturating: a damaged number of steps could be any.
        if self.observations.len() != steps.saturating_mul(subject.observation_len) {
            return Err(match (subject.observation_len, self.observations.len()) {
                (0, _) => "its traces hold observations, and the policy sees by cameras alone",
                (_, 0) => "its traces hold no observations, and the policy observes a vector",
                _ => "the observations of its traces are not one of the policy's for each step",
            });
        }
        let frames = if subject.sees { steps } else { 0 };
        let states = self.states.len() / subject.state_len.max(1);
        let fits = self.actions.len() == steps.saturating_mul(subject.action_len)
            && self.frames.len() == frames
            && self.states.len() == states * subject.state_len
            && self.plan_vectors.len().is_multiple_of(steps.max(1))
            && (states >= frames && (states == 0) == (steps == 0));
        let wrong = "the lengths of a trace are not those of the environment";
        fits.then_some(()).ok_or(wrong)
    }
}

impl TryFrom<Written> for Trace {
    type Error = String;

    fn try_from(written: Written) -> Result<Self, String> {
        Ok(Self {
            observations: numbers(&written.observations, f32::from_le_bytes)?,
            frames: numbers::<_, DIGEST_LEN>(&written.frames, |digest| digest)?,
            actions: numbers(&written.actions, f32::from_le_bytes)?,
            states: numbers(&written.states, f64::from_le_bytes)?,
            logits: numbers(&written.logits, f32::from_le_bytes)?,
            plan_vectors: numbers(&written.plan_vectors, f32::from_le_bytes)?,
            encoded: written.encoded,
            encoded_margins: written.encoded_margins,
        })
    }
}

/// Decodes little-endian numbers in base64.
fn numbers<T, const N: usize>(text: &str, read: fn([u8; N]) -> T) -> Result<Vec<T>, String> {
    let bytes = STANDARD.decode(text).map_err(|error| error.to_string())?;
    match bytes.as_chunks::<N>() {
        (whole, []) => Ok(whole.iter().map(|&chunk| read(chunk)).collect()),
        _ => Err(format!(
            "a trace of {} bytes is not a whole number of {N}-byte numbers",
            bytes.len()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A policy of a camera, whose frame has a digest, of `joints` and of one action; its environment's state is of two numbers.
    fn subject(joints: usize) -> Subject<'static> {
        Subject {
            contract: "",
            instructions: vec![],
            environment_id: "",
            environment_version: "",
            state_len: 2,
            observation_len: joints,
            sees: true,
            draws: false,
            action_len: 1,
        }
    }

    fn trace(observations: usize) -> Trace {
        Trace {
            observations: vec![0.0; observations],
            frames: vec![[0; DIGEST_LEN]; 3],
            actions: vec![0.0; 3],
            states: vec![0.0; 6],
            logits: vec![],
            plan_vectors: vec![],
            encoded: None,
            encoded_margins: None,
        }
    }

    #[test]
    fn a_camera_s_trace_has_an_observation_for_each_step_where_the_policy_observes_one() {
        for (joints, observations) in [(0, 0), (4, 12)] {
            assert_eq!(trace(observations).check(3, &subject(joints)), Ok(()));
        }
        for (joints, observations, wrong) in [
            (0, 12, "by cameras alone"),
            (4, 0, "hold no observations"),
            (4, 11, "not one of the policy's for each step"),
            (4, 16, "not one of the policy's for each step"),
        ] {
            let refused = trace(observations).check(3, &subject(joints));
            assert!(refused.unwrap_err().contains(wrong), "{observations}");
        }
        assert!(trace(12).check(usize::MAX, &subject(4)).is_err());
    }
}
