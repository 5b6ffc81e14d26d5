//! Success rates and their intervals, computed by lads-proof.

use lads_proof::metrics::{self, Outcome, Score};
use pyo3::prelude::*;

use crate::errors::ProofError;

/// Computes the Wilson score interval at 95 % of `successes` out of `trials` -> (low, high).
#[pyfunction]
pub fn wilson(successes: usize, trials: usize) -> PyResult<(f64, f64)> {
    if successes > trials {
        return Err(ProofError::new_err(format!(
            "{successes} successes out of {trials} trials; give no more successes than trials"
        )));
    }
    let interval = metrics::wilson(successes, trials);
    Ok((interval.0, interval.1))
}

/// Computes the score of episodes, each as (commanded sub-tasks completed, success) -> JSON:
/// N-rate, K-rates, full success, their intervals. Other completed sub-tasks are not counted.
#[pyfunction]
pub fn score(outcomes: Vec<(usize, bool)>) -> PyResult<String> {
    let outcomes = outcomes.into_iter();
    let score = Score::of(outcomes.map(|(completed, success)| Outcome {
        completed,
        un_instructed: 0,
        success,
    }));
    let mut score =
        serde_json::to_value(&score).map_err(|error| ProofError::new_err(error.to_string()))?;
    // It was not measured, so 0 would be a claim.
    if let Some(fields) = score.as_object_mut() {
        fields.remove("un_instructed");
    }
    Ok(score.to_string())
}
