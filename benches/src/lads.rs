//! lads itself as a contender.

use lads_core::image::ProgramKind;
use lads_core::op::Op;
use lads_core::{Controller, Instruction, PlanIndex};

use crate::clock::Pace;
use crate::contender::{Block, Computed, Contender, Episode, Kind, Sample, Work, measure};
use crate::error::BenchError;

/// A controller and the episode that it is measured on.
#[derive(Debug)]
pub struct Lads<'c, 'a, 'm> {
    name: String,
    detail: String,
    controller: &'c mut Controller<'a, 'm>,
    episode: &'c Episode,
    action: Vec<f32>,
}

impl<'c, 'a, 'm> Lads<'c, 'a, 'm> {
    /// Measures `controller` on `episode`; `weights` says how its weights are stored.
    pub fn new(
        weights: &str,
        controller: &'c mut Controller<'a, 'm>,
        episode: &'c Episode,
    ) -> Self {
        let (isa, version) = (controller.isa().name(), env!("CARGO_PKG_VERSION"));
        let step = controller.policy().program(ProgramKind::StepRecord);
        let format = |op| match op {
            Op::Attention(op) => Some(op.format),
            _ => None,
        };
        let cache = step.ops().find_map(format).unwrap_or_default().name();
        let action = vec![0.0; controller.policy().contract().action_len()];
        Self {
            name: format!("lads {weights}"),
            detail: format!("{version}, {weights} weights, {cache} cache, {isa}"),
            controller,
            episode,
            action,
        }
    }

    fn refused(&self, error: impl std::fmt::Display) -> BenchError {
        BenchError::new(&self.name, error, "run lads self-test on this policy")
    }

    fn instruct(&mut self) -> Result<(), BenchError> {
        let instruction = Instruction::Id(self.episode.instruction);
        let done = self.controller.set_instruction(instruction);
        done.map_err(|error| self.refused(error))
    }

    fn step(&mut self, step: usize) -> Result<u32, BenchError> {
        let observation = self.episode.observation(step);
        let done = self.controller.step(observation, &mut self.action);
        done.map(|report| report.plan.0)
            .map_err(|error| self.refused(error))
    }

    /// Unmeasured steps up to `step`.
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
        self.instruct()?;
        let step = |step| {
            let plan = self.step(step)?;
            let action = self.action.clone();
            Ok(Computed { plan, action })
        };
        (0..steps).map(step).collect()
    }

    fn offers(&self, work: Work) -> bool {
        !matches!(work, Work::Recompute { .. })
    }

    fn block(&mut self, block: &Block, samples: &mut Vec<Sample>) -> Result<(), BenchError> {
        match block.work {
            Work::Act => {
                let plan = PlanIndex(self.episode.recorded.first().map_or(0, |first| first.plan));
                measure(block, samples, |number| {
                    let observation = self.episode.observation(number);
                    self.controller
                        .act(observation, plan, &mut self.action)
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
                "ask a peer",
            )),
        }
    }
}
