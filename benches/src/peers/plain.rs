//! Runs a policy of one entry on a general runtime, as a user would write it: an observation and states in, an action and the next states out.

use super::cut::{Source, Tensor, shapes, signature};
use super::engine::{Engine, Session, failed};
use lads_pace::BenchError;
use lads_pace::contender::{Block, Computed, Contender, Episode, Sample, Work, measure};

/// A state: its places among inputs and outputs, and its value.
struct State {
    input: usize,
    output: usize,
    value: Vec<f32>,
}

/// A policy of one entry on a general runtime.
pub struct Plain<'e> {
    name: String,
    detail: String,
    episode: &'e Episode,
    session: Box<dyn Session>,
    observation: usize,
    act: usize,
    states: Vec<State>,
    action: Vec<f32>,
}

impl<'e> Plain<'e> {
    /// Loads the only entry of a bundle.
    pub fn new(
        engine: &dyn Engine,
        source: &Source,
        entry: &str,
        episode: &'e Episode,
    ) -> Result<Self, BenchError> {
        let model = source.cut(entry)?;
        let (inputs, outputs) = signature(&model)?;
        let find = |names: &[String], short: &str| {
            let place = names.iter().position(|name| {
                name.strip_prefix(entry)
                    .is_some_and(|rest| rest == format!("/{short}"))
            });
            place.ok_or_else(|| failed(engine.name(), format!("{entry} has no value {short}")))
        };
        let mut states = vec![];
        let mut given = vec![];
        for (place, (name, shape)) in shapes(&model)?.into_iter().enumerate() {
            let short = name.rsplit('/').next().unwrap_or_default().to_owned();
            let data = if short == "observation" {
                episode.observation(0).to_vec()
            } else {
                let value = vec![0.0; shape.iter().product()];
                states.push(State {
                    input: place,
                    output: find(&outputs, &format!("next_{short}"))?,
                    value: value.clone(),
                });
                value
            };
            given.push((name, Tensor::of(shape, data)));
        }
        let mut session = engine.load(&model)?;
        let named: Vec<_> = given.iter().map(|(name, it)| (name.clone(), it)).collect();
        session.bind(&named)?;
        Ok(Self {
            name: engine.name().into(),
            detail: engine.detail(),
            episode,
            session,
            observation: find(&inputs, "observation")?,
            act: find(&outputs, "action")?,
            states,
            action: vec![0.0; episode.limits.len()],
        })
    }

    fn reset(&mut self) {
        for state in &mut self.states {
            state.value.fill(0.0);
        }
    }

    fn step(&mut self, number: usize) -> Result<(), BenchError> {
        let session = &mut self.session;
        session.write(self.observation, self.episode.observation(number))?;
        for state in &self.states {
            session.write(state.input, &state.value)?;
        }
        session.call()?;
        for state in &mut self.states {
            session.read(state.output, &mut state.value)?;
        }
        session.read(self.act, &mut self.action)?;
        for (action, &(min, max)) in self.action.iter_mut().zip(&self.episode.limits) {
            *action = action.clamp(min, max);
        }
        Ok(())
    }
}

impl Contender for Plain<'_> {
    fn name(&self) -> &str {
        &self.name
    }

    fn detail(&self) -> String {
        self.detail.clone()
    }

    fn replay(&mut self, steps: usize) -> Result<Vec<Computed>, BenchError> {
        self.reset();
        let mut computed = vec![];
        for number in 0..steps {
            self.step(number)?;
            computed.push(Computed {
                selected: None,
                action: self.action.clone(),
            });
        }
        Ok(computed)
    }

    fn offers(&self, work: Work) -> bool {
        matches!(work, Work::Steps { .. })
    }

    fn block(&mut self, block: &Block, samples: &mut Vec<Sample>) -> Result<(), BenchError> {
        let Work::Steps { first } = block.work else {
            let wrong = "it runs control steps and nothing else";
            return Err(failed(&self.name, wrong));
        };
        self.reset();
        measure(block, samples, |number| {
            let number = first + number;
            self.step(number)?;
            Ok((self.episode.kind(number), number))
        })
    }
}
