//! Writes episodes to an MCAP file, all at once or while they run.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufWriter, Seek, Write};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use lads_proof::episode::Episode;
use mcap::records::{MessageHeader, Metadata};
use mcap::{WriteOptions, Writer};
use serde::Serialize;

use crate::schema::{
    ACTION, COMPLETION, EPISODE, GRIPPER, IMAGE, LOGITS, OBSERVATION, PLAN, TIMING, TOPICS,
    image_schema,
};
use crate::trace::{Picture, Step};
use crate::{
    ActionMessage, CompletionMessage, EpisodeMessage, FORMAT_VERSION, Flight, GripperMessage,
    IMAGES, ImageMessage, Log, METADATA, Origin, PERIOD, PlanMessage, Time, TimingMessage, Values,
};

/// Simulated time between two episodes, in nanoseconds, so that they stay apart on a time axis.
const PAUSE_NS: u64 = 1_000_000_000;

/// Writes a log; the file is complete once this returns without an error.
pub fn write<W: Write + Seek>(log: &Log, to: W) -> mcap::McapResult<()> {
    let steps = log.flights.iter().flat_map(|flight| &flight.trace.steps);
    let cameras = steps.flat_map(|step| &step.pictures);
    let cameras: BTreeSet<_> = cameras.map(|picture| picture.channel.as_str()).collect();
    let mut recorder = Recorder::new(to, &log.origin, cameras)?;
    log.flights
        .iter()
        .try_for_each(|flight| recorder.flight(flight))?;
    recorder.finish().map(drop)
}

fn metadata(origin: &Origin, episodes: usize) -> Metadata {
    let known = [
        ("format_version", FORMAT_VERSION.to_string()),
        ("episodes", episodes.to_string()),
        ("bundle_sha256", origin.bundle_sha256.clone()),
        ("environment", origin.environment.clone()),
        ("environment_version", origin.environment_version.clone()),
        ("seed", origin.seed.to_string()),
        ("noise", origin.noise.clone()),
        ("control_period_s", origin.control_period_s.to_string()),
        ("observation_names", listed(&origin.observation_names)),
        ("action_names", listed(&origin.action_names)),
    ];
    let period = origin.period.map(|period| (PERIOD, period.to_string()));
    let known = known.into_iter().chain(period);
    let known = known.map(|(key, value)| (key.to_owned(), value));
    let notes = origin.notes.iter();
    let notes = notes.map(|(key, value)| (format!("note.{key}"), value.clone()));
    Metadata {
        name: METADATA.to_owned(),
        metadata: known.chain(notes).collect(),
    }
}

/// Formats names as a JSON array.
fn listed(names: &[String]) -> String {
    serde_json::json!(names).to_string()
}

/// A log that is written while episodes run: [`begin`](Self::begin), [`step`](Self::step) after each control step, and
/// [`finish`](Self::finish), without which it is no complete file.
///
/// What can fail, in every call: the disk.
pub struct Recorder<W: Write + Seek> {
    writer: Writer<BufWriter<W>>,
    origin: Origin,
    episodes: usize,
    channels: Vec<u16>,
    /// Channels of the cameras, by their names.
    cameras: BTreeMap<String, u16>,
    time_ns: u64,
    period_ns: u64,
    sequence: u32,
}

impl<W: Write + Seek> Recorder<W> {
    /// Starts a log of policies that see these cameras.
    pub fn new<'c>(
        to: W,
        origin: &Origin,
        cameras: impl IntoIterator<Item = &'c str>,
    ) -> mcap::McapResult<Self> {
        let options = WriteOptions::new()
            .compression(None)
            .profile("")
            .library(concat!("lads-record ", env!("CARGO_PKG_VERSION")));
        let mut writer = Writer::with_options(BufWriter::new(to), options)?;
        let mut channels = Vec::with_capacity(TOPICS.len());
        for (index, topic) in TOPICS.iter().enumerate() {
            let schema =
                writer.add_schema(topic.schema, "jsonschema", topic.json_schema().as_bytes())?;
            let names = match index {
                OBSERVATION => Some(&origin.observation_names),
                ACTION => Some(&origin.action_names),
                _ => None,
            };
            let about: BTreeMap<_, _> = names
                .map(|names| ("elements".to_owned(), listed(names)))
                .into_iter()
                .collect();
            channels.push(writer.add_channel(schema, topic.name, "json", &about)?);
        }
        let mut images = BTreeMap::new();
        for name in cameras {
            let schema = writer.add_schema(IMAGE, "jsonschema", image_schema().as_bytes())?;
            let topic = format!("{IMAGES}{name}");
            let channel = writer.add_channel(schema, &topic, "json", &BTreeMap::new())?;
            images.insert(name.to_owned(), channel);
        }
        Ok(Self {
            writer,
            episodes: 0,
            channels,
            cameras: images,
            time_ns: 0,
            period_ns: (origin.control_period_s * 1e9).round() as u64,
            origin: origin.clone(),
            sequence: 0,
        })
    }

    /// Begins an episode whose steps and outcome are not known yet: those of `flight` are not written.
    pub fn begin(&mut self, flight: &Flight) -> mcap::McapResult<()> {
        self.start(flight, None)
    }

    /// Records a control step of the episode that began last.
    pub fn step(&mut self, step: &Step) -> mcap::McapResult<()> {
        let values = step.observation.clone();
        self.message(OBSERVATION, &Values { values })?;
        for picture in &step.pictures {
            self.picture(picture)?;
        }
        let action = ActionMessage {
            policy: step.action.clone(),
            executed: step.executed.clone(),
        };
        self.message(ACTION, &action)?;
        let plan = PlanMessage {
            index: step.plan,
            decided: step.decided,
            margin: step.margin,
        };
        self.message(PLAN, &plan)?;
        if !step.scores.is_empty() {
            let values = step.scores.clone();
            self.message(LOGITS, &Values { values })?;
        }
        let controller_ns = step.controller_ns;
        self.message(TIMING, &TimingMessage { controller_ns })?;
        if let Some([x, y, z]) = step.gripper {
            self.message(GRIPPER, &GripperMessage { x, y, z })?;
        }
        self.time_ns = self.time_ns.saturating_add(self.period_ns);
        Ok(())
    }

    /// Completes the file and returns what it was written to.
    pub fn finish(mut self) -> mcap::McapResult<W> {
        self.writer
            .write_metadata(&metadata(&self.origin, self.episodes))?;
        self.writer.finish()?;
        let to = self.writer.into_inner();
        Ok(to
            .into_inner()
            .map_err(std::io::IntoInnerError::into_error)?)
    }

    fn start(&mut self, flight: &Flight, outcome: Option<&Episode>) -> mcap::McapResult<()> {
        let trace = &flight.trace;
        let start = EpisodeMessage {
            instruction: trace.instruction,
            instruction_id: flight.instruction_id.clone(),
            instruction_text: flight.instruction_text.clone(),
            words: flight.words.clone(),
            episode: trace.episode,
            sampling_seed: trace.sampling_seed.map(|seed| seed.to_string()),
            noise_seed: trace.noise_seed.map(|seed| seed.to_string()),
            commanded: trace.commanded,
            continued: trace.continued,
            steps: outcome.map(|outcome| outcome.steps),
            success: outcome.map(|outcome| outcome.success),
        };
        if self.episodes > 0 {
            self.time_ns = self.time_ns.saturating_add(PAUSE_NS);
        }
        self.episodes += 1;
        self.message(EPISODE, &start)
    }

    fn flight(&mut self, flight: &Flight) -> mcap::McapResult<()> {
        let outcome = &flight.trace.outcome;
        self.start(flight, Some(outcome))?;
        let mut completions = outcome.completions.iter().zip(&flight.completed).peekable();
        for (number, step) in (1..).zip(&flight.trace.steps) {
            self.step(step)?;
            while let Some((completion, name)) = completions.next_if(|(c, _)| c.step <= number) {
                let message = CompletionMessage {
                    sub_task: name.clone(),
                    step: completion.step,
                };
                self.message(COMPLETION, &message)?;
            }
        }
        Ok(())
    }

    fn message(&mut self, topic: usize, message: &impl Serialize) -> mcap::McapResult<()> {
        self.write(self.channels[topic], message)
    }

    fn picture(&mut self, picture: &Picture) -> mcap::McapResult<()> {
        let Some(&channel) = self.cameras.get(&picture.channel) else {
            return Ok(());
        };
        let (sec, nsec) = (self.time_ns / 1_000_000_000, self.time_ns % 1_000_000_000);
        let message = ImageMessage {
            timestamp: Time {
                sec: u32::try_from(sec).unwrap_or(u32::MAX),
                nsec: nsec as u32,
            },
            frame_id: picture.channel.clone(),
            data: STANDARD.encode(&picture.png),
            format: "png".to_owned(),
        };
        self.write(channel, &message)
    }

    fn write(&mut self, channel_id: u16, message: &impl Serialize) -> mcap::McapResult<()> {
        let data = serde_json::to_vec(message).map_err(std::io::Error::from)?;
        let header = MessageHeader {
            channel_id,
            sequence: self.sequence,
            log_time: self.time_ns,
            publish_time: self.time_ns,
        };
        self.sequence = self.sequence.wrapping_add(1);
        self.writer.write_to_known_channel(&header, &data)
    }
}
