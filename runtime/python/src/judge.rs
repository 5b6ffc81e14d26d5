//! Verdict of a verification: rollouts made in Python, judged by lads-proof.
//!
//! Reference and run have the form of a reference's file. The compiled policy answers the
//! reference's questions here, on a fresh controller. What can fail: rollouts that contradict each
//! other, an instruction that the policy does not know.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use askama::Template as _;
use lads_core::{Channel, ChannelId, Contract, DType, Data, Decision};
use lads_proof::answers::{Answer, Replay, Reply};
use lads_proof::certificate::{Certificate, ReferenceUsed, Setting};
use lads_proof::contract::Compared;
use lads_proof::episode::{Completion, Episode};
use lads_proof::numbering::Numbering;
use lads_proof::page::Page;
use lads_proof::pairs::{Done, Episodes, Paired, Traced};
use lads_proof::physics::Physics;
use lads_proof::reference::{Reference, Trace};
use lads_proof::rounding::Asked;
use pyo3::prelude::*;
use serde::Deserialize;
use serde_json::Value;

use crate::arrays;
use crate::cell::{Checked, Working};
use crate::controller::Controller;
use crate::errors::{ProofError, instruction as refused_instruction};

/// Python's facts about a verification, besides the rollouts.
#[derive(Deserialize)]
struct About {
    /// Id of the environment.
    environment: String,
    /// Noise of the environment, in words.
    noise: String,
    versions: BTreeMap<String, String>,
    /// Names of the environment's sub-tasks.
    sub_tasks: Vec<String>,
    /// Indices of the sub-tasks that each instruction commands.
    commanded: Vec<Vec<usize>>,
    /// Fields of the policy's contract that are compared.
    contract: Value,
    /// Fields of the reference and the environment that are compared with the contract.
    stated: Value,
    not_covered: Vec<String>,
}

/// Judges a verification -> (verdict, certificate as JSON, certificate as HTML).
///
/// `reference` and `run` are rollouts in the form of a reference's file; `replayed` has (instruction, episode, states float64 [n, S], whether
/// the environment ended the episode) of the environment under the reference's actions; `about` is JSON.
#[pyfunction]
pub fn judge(
    py: Python<'_>,
    controller: &Controller,
    reference: Vec<u8>,
    run: Vec<u8>,
    replayed: Vec<(usize, usize, Bound<'_, PyAny>, bool)>,
    about: &str,
) -> PyResult<(&'static str, String, String)> {
    let broken = |error: &dyn std::fmt::Display| ProofError::new_err(error.to_string());
    let read = |bytes: &[u8], name: &str| {
        Reference::read(bytes, Path::new(name)).map_err(|error| broken(&error))
    };
    let (reference, run) = (read(&reference, "the reference")?, read(&run, "the run")?);
    let about: About = serde_json::from_str(about).map_err(|error| broken(&error))?;
    let rows = replayed
        .iter()
        .map(|(instruction, episode, states, ended)| {
            let (shape, states) = arrays::values::<f64>(states, "states", 2)?;
            Ok(Replayed {
                instruction: *instruction,
                episode: *episode,
                len: shape[1].max(1),
                states,
                ended: *ended,
            })
        });
    let physics = environment(&reference, &rows.collect::<PyResult<Vec<_>>>()?);
    let mut asked = controller.settings().working(controller.checked())?;
    let view = controller.checked().view();
    let contract = view.contract();
    let numbers = known(&reference, controller)?;
    let replays = py.detach(|| ask(&mut asked, contract, &reference, &numbers))?;
    let exact = exact(controller)?;
    let exact = exact.map(|checked| {
        let mut asked = controller.settings().working(&checked)?;
        py.detach(|| ask(&mut asked, contract, &reference, &numbers))
    });
    let exact = exact.transpose()?;
    let tolerance = view.golden().map(|golden| f64::from(golden.tolerance()));
    let (answers, numbering) = Asked::judge(&reference, &replays, exact.as_deref(), tolerance);
    let rollouts = pairs(&reference, &numbering, &run, &about, contract);
    let setting = Setting {
        environment: about.environment,
        bundle_sha256: contract.bundle_sha256().to_owned(),
        image_sha256: lads_compiler::sha256(view.image()),
        image_stored: lads_host::stored(view),
        decision: controller.rule(),
        isa: asked.with(|controller| controller.isa().name().to_owned()),
        seed: reference.seed,
        noise: about.noise,
        episodes_per_instruction: reference.episodes_per_instruction,
        instructions: reference.instructions.len(),
        versions: about.versions,
    };
    let used = ReferenceUsed {
        bundle_sha256: reference.bundle_sha256.clone(),
        same_bundle: false,
        weights_from: reference.weights_from.clone(),
        words_from: reference.words_from.clone(),
        logits_from: None,
        versions: reference.versions.clone(),
    };
    let remedy = "give control_period=, or an environment that has its dt";
    let compared = Compared::with_stated(&about.contract, &about.stated, remedy);
    let certificate = Certificate::new(
        setting,
        used,
        compared,
        answers,
        (physics, None),
        rollouts,
        about.not_covered,
    );
    let json = serde_json::to_string_pretty(&certificate).map_err(|error| broken(&error))?;
    let page = Page::new(&certificate)
        .render()
        .map_err(|error| broken(&error))?;
    Ok((certificate.verdict.word(), json, page))
}

/// Compiles the policy with 32 bits, if its image has fewer, selects the largest logit and was
/// compiled from a bundle that is at hand.
fn exact(controller: &Controller) -> PyResult<Option<Arc<Checked>>> {
    let (checked, settings) = (controller.checked(), controller.settings());
    let view = checked.view();
    let selects = view.index_count() > 0
        && settings.sample.is_none()
        && view.contract().decision() == Decision::Argmax;
    if !selects || lads_host::is_exact(view) {
        return Ok(None);
    }
    let Some(bundle) = checked.opened().bundle() else {
        return Err(ProofError::new_err(
            "the image has fewer bits than 32 and is judged beside its bundle with 32; open the bundle, which is compiled to the same image",
        ));
    };
    let broken =
        |error: &dyn std::fmt::Display| ProofError::new_err(format!("with 32 bits: {error}"));
    let image = lads_compiler::compile_with(bundle, &lads_compiler::Options::exact());
    let image = image.map_err(|error| broken(&error))?;
    let opened = lads_host::from_bytes(image.as_bytes()).map_err(|error| broken(&error))?;
    Ok(Some(Checked::of(opened)))
}

/// Returns the numbers of the reference's instructions; `None` for a policy that takes none.
fn known(reference: &Reference, controller: &Controller) -> PyResult<Vec<Option<u32>>> {
    let checked = controller.checked();
    let takes = checked.view().contract().instruction_channel().is_some();
    let number = |id: &str| {
        let found = checked.opened().instruction(id);
        found.map_err(|error| ProofError::new_err(error.to_string()))
    };
    let rows = reference.instructions.iter();
    rows.map(|row| takes.then(|| number(&row.id)).transpose())
        .collect()
}

/// An episode of the environment under the reference's actions.
struct Replayed {
    instruction: usize,
    episode: usize,
    /// Number of elements of a state.
    len: usize,
    states: Vec<f64>,
    /// True if the environment ended the episode by the last action.
    ended: bool,
}

/// Compares the environment alone: its states under the reference's actions.
fn environment(reference: &Reference, replayed: &[Replayed]) -> Physics {
    let mut physics = Physics::new();
    for Replayed {
        instruction,
        episode,
        len,
        states,
        ended,
    } in replayed
    {
        let row = reference.instructions.get(*instruction);
        let recorded = row.and_then(|row| Some((row, row.episodes.get(*episode)?)));
        let Some((row, Some(trace))) = recorded.map(|(row, it)| (row, it.trace.as_ref())) else {
            continue;
        };
        physics.episodes += 1;
        let both = states.chunks_exact(*len);
        let place = |step: usize, what: String| Answer {
            instruction: row.id.clone(),
            episode: *episode,
            step,
            what,
        };
        for (step, (ours, theirs)) in both.zip(trace.states.chunks_exact(*len)).enumerate() {
            physics.compare(ours, theirs, || place(step, String::new()));
        }
        let [ours, theirs] = [states.len(), trace.states.len()].map(|all| all / len);
        let otherwise = if ours != theirs {
            format!("the environment ended after {ours} states, the reference's after {theirs}")
        } else if !ended {
            format!("the environment continues after {ours} states, the reference's ended")
        } else {
            continue;
        };
        physics
            .first_difference
            .get_or_insert_with(|| place(ours, otherwise));
    }
    physics
}

/// Replays the policy alone: its answers to the reference's questions, with the reference's actions
/// executed.
fn ask(
    controller: &mut Working,
    contract: &Contract<'_>,
    reference: &Reference,
    numbers: &[Option<u32>],
) -> PyResult<Vec<Replay>> {
    let channels: Vec<_> = contract.observations().collect();
    let mut replays = vec![];
    for (index, (row, number)) in reference.instructions.iter().zip(numbers).enumerate() {
        for (episode, recorded) in row.episodes.iter().enumerate() {
            let Some(trace) = &recorded.trace else {
                continue;
            };
            let begun = controller.with(|controller| {
                if let Some(number) = number {
                    return controller.set_instruction(lads_core::Instruction::Id(*number));
                }
                controller.reset();
                Ok(())
            });
            begun.map_err(|error| refused_instruction(&error))?;
            // A reference that says nothing about indices is a black box: only its actions can be compared.
            let decides = !recorded.plans.is_empty();
            let mut replay = replay(controller, contract, &channels, trace, decides);
            (replay.instruction, replay.episode) = (index, episode);
            replays.push(replay);
        }
    }
    Ok(replays)
}

/// Replays one episode; a refusal ends it.
fn replay(
    controller: &mut Working,
    contract: &Contract<'_>,
    channels: &[Channel<'_>],
    trace: &Trace,
    decides: bool,
) -> Replay {
    let mut replay = Replay::default();
    let seen_len: usize = channels.iter().map(Channel::len).sum();
    let mut action = vec![0.0; contract.action_len()];
    let observations = trace.observations.chunks_exact(seen_len);
    for (seen, done) in observations.zip(trace.actions.chunks_exact(action.len())) {
        let given = Given::split(channels, seen);
        let inputs = given.inputs();
        let answered = controller.with(|controller| {
            let report = controller.step_with(&inputs, &mut action)?;
            let selected = report.selected.filter(|_| decides);
            let decided = selected.is_some_and(|selected| selected.fresh);
            let scores = if decided { controller.scores() } else { &[] };
            let reply = Reply {
                decided,
                plan: selected.map(|selected| selected.index),
                logits: scores.to_vec(),
                plan_vector: Vec::new(),
                action: action.clone(),
                margin: selected
                    .map(|selected| selected.margin)
                    .filter(|margin| decided && margin.is_finite()),
            };
            controller.executed(done)?;
            Ok(reply)
        });
        match answered {
            Ok(reply) => replay.replies.push(reply),
            Err(error) => {
                let error: lads_core::StepError = error;
                let why = match &error {
                    lads_core::StepError::Input(error) => lads_host::refused(error, contract),
                    other => other.to_string(),
                };
                replay.refused = Some(format!("the policy refuses: {why}"));
                break;
            }
        }
    }
    replay
}

/// Values of all channels, which a trace holds as one row of floats.
struct Given<'t> {
    parts: Vec<(ChannelId, &'t [f32], Part)>,
}

enum Part {
    F32,
    U8(Vec<u8>),
    I32(Vec<i32>),
}

impl<'t> Given<'t> {
    fn split(channels: &[Channel<'_>], seen: &'t [f32]) -> Self {
        let mut rest = seen;
        let parts = channels.iter().map(|channel| {
            let (own, behind) = rest.split_at(channel.len());
            rest = behind;
            let part = match channel.dtype() {
                DType::F32 => Part::F32,
                DType::U8 => Part::U8(own.iter().map(|&value| value as u8).collect()),
                DType::I32 => Part::I32(own.iter().map(|&value| value as i32).collect()),
            };
            (channel.id(), own, part)
        });
        Self {
            parts: parts.collect(),
        }
    }

    fn inputs(&self) -> Vec<(ChannelId, Data<'_>)> {
        let parts = self.parts.iter();
        parts
            .map(|(id, floats, part)| {
                let data = match part {
                    Part::F32 => Data::F32(floats),
                    Part::U8(values) => Data::U8(values),
                    Part::I32(values) => Data::I32(values),
                };
                (*id, data)
            })
            .collect()
    }
}

/// Pairs the run's episodes with the reference's.
fn pairs(
    reference: &Reference,
    numbering: &Numbering,
    run: &Reference,
    about: &About,
    contract: &Contract<'_>,
) -> Paired {
    let sub_tasks: Vec<_> = about.sub_tasks.iter().map(String::as_str).collect();
    let ours: Vec<Vec<Episode>> = run
        .instructions
        .iter()
        .map(|row| {
            let episodes = row.episodes.iter();
            episodes
                .map(|episode| Episode {
                    steps: episode.steps,
                    success: episode.success,
                    completions: episode
                        .completions
                        .iter()
                        .filter_map(|done| {
                            let sub_task = sub_tasks.iter().position(|it| *it == done.sub_task)?;
                            Some(Completion {
                                sub_task,
                                step: done.step,
                            })
                        })
                        .collect(),
                    plans: episode.plans.clone(),
                    final_state: episode.final_state.clone(),
                })
                .collect()
        })
        .collect();
    let lens = [
        contract.observations().map(|channel| channel.len()).sum(),
        contract.action_len(),
    ];
    let episodes = ours.iter().zip(&about.commanded).enumerate();
    let episodes = episodes.map(|(instruction, (episodes, commanded))| Episodes {
        instruction,
        commanded,
        episodes,
    });
    let traces = run
        .instructions
        .iter()
        .enumerate()
        .flat_map(|(instruction, row)| {
            let traced = row.episodes.iter().enumerate();
            traced.filter_map(move |(episode, recorded)| {
                let trace = recorded.trace.as_ref()?;
                let seen = trace.observations.chunks_exact(lens[0]);
                Some(Traced {
                    instruction,
                    episode,
                    steps: seen
                        .zip(trace.actions.chunks_exact(lens[1]))
                        .map(|(observation, action)| Done {
                            observation,
                            shown: None,
                            action,
                        })
                        .collect(),
                })
            })
        });
    Paired::new((reference, numbering), &sub_tasks, episodes, traces, lens)
}
