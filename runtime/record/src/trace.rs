//! Trace of an episode, control step by control step: enough to repeat its computation, to draw it
//! and to film it.
//!
//! A trace is kept in memory while episodes run and written afterwards, so that recording cannot slow the control loop down by waiting for
//! a disk, and an interrupted run leaves nothing half-written. It costs some 0.3 kB per control step, and what its pictures take.

use lads_proof::episode::Episode;
use lads_proof::frames::Digest;

/// Record of one control step. Lengths and units are those of the contract.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// Observation that the controller got, after all faults.
    pub observation: Vec<f32>,
    /// Action of the controller.
    pub action: Vec<f32>,
    /// Action that the environment was given; equal to `action` without faults.
    pub executed: Vec<f32>,
    /// Plan in force; `None` for a policy that selects none.
    pub plan: Option<u32>,
    /// True if this step decided the plan.
    pub decided: bool,
    /// The largest score of the last decision minus the second largest; `None` if no scores were
    /// computed or there is only one.
    pub margin: Option<f32>,
    /// Scores, one per plan, of a step that decided; empty otherwise.
    pub scores: Vec<f32>,
    /// Time inside the controller, in nanoseconds.
    pub controller_ns: u64,
    /// Position of the gripper when the observation was taken, in metres, if the environment has
    /// one.
    pub gripper: Option<[f64; 3]>,
    /// Digest of what the cameras showed; `None` of a policy without, and in a log.
    pub shown: Option<Digest>,
    /// What each camera showed, where pictures are kept.
    pub pictures: Vec<Picture>,
}

/// Frame of a camera, as it was given to the controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Name of the contract's channel.
    pub channel: String,
    /// The frame as a PNG file of 8 bits per sample: no pixel is lost.
    pub png: Vec<u8>,
}

/// Trace of an episode, with the seeds that reproduce it.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// Index of the instruction in the policy's table.
    pub instruction: u32,
    /// Number of the episode among those of the instruction.
    pub episode: u32,
    /// Seed of plan sampling; `None` if the likeliest plan is taken.
    pub sampling_seed: Option<u64>,
    /// Seed of the policy's other random draws; `None` if it drew nothing.
    pub noise_seed: Option<u64>,
    /// True if the plans were given from outside.
    pub commanded: bool,
    /// True if its random draws are the next of the streams of the episode before, which have the same seeds.
    pub continued: bool,
    /// Outcome of the episode.
    pub outcome: Episode,
    /// Control steps of the episode, in order.
    pub steps: Vec<Step>,
}
