//! Outcome of one episode, in numbers. Nothing here can fail.

/// A sub-task that was completed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Completion {
    /// Index of the sub-task in the environment's list.
    pub sub_task: usize,
    /// First control step after which the sub-task was done, counted from 1.
    pub step: usize,
}

/// Outcome of one episode.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Episode {
    /// Control steps executed.
    pub steps: usize,
    /// Whether the instruction was carried out, as the environment judges it.
    pub success: bool,
    /// Completed sub-tasks, in order of time.
    pub completions: Vec<Completion>,
    /// Selected indices, such as those of plans, in order; empty if the policy selects none.
    pub plans: Vec<u32>,
    /// Noise-free state after the last step.
    pub final_state: Vec<f64>,
}
