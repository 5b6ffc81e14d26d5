//! Reads an MCAP file back into episodes.

use std::collections::BTreeMap;
use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use mcap::Summary;
use mcap::read::{MessageStream, metadata};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use serde::de::DeserializeOwned;

use crate::schema::{
    ACTION, COMPLETION, EPISODE, GRIPPER, LOGITS, OBSERVATION, PLAN, TIMING, TOPICS,
};
use crate::trace::{Picture, Step, Trace};
use crate::{
    ActionMessage, CompletionMessage, EpisodeMessage, FORMAT_VERSION, Flight, GripperMessage,
    IMAGES, ImageMessage, Log, LogError, METADATA, Origin, PERIOD, PlanMessage, TimingMessage,
    Values,
};
use lads_proof::episode::{Completion, Episode};

/// Reads a log that [`crate::write`] wrote; messages of other topics are skipped.
pub fn read(path: &Path) -> Result<Log, LogError> {
    let bytes = lads_host::input::read(path)?;
    whole(&bytes)?;
    let (origin, episodes) = origin(&bytes)?;
    let mut flights = Vec::new();
    // How many steps each says it has: nothing, where it was recorded while it ran.
    let mut said = Vec::new();
    for message in MessageStream::new(&bytes)? {
        let message = message?;
        let topic = TOPICS
            .iter()
            .position(|known| known.name == message.channel.topic);
        if topic == Some(EPISODE) {
            let (flight, steps) = begun(self::message(EPISODE, &message.data)?)?;
            flights.push(flight);
            said.push(steps);
        } else if let Some(topic) = topic {
            take(topic, &message.data, &mut flights)?;
        } else if let Some(camera) = message.channel.topic.strip_prefix(IMAGES) {
            let picture = picture(camera, &message.data)?;
            last_step(&mut flights)?.pictures.push(picture);
        }
    }
    if flights.len() != episodes {
        let got = flights.len();
        return Err(foreign(format!("it has {got} of its {episodes} episodes")));
    }
    for (flight, said) in flights.iter_mut().zip(said) {
        flight.trace.outcome.steps = said.unwrap_or(flight.trace.steps.len());
        check(flight, &origin)?;
    }
    Ok(Log { origin, flights })
}

/// Checks all checksums: of chunks, of the data and of the summary.
fn whole(bytes: &[u8]) -> Result<(), LogError> {
    let options = LinearReaderOptions::default()
        .with_prevalidate_chunk_crcs(true)
        .with_validate_data_section_crc(true)
        .with_validate_summary_section_crc(true)
        // No record is longer than the file, whatever a damaged length says.
        .with_record_length_limit(bytes.len());
    let mut reader = LinearReader::new_with_options(options);
    let mut left = bytes;
    while let Some(event) = reader.next_event() {
        if let LinearReadEvent::ReadRequest(wanted) = event? {
            let (now, later) = left.split_at(wanted.min(left.len()));
            reader.insert(wanted)[..now.len()].copy_from_slice(now);
            reader.notify_read(now.len());
            left = later;
        }
    }
    Ok(())
}

fn foreign(what: impl Into<String>) -> LogError {
    LogError::Foreign(what.into())
}

/// Reads the origin, and the number of episodes that follow.
fn origin(bytes: &[u8]) -> Result<(Origin, usize), LogError> {
    // The summary stands at the end of the file: a file that is cut off has none.
    let summary = Summary::read(bytes)?.ok_or_else(|| foreign("it has no summary"))?;
    let index = summary
        .metadata_indexes
        .iter()
        .find(|index| index.name == METADATA)
        .ok_or_else(|| foreign(format!("it has no metadata called {METADATA}")))?;
    let end = index.offset.checked_add(index.length);
    if end.is_none_or(|end| end > bytes.len() as u64) {
        return Err(LogError::Mcap(mcap::McapError::BadIndex));
    }
    let entries = metadata(bytes, index)?.metadata;
    let text = |key: &str| {
        entries
            .get(key)
            .cloned()
            .ok_or_else(|| foreign(format!("its metadata lack {key}")))
    };
    let version: u32 = number(&entries, "format_version")?;
    if !(1..=FORMAT_VERSION).contains(&version) {
        return Err(foreign(format!(
            "its messages are of version {version}, known is {FORMAT_VERSION}"
        )));
    }
    let names = |key: &str| -> Result<Vec<String>, LogError> {
        let text = text(key)?;
        if version == 1 {
            return Ok(text.split_whitespace().map(str::to_owned).collect());
        }
        serde_json::from_str(&text).map_err(|error| foreign(format!("its {key}: {error}")))
    };
    let notes = entries.iter().filter_map(|(key, value)| {
        let key = key.strip_prefix("note.")?;
        Some((key.to_owned(), value.clone()))
    });
    let origin = Origin {
        bundle_sha256: text("bundle_sha256")?,
        environment: text("environment")?,
        environment_version: text("environment_version")?,
        seed: number(&entries, "seed")?,
        noise: text("noise")?,
        control_period_s: number(&entries, "control_period_s")?,
        period: period(&entries)?,
        observation_names: names("observation_names")?,
        action_names: names("action_names")?,
        notes: notes.collect(),
    };
    Ok((origin, number(&entries, "episodes")?))
}

/// Reads the period, which is left out for a policy that selects nothing.
fn period(entries: &BTreeMap<String, String>) -> Result<Option<usize>, LogError> {
    let given = entries.contains_key(PERIOD);
    given.then(|| number(entries, PERIOD)).transpose()
}

fn number<N: std::str::FromStr>(
    entries: &BTreeMap<String, String>,
    key: &str,
) -> Result<N, LogError> {
    let value = entries.get(key).and_then(|value| value.parse().ok());
    value.ok_or_else(|| foreign(format!("its metadata lack a sound {key}")))
}

fn take(topic: usize, data: &[u8], flights: &mut [Flight]) -> Result<(), LogError> {
    let flight = flights
        .last_mut()
        .ok_or_else(|| foreign("a message comes before the first episode"))?;
    if topic == OBSERVATION {
        flight.trace.steps.push(Step {
            observation: message::<Values>(topic, data)?.values,
            action: Vec::new(),
            executed: Vec::new(),
            plan: None,
            decided: false,
            margin: None,
            scores: Vec::new(),
            controller_ns: 0,
            gripper: None,
            shown: None,
            pictures: Vec::new(),
        });
        return Ok(());
    }
    let step = flight
        .trace
        .steps
        .last_mut()
        .ok_or_else(|| foreign("a message comes before the first observation"))?;
    match topic {
        ACTION => {
            let action: ActionMessage = message(topic, data)?;
            (step.action, step.executed) = (action.policy, action.executed);
        }
        PLAN => {
            let plan: PlanMessage = message(topic, data)?;
            (step.plan, step.decided, step.margin) = (plan.index, plan.decided, plan.margin);
            let decided = plan.index.filter(|_| plan.decided);
            flight.trace.outcome.plans.extend(decided);
        }
        LOGITS => step.scores = message::<Values>(topic, data)?.values,
        TIMING => step.controller_ns = message::<TimingMessage>(topic, data)?.controller_ns,
        GRIPPER => {
            let at: GripperMessage = message(topic, data)?;
            step.gripper = Some([at.x, at.y, at.z]);
        }
        COMPLETION => {
            let done: CompletionMessage = message(topic, data)?;
            flight.trace.outcome.completions.push(Completion {
                sub_task: flight.completed.len(),
                step: done.step,
            });
            flight.completed.push(done.sub_task);
        }
        _ => {}
    }
    Ok(())
}

fn last_step(flights: &mut [Flight]) -> Result<&mut Step, LogError> {
    let flight = flights
        .last_mut()
        .ok_or_else(|| foreign("a message comes before the first episode"))?;
    let step = flight.trace.steps.last_mut();
    step.ok_or_else(|| foreign("a message comes before the first observation"))
}

fn picture(camera: &str, data: &[u8]) -> Result<Picture, LogError> {
    let wrong =
        |wrong: &dyn std::fmt::Display| foreign(format!("a message of {IMAGES}{camera}: {wrong}"));
    let message: ImageMessage = serde_json::from_slice(data).map_err(|error| wrong(&error))?;
    if message.format != "png" {
        return Err(wrong(&format_args!("its format is {}", message.format)));
    }
    let png = STANDARD
        .decode(message.data)
        .map_err(|error| wrong(&error))?;
    Ok(Picture {
        channel: camera.to_owned(),
        png,
    })
}

/// The episode that begins, and how many steps it says that it has.
fn begun(start: EpisodeMessage) -> Result<(Flight, Option<usize>), LogError> {
    let seed = |seed: Option<String>| {
        let seed = seed.as_deref().map(str::parse).transpose();
        seed.map_err(|_| foreign("a seed is not a number"))
    };
    let (sampling_seed, noise_seed) = (seed(start.sampling_seed)?, seed(start.noise_seed)?);
    let flight = Flight {
        instruction_id: start.instruction_id,
        instruction_text: start.instruction_text,
        words: start.words,
        completed: Vec::new(),
        trace: Trace {
            instruction: start.instruction,
            episode: start.episode,
            sampling_seed,
            noise_seed,
            commanded: start.commanded,
            continued: start.continued,
            outcome: Episode {
                steps: 0,
                success: start.success.unwrap_or(false),
                completions: Vec::new(),
                plans: Vec::new(),
                final_state: Vec::new(),
            },
            steps: Vec::new(),
        },
    };
    Ok((flight, start.steps))
}

fn message<M: DeserializeOwned>(topic: usize, data: &[u8]) -> Result<M, LogError> {
    serde_json::from_slice(data).map_err(|error| {
        let topic = TOPICS.get(topic).map_or("?", |known| known.name);
        foreign(format!("a message of {topic}: {error}"))
    })
}

/// Checks that all steps are present, with the lengths that the metadata state.
fn check(flight: &Flight, origin: &Origin) -> Result<(), LogError> {
    let trace = &flight.trace;
    let of = format!("{} episode {}", flight.instruction_id, trace.episode);
    if trace.steps.len() != trace.outcome.steps {
        let (got, said) = (trace.steps.len(), trace.outcome.steps);
        return Err(foreign(format!("{of} has {got} of its {said} steps")));
    }
    let wrong = trace.steps.iter().position(|step| {
        step.observation.len() != origin.observation_names.len()
            || step.action.len() != origin.action_names.len()
            || step.executed.len() != origin.action_names.len()
    });
    match wrong {
        Some(step) => Err(foreign(format!("{of}: step {step} has other lengths"))),
        None => Ok(()),
    }
}
