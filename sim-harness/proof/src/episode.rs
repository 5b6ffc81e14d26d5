//! What happened in one episode, in numbers. Nothing here can fail.

/// A sub-task that was completed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Completion {
    /// Index in the environment's list.
    pub sub_task: usize,
    /// The first control step after which it was done, counted from 1.
    pub step: usize,
}

/// What happened in one episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// Control steps executed.
    pub steps: usize,
    /// Whether the instruction was carried out, as the environment judges it.
    pub success: bool,
    /// Completed sub-tasks, in order of time.
    pub completions: Vec<Completion>,
    /// The indices that were selected, such as those of plans, in order; none of a policy that selects none.
    pub plans: Vec<u32>,
    /// Noise-free state after the last step.
    pub final_state: Vec<f64>,
}
