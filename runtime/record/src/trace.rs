//! What happened inside an episode, control step by control step: enough to compute it again, to draw it and to film it.
//!
//! A trace is kept in memory while episodes run and written afterwards, so that recording cannot slow the control loop down by waiting for
//! a disk, and an interrupted run leaves nothing half-written. It costs some 0.3 kB per control step.

use lads_proof::episode::Episode;

/// One control step. Lengths and units are the contract's.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// What the controller saw, after all faults.
    pub observation: Vec<f32>,
    /// What it answered.
    pub action: Vec<f32>,
    /// What the environment was given; the same without faults.
    pub executed: Vec<f32>,
    /// The plan in force; `None` of a policy that selects none.
    pub plan: Option<u32>,
    /// Whether this step decided it.
    pub decided: bool,
    /// The largest score of the last decision minus the second largest; `None` where no scores were computed or there is but one.
    pub margin: Option<f32>,
    /// The scores, one per plan, of a step that decided; empty otherwise.
    pub scores: Vec<f32>,
    /// Time inside the controller, in nanoseconds.
    pub controller_ns: u64,
    /// Where the gripper was when the observation was taken, in metres, if the environment has one.
    pub gripper: Option<[f64; 3]>,
}

/// An episode and how it can be had again.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// Index of the instruction in the policy's table.
    pub instruction: u32,
    /// Number of the episode among those of the instruction.
    pub episode: u32,
    /// Seed of plan sampling; `None` where the likeliest plan is taken.
    pub sampling_seed: Option<u64>,
    /// Seed of what else the policy drew at random; `None` where it drew nothing.
    pub noise_seed: Option<u64>,
    /// Whether the plans were given from outside.
    pub commanded: bool,
    /// What it came to.
    pub outcome: Episode,
    /// Its control steps in order.
    pub steps: Vec<Step>,
}
