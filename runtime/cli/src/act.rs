//! `lads act`: the controller on a pipe. One observation per line of input, one action per line of output, flushed, in the same form.
//!
//! A line is read up to the length that an observation can have, whatever comes. An empty line starts a new episode of the same instruction and is not answered. An observation that is refused ends the command with
//! the number of its line; the lines before it have been answered.

use std::fmt::Display;
use std::io::{BufRead, ErrorKind, Read as _, Write};

use lads_compiler::Memory;
use lads_core::{Controller, Decision, Instruction, Policy};

use crate::line;
use crate::model::Model;
use crate::refusal::Refusal;
use crate::self_test;

/// Bytes of a line that are read at most: for every element, and for the rest of it. A number of f32 in any usual form takes fewer.
const BYTES_PER_ELEMENT: usize = 64;
const BYTES_BESIDE: usize = 1024;

/// What to act on.
pub struct Request<'r> {
    /// Text or id of an instruction that the policy knows.
    pub instruction: &'r str,
    /// Append the index of the plan in force to every action.
    pub plans: bool,
    /// Sample plans, from the stream with this seed, instead of following the contract's rule.
    pub sample: Option<u64>,
}

/// Answers `input` on `output` until it ends or nobody reads any more.
pub fn act(
    model: &Model,
    request: &Request<'_>,
    input: impl BufRead,
    output: impl Write,
) -> Result<(), Refusal> {
    let policy = model.policy()?;
    let instruction = model.instruction(request.instruction)?;
    let mut memory = Memory::of(&policy).map_err(|error| model.refused(error))?;
    let mut controller = memory
        .controller(&policy)
        .map_err(|error| model.refused(error))?;
    // A policy that answers differently on this machine is not let near a motor.
    self_test::replay(model, &policy, &mut controller)?;
    if let Some(seed) = request.sample {
        controller.set_decision(sampling(&policy, seed));
    }
    controller
        .set_instruction(Instruction::Id(instruction))
        .map_err(|error| Refusal::new(model.path.display(), error, "export the bundle again"))?;
    let mut pipe = Pipe {
        policy,
        controller,
        plans: request.plans,
    };
    pipe.answer_all(input, output)
}

/// Sampling at the contract's temperature, or at 1 where the contract's rule is argmax.
fn sampling(policy: &Policy<'_>, seed: u64) -> Decision {
    let temperature = match policy.contract().decision() {
        Decision::Sample { temperature, .. } => temperature,
        Decision::Argmax => 1.0,
    };
    Decision::Sample { temperature, seed }
}

/// A controller between a reader and a writer.
struct Pipe<'p, 'm> {
    policy: Policy<'p>,
    controller: Controller<'p, 'm>,
    plans: bool,
}

impl Pipe<'_, '_> {
    fn answer_all(
        &mut self,
        mut input: impl BufRead,
        mut output: impl Write,
    ) -> Result<(), Refusal> {
        let mut observation = vec![0.0; self.policy.contract().observation_len()];
        let mut action = vec![0.0; self.policy.contract().action_len()];
        let most = BYTES_BESIDE + BYTES_PER_ELEMENT * observation.len();
        let (mut bytes, mut answered) = (vec![], String::new());
        for number in 1_u64.. {
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
                return Err(self.refuse(number, &wrong));
            }
            let asked = str::from_utf8(&bytes).map_err(|error| unreadable(&error))?;
            if asked.trim().is_empty() {
                self.controller.reset();
                continue;
            }
            let plan = self.answer(asked, &mut observation, &mut action);
            let (form, plan) = plan.map_err(|wrong| self.refuse(number, &wrong))?;
            line::format(form, &action, plan, &mut answered);
            match output
                .write_all(answered.as_bytes())
                .and_then(|()| output.flush())
            {
                Err(error) if error.kind() == ErrorKind::BrokenPipe => break,
                Err(error) => {
                    return Err(Refusal::new(
                        "output",
                        error,
                        "connect it to a reader or a place with room",
                    ));
                }
                Ok(()) => {}
            }
        }
        Ok(())
    }

    /// One control step; on success the form of the line, and the plan where it was asked for.
    fn answer(
        &mut self,
        asked: &str,
        observation: &mut [f32],
        action: &mut [f32],
    ) -> Result<(line::Form, Option<u32>), String> {
        let form = line::parse(asked, observation).map_err(|error| error.to_string())?;
        let report = self
            .controller
            .step(observation, action)
            .map_err(|error| error.to_string())?;
        Ok((form, self.plans.then_some(report.plan.0)))
    }

    fn refuse(&self, number: u64, wrong: &str) -> Refusal {
        let contract = self.policy.contract();
        let remedy = format!(
            "send {} finite numbers inside the contract's limits, which `lads inspect` lists",
            contract.observation_len()
        );
        Refusal::new(format_args!("input line {number}"), wrong, remedy)
    }
}
