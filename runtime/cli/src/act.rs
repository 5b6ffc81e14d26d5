//! `lads act`: the controller on a pipe. One observation per line of input, one action per line of output, flushed, in the same form.
//!
//! A line holds the elements of all observation channels, one channel after the other in the
//! policy's order, except those whose frames come from elsewhere ([`crate::images`]); if that is all
//! of them, a step needs no line. No more of a line is read than an observation can need. An empty
//! line starts a new episode of the same instruction and is not answered. An observation that is
//! refused ends the command with the number of its line; the lines before it have been answered.
//! [`crate::log`] records the steps.

use std::fmt::Display;
use std::io::{BufRead, ErrorKind, Read as _, Write};
use std::path::Path;
use std::time::Instant;

use lads_core::{Controller, Instruction, Policy, StepError, StepReport};
use lads_host::Memory;

use crate::images::Images;
use crate::line;
use crate::log::{Answered, Log};
use crate::model::Model;
use crate::refusal::Refusal;
use crate::seen::Seen;
use crate::self_test;

/// Number of bytes of a line that are read at most for every element, and for the rest of the line.
/// An f32 in any usual form takes fewer.
const BYTES_PER_ELEMENT: usize = 64;
const BYTES_BESIDE: usize = 1024;

/// Options of `lads act`.
pub struct Request<'r> {
    /// Text or id of an instruction that the policy knows.
    pub instruction: Option<&'r str>,
    /// Append the index in force to every action.
    pub plans: bool,
    /// Where frames of cameras come from: folders, or stdin.
    pub images: &'r [String],
    /// Sample indices, from the stream with this seed, instead of following the contract's rule.
    pub sample: Option<u64>,
    /// File for the control steps as a flight log.
    pub log: Option<&'r Path>,
}

/// Answers `input` on `output` until the input ends or the output's reader closes it.
pub fn act(
    model: &Model,
    request: &Request<'_>,
    input: impl BufRead,
    output: impl Write,
) -> Result<(), Refusal> {
    let policy = model.policy();
    let takes = policy.contract().instruction_channel().is_some();
    let instruction = match request.instruction {
        Some(wanted) => Some(model.instruction(wanted)?),
        None if takes => {
            let wrong = "the policy takes an instruction and none is given";
            let remedy = "give the text or the id of one that it knows, which `lads inspect` lists";
            return Err(Refusal::new("--instruction", wrong, remedy));
        }
        None => None,
    };
    if request.plans && policy.index_count() == 0 {
        let wrong = "the policy selects no index";
        return Err(Refusal::new("--plans", wrong, "leave it out"));
    }
    let images = Images::of(request.images, policy.contract())?;
    let mut memory = Memory::of(&policy).map_err(|error| model.refused(error))?;
    let mut controller = memory
        .controller(&policy)
        .map_err(|error| model.refused(error))?;
    // A policy that answers differently on this machine is not let near a motor.
    self_test::replay(model, &policy, &mut controller)?;
    let mut decision = policy.contract().decision();
    if let Some(seed) = request.sample {
        decision = policy.contract().sampling(seed);
        controller.set_decision(decision);
    }
    let frames = images.iter().flat_map(Images::files);
    let read: Vec<_> = [("--model", model.path.as_path())]
        .into_iter()
        .chain(frames.map(|file| ("--images", file)))
        .collect();
    let log = request
        .log
        .map(|path| Log::start(path, &read, &policy, instruction, decision));
    let log = log.transpose()?;
    if let Some(instruction) = instruction {
        controller
            .set_instruction(Instruction::Id(instruction))
            .map_err(|error| {
                Refusal::new(model.path.display(), error, "export the bundle again")
            })?;
    }
    let mut pipe = Pipe {
        policy,
        controller,
        plans: request.plans,
        images,
        log,
    };
    let answered = pipe.answer_all(input, output);
    let logged = pipe.log.map_or(Ok(()), Log::finish);
    answered.and(logged)
}

/// Connects a controller with a reader and a writer.
struct Pipe<'p, 'm> {
    policy: Policy<'p>,
    controller: Controller<'p, 'm>,
    plans: bool,
    images: Option<Images>,
    log: Option<Log>,
}

/// What a control step says besides its action.
struct Stepped {
    report: StepReport,
    controller_ns: u64,
}

impl Pipe<'_, '_> {
    fn answer_all(
        &mut self,
        mut input: impl BufRead,
        mut output: impl Write,
    ) -> Result<(), Refusal> {
        let images = self.images.take();
        let beside = images.as_ref().map(Images::channels).unwrap_or_default();
        let mut seen = Seen::of(self.policy.contract(), &beside);
        let mut action = vec![0.0; self.policy.contract().action_len()];
        let most = BYTES_BESIDE + BYTES_PER_ELEMENT * seen.len();
        let (mut bytes, mut answered) = (vec![], String::new());
        let mut frame = 0;
        for number in 1_u64.. {
            if let Some(images) = images.as_ref().filter(|_| seen.len() == 0) {
                if !images.show(frame, &mut input, &mut seen)? {
                    break;
                }
                frame += 1;
                let step = self.step(&seen, &mut action).map_err(|wrong| {
                    let remedy = "send frames that `lads inspect` describes";
                    Refusal::new(format_args!("frame {frame}"), wrong, remedy)
                })?;
                line::format(line::Form::Csv, &action, self.plan(&step), &mut answered);
                if !send(&mut output, &answered)? {
                    break;
                }
                self.record(&seen, &action, &step);
                continue;
            }
            bytes.clear();
            let unreadable = |wrong: &dyn Display| {
                let line = format_args!("input line {number}").to_string();
                Refusal::new(line, wrong, "send lines of UTF-8 text")
            };
            let read = input
                .by_ref()
                .take(most as u64 + 1)
                .read_until(b'\n', &mut bytes);
            if read.map_err(|error| unreadable(&error))? == 0 {
                break;
            }
            if bytes.len() > most {
                let wrong = format!("it is longer than {most} bytes");
                return Err(Self::refuse(seen.len(), number, &wrong));
            }
            let asked = str::from_utf8(&bytes).map_err(|error| unreadable(&error))?;
            if asked.trim().is_empty() {
                self.controller.reset();
                if let Some(log) = &mut self.log {
                    log.end_episode();
                }
                continue;
            }
            let form = seen.read(asked);
            let form = form.map_err(|wrong| Self::refuse(seen.len(), number, &wrong))?;
            if let Some(images) = &images {
                if !images.show(frame, &mut input, &mut seen)? {
                    return Err(images.exhausted());
                }
                frame += 1;
            }
            let step = self.step(&seen, &mut action);
            let step = step.map_err(|wrong| Self::refuse(seen.len(), number, &wrong))?;
            line::format(form, &action, self.plan(&step), &mut answered);
            if !send(&mut output, &answered)? {
                break;
            }
            self.record(&seen, &action, &step);
        }
        Ok(())
    }

    /// Runs one control step.
    fn step(&mut self, seen: &Seen, action: &mut [f32]) -> Result<Stepped, String> {
        let start = Instant::now();
        let report =
            self.controller
                .step_with(&seen.given(), action)
                .map_err(|error| match error {
                    StepError::Input(error) => lads_host::refused(&error, self.policy.contract()),
                    other => other.to_string(),
                })?;
        Ok(Stepped {
            report,
            controller_ns: start.elapsed().as_nanos() as u64,
        })
    }

    /// Returns the index in force if it was asked for.
    fn plan(&self, step: &Stepped) -> Option<u32> {
        let selected = step.report.selected.filter(|_| self.plans);
        selected.map(|selected| selected.index)
    }

    /// Records a step that has been answered: an action does not wait for a disk.
    fn record(&mut self, seen: &Seen, action: &[f32], step: &Stepped) {
        if let Some(log) = &mut self.log {
            log.step(&Answered {
                seen,
                action,
                report: step.report,
                scores: self.controller.scores(),
                controller_ns: step.controller_ns,
            });
        }
    }

    /// Refuses an input line, which takes `len` numbers.
    fn refuse(len: usize, number: u64, wrong: &str) -> Refusal {
        let remedy = format!(
            "send {len} finite numbers inside the contract's limits, which `lads inspect` lists"
        );
        Refusal::new(format_args!("input line {number}"), wrong, remedy)
    }
}

/// Writes a line; `false` where nobody reads any more.
fn send(output: &mut impl Write, line: &str) -> Result<bool, Refusal> {
    let sent = output
        .write_all(line.as_bytes())
        .and_then(|()| output.flush());
    match sent {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(error) => {
            let remedy = "connect it to a reader or a place with room";
            Err(Refusal::new("output", error, remedy))
        }
        Ok(()) => Ok(true),
    }
}
