//! Checks the golden steps: the recording and the compiled policy have to agree with the graph.
//!
//! What can fail: an action is not a number, or further from the graph's than the tolerance; the
//! error names it and its step.

use lads_compiler::{Bundle, CompileError, Reference};
use lads_core::{ChannelId, Data};

use crate::ImportError;
use crate::golden::{self, Episode};
use crate::plan::Plan;
use crate::problem::Problems;

/// Default tolerance, as a share of how far an action moves.
const SHARE: f64 = 1e-3;

/// Smallest tolerance, as a share of an action's size: some roundings to 32 bits.
const LEAST: f64 = 1e-6;

/// Golden steps, and the largest difference of an action that counts as equal.
pub(crate) struct Steps {
    pub episode: Episode,
    pub tolerance: f64,
}

/// Returns recorded steps, which have to agree with the graph, or made-up ones.
pub(crate) fn steps(
    reference: &mut Reference,
    plan: &Plan,
    recording: Option<Episode>,
    problems: &mut Problems,
) -> Result<Steps, CompileError> {
    let recorded = recording.is_some();
    let mut episode = recording.unwrap_or_else(|| golden::made_up(plan));
    let computed = golden::computed(reference, &episode)?;
    for (step, action) in computed.iter().enumerate() {
        if let Some(i) = action.iter().position(|value| !value.is_finite()) {
            problems.add(
                format!("action `{}`", plan.action.elements[i].name),
                format!("is not a number in step {step} of observations inside their limits"),
            );
            break;
        }
    }
    let tolerance = plan.tolerance.unwrap_or_else(|| tolerance(&computed));
    if recorded {
        let what = "the recording";
        differences(&computed, &episode.actions, plan, tolerance, what, problems);
    } else {
        episode.actions = computed;
    }
    Ok(Steps { episode, tolerance })
}

/// Returns the default tolerance: a share of how far the element that moves farthest moves.
fn tolerance(actions: &[Vec<f64>]) -> f64 {
    let width = actions.first().map_or(0, Vec::len);
    let wanted = (0..width).map(|i| {
        let values = actions.iter().map(|action| action[i]);
        let low = values.clone().fold(f64::INFINITY, f64::min);
        let high = values.fold(f64::NEG_INFINITY, f64::max);
        (SHARE * (high - low)).max(LEAST * low.abs().max(high.abs()))
    });
    wanted.fold(LEAST, f64::max)
}

/// Runs the compiled policy over the episode and returns how far its actions are from the graph's.
pub(crate) fn compared(
    bundle: &[u8],
    plan: &Plan,
    Steps { episode, tolerance }: &Steps,
    problems: &mut Problems,
) -> Result<f64, ImportError> {
    let unloaded = |error: &dyn std::fmt::Display| CompileError::Entry {
        entry: "policy/act".into(),
        problem: error.to_string().into(),
    };
    let image = lads_compiler::compile(&Bundle::from_bytes(bundle)?)?;
    let opened = lads_host::from_bytes(image.as_bytes()).map_err(|error| unloaded(&error))?;
    let mut loaded = opened.load().map_err(|error| unloaded(&error))?;
    let mut controller = loaded.controller();
    let mut actions = vec![];
    for step in 0..episode.len() {
        if episode.begins[step] {
            controller.reset();
        }
        let values: Vec<Vec<f32>> = episode
            .observed(step)
            .iter()
            .map(|row| row.iter().map(|&value| value as f32).collect())
            .collect();
        let given: Vec<(ChannelId, Data)> = controller
            .policy()
            .contract()
            .observations()
            .map(|channel| channel.id())
            .zip(values.iter().map(|row| Data::F32(row)))
            .collect();
        let mut action = vec![0.0; plan.action.elements.len()];
        controller
            .step_with(&given, &mut action)
            .map_err(|error| unloaded(&error))?;
        actions.push(action.into_iter().map(f64::from).collect());
    }
    let what = "the compiled policy";
    let graph = &episode.actions;
    Ok(differences(
        graph, &actions, plan, *tolerance, what, problems,
    ))
}

/// Returns the largest difference; the first one beyond the tolerance is added to the problems.
fn differences(
    graph: &[Vec<f64>],
    other: &[Vec<f64>],
    plan: &Plan,
    tolerance: f64,
    what: &str,
    problems: &mut Problems,
) -> f64 {
    let mut largest = 0.0_f64;
    for (step, (a, b)) in graph.iter().zip(other).enumerate() {
        for (i, (a, b)) in a.iter().zip(b).enumerate() {
            let difference = (a - b).abs();
            let close = difference <= tolerance;
            if !close && problems.is_empty() {
                problems.add(
                    format!("action `{}`", plan.action.elements[i].name),
                    format!(
                        "is {b} in step {step} of {what}, the graph gives {a}: more than the tolerance {tolerance:e} apart (`action.tolerance`)",
                    ),
                );
            }
            largest = largest.max(difference);
        }
    }
    largest
}
