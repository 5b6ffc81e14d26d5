//! The lads runtime as a contender.

use lads_core::{ChannelId, Controller, Data, Decision, GoldenStep, Instruction, Role, StepReport};

use crate::clock::Pace;
use crate::contender::{Block, Computed, Contender, Episode, Kind, Sample, Work, measure};
use crate::error::BenchError;

/// A controller with the episode that it is measured on.
#[derive(Debug)]
pub struct Lads<'c, 'a, 'm> {
    name: String,
    detail: String,
    controller: &'c mut Controller<'a, 'm>,
    episode: &'c Episode,
    recorded: Vec<GoldenStep<'a>>,
    action: Vec<f32>,
}

impl<'c, 'a, 'm> Lads<'c, 'a, 'm> {
    /// Makes a contender that measures `controller` on `episode`; `weights` names the format of its
    /// weights.
    pub fn new(
        weights: &str,
        controller: &'c mut Controller<'a, 'm>,
        episode: &'c Episode,
    ) -> Self {
        let (isa, version) = (controller.isa().name(), env!("CARGO_PKG_VERSION"));
        let policy = controller.policy();
        let stored = lads_host::stored(policy);
        let recorded = policy
            .golden()
            .into_iter()
            .flat_map(|golden| golden.steps());
        let recorded = recorded.collect();
        let action = vec![0.0; policy.contract().action_len()];
        Self {
            name: format!("lads {weights}"),
            detail: format!("{version}, {stored}, {isa}"),
            controller,
            episode,
            recorded,
            action,
        }
    }

    fn refused(&self, error: impl std::fmt::Display) -> BenchError {
        BenchError::new(&self.name, error, "test the policy on this machine")
    }

    fn instruct(&mut self) -> Result<(), BenchError> {
        let Some(number) = self.episode.instruction else {
            self.controller.reset();
            return Ok(());
        };
        let done = self.controller.set_instruction(Instruction::Id(number));
        done.map_err(|error| self.refused(error))
    }

    fn step(&mut self, step: usize) -> Result<StepReport, BenchError> {
        let recorded = &self.recorded[step % self.recorded.len()];
        let done = match recorded.observation() {
            [] => self
                .controller
                .step_with(recorded.observations(), &mut self.action),
            only => self.controller.step(only, &mut self.action),
        };
        done.map_err(|error| self.refused(error))
    }

    /// Runs a control step with the recorded noise.
    fn replayed(&mut self, step: usize) -> Result<Computed, BenchError> {
        let recorded = &self.recorded[step % self.recorded.len()];
        let mut channels = self.controller.policy().contract().channels();
        let noise = channels.find(|channel| channel.role() == Role::Noise);
        let noise = noise.map(|channel| (channel.id(), Data::F32(recorded.noise)));
        let noise = noise.filter(|(_, draws)| !draws.is_empty());
        let given: Vec<(ChannelId, Data)> = recorded
            .observations()
            .iter()
            .copied()
            .chain(noise)
            .collect();
        let done = self.controller.step_with(&given, &mut self.action);
        let report = done.map_err(|error| self.refused(error))?;
        Ok(Computed {
            selected: report.selected.map(|selected| selected.index),
            action: self.action.clone(),
        })
    }

    /// Runs unmeasured steps up to `step`.
    fn forward_to(&mut self, step: usize) -> Result<(), BenchError> {
        self.instruct()?;
        for before in 0..step {
            self.step(before)?;
        }
        Ok(())
    }
}

impl Contender for Lads<'_, '_, '_> {
    fn name(&self) -> &str {
        &self.name
    }

    fn detail(&self) -> String {
        self.detail.clone()
    }

    fn replay(&mut self, steps: usize) -> Result<Vec<Computed>, BenchError> {
        // What is recorded was not sampled.
        let rule = self.controller.decision();
        self.controller.set_decision(Decision::Argmax);
        let replayed = self
            .instruct()
            .and_then(|()| (0..steps).map(|step| self.replayed(step)).collect());
        self.controller.set_decision(rule);
        replayed
    }

    fn offers(&self, work: Work) -> bool {
        match work {
            Work::Act => self.controller.policy().follows(),
            Work::Steps { .. } => true,
            Work::Instruct => self.episode.instruction.is_some(),
            Work::Recompute { .. } => false,
        }
    }

    fn block(&mut self, block: &Block, samples: &mut Vec<Sample>) -> Result<(), BenchError> {
        match block.work {
            Work::Act => {
                let first = self.episode.recorded.first();
                let index = first.and_then(|first| first.selected).unwrap_or(0);
                measure(block, samples, |number| {
                    let seen = self.recorded[number % self.recorded.len()].observations();
                    self.controller
                        .follow(seen, index, &mut self.action)
                        .map(|()| (Kind::Act, 0))
                })
                .map_err(|error| self.refused(error))
            }
            Work::Steps { first } => {
                // Near the start of an episode there are fewer steps to settle in.
                let settle = block.settle.min(first);
                self.forward_to(first - settle)?;
                if let Pace::Every(period) = block.pace {
                    std::thread::sleep(period * (block.settle - settle) as u32);
                }
                measure(&Block { settle, ..*block }, samples, |number| {
                    let step = first - settle + number;
                    self.step(step)?;
                    Ok((self.episode.kind(step), step))
                })
            }
            Work::Instruct => measure(block, samples, |_| {
                self.instruct().map(|()| (Kind::Instruct, 0))
            }),
            Work::Recompute { .. } => Err(BenchError::new(
                &self.name,
                "it never recomputes its history",
                "ask another contender",
            )),
        }
    }
}
