//! `lads act --log`: the control steps of a pipe as a flight log, written while it runs.
//!
//! Recording never stops the policy: after an error of the disk the steps go on without it, and the command says so at its end. The file
//! is complete when the input ends, when the command is interrupted or told to end (SIGTERM), and when it refuses an observation, which is
//! not recorded; until then its path is untouched. What can fail: a path that cannot be written or is the model's, a camera whose frames
//! are no pictures of three bytes a pixel, the disk.

use std::path::{Path, PathBuf};
use std::process;
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::thread;
use std::time::Duration;

use lads_core::{DType, Decision, Noise, Policy, StepReport};
use lads_host::output::{self, Draft};
use lads_proof::episode::Episode;
use lads_record::trace::{Picture, Step, Trace};
use lads_record::{Flight, Origin, Recorder, png};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use crate::refusal::{Refusal, chain};
use crate::seen::Seen;

const OPTION: &str = "--log";
/// Exit code of a command that was interrupted.
const INTERRUPTED: i32 = 130;
/// Longest time that an interrupted command takes to complete its log.
const PATIENCE: Duration = Duration::from_secs(2);

/// A log that is being written.
pub struct Log {
    path: PathBuf,
    /// Nothing once the file is complete, or given up.
    recorder: Arc<Mutex<Option<Recorder<Draft>>>>,
    /// The episode that runs, without its steps.
    flight: Flight,
    begun: bool,
    failed: Option<String>,
}

/// What a control step was given and answered.
pub struct Answered<'a> {
    pub seen: &'a Seen,
    pub action: &'a [f32],
    pub report: StepReport,
    /// All scores of the last selection.
    pub scores: &'a [f32],
    pub controller_ns: u64,
}

impl Log {
    /// Starts a log at `path`, which is none of the files that are read, nor what answers go to.
    pub fn start(
        path: &Path,
        read: &[output::Named<'_>],
        policy: &Policy<'_>,
        instruction: Option<u32>,
        decision: Decision,
    ) -> Result<Self, Refusal> {
        let lines = ("", Path::new("/dev/stdin"));
        let answers = ("", Path::new("/dev/stdout"));
        output::apart(&[read, &[lines]].concat(), &[answers, (OPTION, path)])
            .map_err(Refusal::of)?;
        let contract = policy.contract();
        let cameras: Vec<_> = contract
            .observations()
            .filter(|channel| channel.dtype() == DType::U8)
            .collect();
        if let Some(other) = cameras.iter().find(|camera| !is_picture(camera.shape())) {
            let wrong = format!(
                "channel `{}` is of bytes that are no picture of three a pixel",
                other.name()
            );
            return Err(Refusal::new(OPTION, wrong, "leave it out"));
        }
        let draft = output::draft(path).map_err(|error| unwritable(path, &error))?;
        let names = cameras.iter().map(lads_core::Channel::name);
        let recorder = Recorder::new(draft, &Origin::of(policy), names);
        let recorder = recorder.map_err(|error| unwritable(path, &error))?;
        let known = instruction.and_then(|index| contract.instruction(index as usize));
        let log = Self {
            path: path.to_owned(),
            recorder: Arc::new(Mutex::new(Some(recorder))),
            flight: Flight {
                instruction_id: known.map(|known| known.id.to_owned()).unwrap_or_default(),
                instruction_text: known.map(|known| known.text.to_owned()).unwrap_or_default(),
                words: None,
                completed: vec![],
                trace: Trace {
                    instruction: instruction.unwrap_or_default(),
                    episode: 0,
                    sampling_seed: match decision {
                        Decision::Argmax => None,
                        Decision::Sample { seed, .. } => Some(seed),
                    },
                    noise_seed: match contract.noise() {
                        Noise::Zero => None,
                        Noise::Seeded { seed } => Some(seed),
                    },
                    commanded: false,
                    continued: false,
                    outcome: Episode::default(),
                    steps: vec![],
                },
            },
            begun: false,
            failed: None,
        };
        log.complete_on_interrupt()?;
        Ok(log)
    }

    /// Ends the episode; the next step is the first of another.
    pub fn end_episode(&mut self) {
        if self.begun {
            self.begun = false;
            self.flight.trace.episode += 1;
            // Its random numbers are the next of the same streams.
            self.flight.trace.continued = true;
        }
    }

    /// Records a control step.
    pub fn step(&mut self, answered: &Answered<'_>) {
        let recorded = self.record(answered);
        if let Err(error) = recorded {
            eprintln!(
                "warning: {OPTION} {}: {error}; the policy goes on without it",
                self.path.display()
            );
            self.failed = Some(error);
            // What was written is no complete file.
            let mut recorder = self.recorder.lock().unwrap_or_else(PoisonError::into_inner);
            *recorder = None;
        }
    }

    fn record(&mut self, answered: &Answered<'_>) -> Result<(), String> {
        let mut recorder = self.recorder.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(recorder) = recorder.as_mut() else {
            return Ok(());
        };
        if !self.begun {
            recorder
                .begin(&self.flight)
                .map_err(|error| chain(&error))?;
            self.begun = true;
        }
        let selected = answered.report.selected;
        let margin = selected.map(|selected| selected.margin);
        let decided = selected.is_some_and(|selected| selected.fresh);
        let step = Step {
            observation: answered.seen.numbers(),
            action: answered.action.to_vec(),
            executed: answered.action.to_vec(),
            plan: selected.map(|selected| selected.index),
            decided,
            // JSON has no infinity.
            margin: margin.filter(|margin| margin.is_finite()),
            scores: if decided {
                answered.scores.to_vec()
            } else {
                vec![]
            },
            controller_ns: answered.controller_ns,
            gripper: None,
            shown: None,
            pictures: pictures(answered.seen)?,
        };
        recorder.step(&step).map_err(|error| chain(&error))
    }

    /// Completes the file.
    pub fn finish(self) -> Result<(), Refusal> {
        let completed = match self.failed {
            Some(error) => Err(error),
            None => complete(&self.recorder),
        };
        completed.map_err(|error| unwritable(&self.path, &error))
    }

    fn complete_on_interrupt(&self) -> Result<(), Refusal> {
        let (recorder, path) = (Arc::clone(&self.recorder), self.path.clone());
        let mut signals = Signals::new([SIGINT, SIGTERM]).map_err(|error| {
            let wrong = format!("interrupts cannot be handled ({error})");
            Refusal::new(OPTION, wrong, "run it in another shell")
        })?;
        thread::spawn(move || {
            signals.forever().next();
            let (done, completed) = mpsc::channel();
            thread::spawn(move || done.send(complete(&recorder)));
            // The input may have ended just now, and the file be on its way to a pipe that nobody reads.
            let late = || Err("it takes longer than an interrupt waits".to_owned());
            if let Err(error) = completed.recv_timeout(PATIENCE).unwrap_or_else(|_| late()) {
                eprintln!("error: {}", unwritable(&path, &error));
            }
            process::exit(INTERRUPTED);
        });
        Ok(())
    }
}

fn complete(recorder: &Mutex<Option<Recorder<Draft>>>) -> Result<(), String> {
    // Held until the file is at its place: the end of the input and an interrupt may come together.
    let mut recorder = recorder.lock().unwrap_or_else(PoisonError::into_inner);
    let Some(recorder) = recorder.take() else {
        return Ok(());
    };
    let draft = recorder.finish().map_err(|error| chain(&error))?;
    draft.commit().map_err(|error| chain(&error))
}

fn unwritable(path: &Path, error: &dyn std::fmt::Display) -> Refusal {
    let wrong = format!("it cannot be written ({error})");
    let remedy = "name a file in an existing, writable folder with room";
    Refusal::new(format_args!("{OPTION} {}", path.display()), wrong, remedy)
}

fn is_picture(shape: &[u32]) -> bool {
    matches!(shape, [_, _, 3])
}

fn pictures(seen: &Seen) -> Result<Vec<Picture>, String> {
    let cameras = seen.cameras();
    let made = cameras.map(|(channel, [rows, columns], frame)| {
        Ok(Picture {
            channel: channel.to_owned(),
            png: png::encode(frame, [rows, columns])?,
        })
    });
    made.collect()
}
