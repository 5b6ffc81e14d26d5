//! Writes episodes recorded in Python as an MCAP file, by lads-record.
//!
//! The file is written completely or not at all. What can fail: a policy whose observation is not
//! one vector of floats, arrays that contradict each other, the disk.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use lads_core::{Channel, DType};
use lads_proof::episode::{Completion, Episode};
use lads_record::trace::{Step, Trace};
use lads_record::{Flight, Log, Origin};
use pyo3::prelude::*;

use crate::arrays;
use crate::errors::RecordError;
use crate::policy::Policy;

/// One recorded episode; arrays have a row per control step.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Recorded<'py> {
    instruction: Option<String>,
    words: Option<Vec<f32>>,
    sample: Option<u64>,
    noise: Option<u64>,
    observations: Bound<'py, PyAny>,
    actions: Bound<'py, PyAny>,
    executed: Bound<'py, PyAny>,
    plans: Vec<Option<u32>>,
    decided: Vec<bool>,
    margins: Vec<Option<f32>>,
    scores: Vec<Vec<f32>>,
    controller_ns: Vec<u64>,
    success: bool,
    completions: Vec<(String, usize)>,
}

/// Refuses, before the first step, everything that [`write_log`] would refuse after the last: a
/// policy whose observation is not one vector of floats, a path that cannot be written.
#[pyfunction]
pub fn check_log(
    policy: &Policy,
    path: PathBuf,
    seed: u64,
    noise: String,
    notes: BTreeMap<String, String>,
) -> PyResult<()> {
    origin(policy, seed, noise, notes)?;
    lads_host::output::check(
        &[("the policy", Path::new(&policy.path()))],
        &[("log", &path)],
    )
    .map_err(|error| RecordError::new_err(error.to_string()))
}

/// Returns the origin of a log of a policy that observes one vector of floats.
fn origin(
    policy: &Policy,
    seed: u64,
    noise: String,
    notes: BTreeMap<String, String>,
) -> PyResult<Origin> {
    let contract = policy.checked().view().contract();
    let channels: Vec<_> = contract.observations().collect();
    let [observation] = &channels[..] else {
        let names: Vec<_> = channels.iter().map(Channel::name).collect();
        return Err(RecordError::new_err(format!(
            "the policy observes `{}`; a recording holds one channel of floats",
            names.join("`, `")
        )));
    };
    if observation.dtype() != DType::F32 {
        return Err(RecordError::new_err(format!(
            "channel `{}` has no floats; a recording holds one channel of floats",
            observation.name()
        )));
    }
    Ok(Origin {
        seed,
        noise,
        notes,
        ..Origin::of(policy.checked().view())
    })
}

/// Writes episodes to an MCAP file. `noise` is the environment's, in words; `notes` are other
/// facts.
#[pyfunction]
pub fn write_log(
    py: Python<'_>,
    policy: &Policy,
    path: PathBuf,
    seed: u64,
    noise: String,
    notes: BTreeMap<String, String>,
    episodes: Vec<Recorded<'_>>,
) -> PyResult<()> {
    let origin = origin(policy, seed, noise, notes)?;
    let flights = episodes
        .into_iter()
        .enumerate()
        .map(|(number, episode)| flight(policy, number as u32, episode));
    let log = Log {
        origin,
        flights: flights.collect::<PyResult<_>>()?,
    };
    let written = py.detach(|| -> Result<(), String> {
        let mut draft = lads_host::output::draft(&path).map_err(|error| error.to_string())?;
        lads_record::write(&log, &mut draft).map_err(|error| error.to_string())?;
        draft.commit().map_err(|error| error.to_string())
    });
    written.map_err(|error| {
        RecordError::new_err(format!(
            "{}: it cannot be written ({error}); name a file in an existing, writable folder",
            path.display()
        ))
    })
}

fn flight(policy: &Policy, number: u32, episode: Recorded<'_>) -> PyResult<Flight> {
    let contract = policy.checked().view().contract();
    let rows = |array: &Bound<'_, PyAny>, name, width: usize| {
        let (shape, values) = arrays::values::<f32>(array, name, 2)?;
        if shape[1] != width || shape[0] != episode.plans.len() {
            return Err(RecordError::new_err(format!(
                "episode {number}: `{name}` has {} rows of {} elements; give {} of {width}",
                shape[0],
                shape[1],
                episode.plans.len()
            )));
        }
        let rows: Vec<_> = values.chunks_exact(width).map(<[f32]>::to_vec).collect();
        Ok(rows)
    };
    let observations = rows(
        &episode.observations,
        "observations",
        contract.observation_len(),
    )?;
    let actions = rows(&episode.actions, "actions", contract.action_len())?;
    let executed = rows(&episode.executed, "executed", contract.action_len())?;
    let steps = episode.plans.len();
    let lens = [
        episode.decided.len(),
        episode.margins.len(),
        episode.scores.len(),
        episode.controller_ns.len(),
    ];
    if lens.iter().any(|&len| len != steps) {
        return Err(RecordError::new_err(format!(
            "episode {number}: it has {steps} plans and {lens:?} decisions, margins, scores and times; give as many"
        )));
    }
    let id = episode.instruction.unwrap_or_default();
    let found = (0..)
        .zip(contract.instructions())
        .find(|(_, known)| known.id == id);
    let (index, text) = found.map_or((0, String::new()), |(index, known)| {
        (index, known.text.to_owned())
    });
    let decisions = episode.plans.iter().zip(&episode.decided);
    let plans = decisions.filter_map(|(&plan, &decided)| plan.filter(|_| decided));
    let completions = (0..).zip(&episode.completions);
    let outcome = Episode {
        steps,
        success: episode.success,
        completions: completions
            .map(|(sub_task, &(_, step))| Completion { sub_task, step })
            .collect(),
        plans: plans.collect(),
        final_state: vec![],
    };
    let all = observations.into_iter().zip(actions).zip(executed);
    let steps = all
        .enumerate()
        .map(|(i, ((observation, action), executed))| Step {
            observation,
            action,
            executed,
            plan: episode.plans[i],
            decided: episode.decided[i],
            // JSON has no infinity.
            margin: episode.margins[i].filter(|margin| margin.is_finite()),
            scores: episode.scores[i].clone(),
            controller_ns: episode.controller_ns[i],
            gripper: None,
            shown: None,
            pictures: vec![],
        });
    let steps = steps.collect();
    Ok(Flight {
        instruction_id: id,
        instruction_text: text,
        words: episode.words,
        completed: episode
            .completions
            .into_iter()
            .map(|(name, _)| name)
            .collect(),
        trace: Trace {
            instruction: index,
            episode: number,
            sampling_seed: episode.sample,
            noise_seed: episode.noise,
            commanded: false,
            continued: false,
            outcome,
            steps,
        },
    })
}
