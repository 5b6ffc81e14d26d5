//! Runs the control loop of a policy on a general runtime, as a user would write it: the bundle's entries, cut out, each loaded once; keys
//! and values handed from call to call.
//!
//! Timed calls stay at one context length: past and present keys and values are bound once, and the same control step is repeated
//! on fresh observations. This flatters the peers, who would have to bind anew, or allocate, as the context grows.

use std::collections::BTreeMap;

use super::cut::{Source, Tensor};
use super::engine::{Engine, Session, failed};
use lads_pace::BenchError;
use lads_pace::contender::{Block, Computed, Contender, Episode, Kind, Sample, Work, measure};

/// State that a control step at some context starts from.
#[derive(Debug, Clone)]
struct Past {
    /// Keys and values, named as inputs without their entry.
    cache: Vec<(String, Tensor)>,
    action: Vec<f32>,
    plan: Tensor,
}

/// A policy on a general runtime.
pub struct General<'e> {
    name: String,
    detail: String,
    episode: &'e Episode,
    instruct: Box<dyn Session>,
    start: Box<dyn Session>,
    step: Box<dyn Session>,
    lookup: Box<dyn Session>,
    act: Box<dyn Session>,
    words: Tensor,
    word_count: usize,
    pasts: BTreeMap<usize, Past>,
    bound: Option<usize>,
    logits: Vec<f32>,
    plan: Vec<f32>,
    action: Vec<f32>,
}

/// Index of the name that ends in `end`.
fn place(names: &[String], end: &str) -> Result<usize, BenchError> {
    names
        .iter()
        .position(|name| name.rsplit('/').next() == Some(end))
        .ok_or_else(|| failed("the bundle", format!("an entry has no value {end}")))
}

impl<'e> General<'e> {
    /// Loads the entries of a bundle.
    pub fn new(
        engine: &dyn Engine,
        source: &Source,
        episode: &'e Episode,
    ) -> Result<Self, BenchError> {
        let load = |entry: &str| engine.load(&source.cut(entry)?);
        let mut instructions = load("instruction/lookup")?;
        let instruction = episode.instruction.ok_or_else(|| {
            let wrong = "it runs policies that take instructions, which this one does not";
            failed(engine.name(), wrong)
        })?;
        let id = Tensor::integer(instruction as usize);
        instructions.bind(&[("instruction/lookup/id".into(), &id)])?;
        instructions.call()?;
        let known = instructions.outputs()?;
        let get = |end: &str| {
            known
                .iter()
                .find(|(name, _)| name.ends_with(end))
                .map(|(_, t)| t.clone())
        };
        let missing = || failed(engine.name(), "instruction/lookup gave no words");
        let words = get("/words").ok_or_else(missing)?;
        let count = get("/length")
            .and_then(|length| length.first())
            .ok_or_else(missing)?;
        let action_len = episode.limits.len();
        Ok(Self {
            name: engine.name().into(),
            detail: engine.detail(),
            episode,
            instruct: load("high_level/instruct")?,
            start: load("high_level/start")?,
            step: load("high_level/step")?,
            lookup: load("codebook/lookup")?,
            act: load("low_level/act")?,
            words,
            word_count: count as usize,
            pasts: BTreeMap::new(),
            bound: None,
            logits: vec![],
            plan: vec![],
            action: vec![0.0; action_len],
        })
    }

    /// Returns the plan with the largest logit.
    fn decide(&mut self, output: usize) -> Result<usize, BenchError> {
        self.step.read(output, &mut self.logits)?;
        Ok(argmax(&self.logits))
    }

    /// Runs one untimed control step; leaves the grown context in `past`.
    fn advance(&mut self, step: usize, past: &mut Past) -> Result<u32, BenchError> {
        let entry = if step == 0 {
            "high_level/start"
        } else {
            "high_level/step"
        };
        let observation = Tensor::row(self.episode.observation(step));
        let (time, before) = (Tensor::integer(step), Tensor::row(&past.action));
        let mut inputs = vec![
            (format!("{entry}/observation"), &observation),
            (format!("{entry}/timestep"), &time),
        ];
        if step > 0 {
            inputs.push((format!("{entry}/action"), &before));
        }
        inputs.extend(
            past.cache
                .iter()
                .map(|(name, tensor)| (format!("{entry}/{name}"), tensor)),
        );
        let session = if step == 0 {
            &mut self.start
        } else {
            &mut self.step
        };
        session.bind(&inputs)?;
        session.call()?;
        let mut cache = vec![];
        let mut index = None;
        for (name, tensor) in session.outputs()? {
            let short = name
                .trim_start_matches(entry)
                .trim_start_matches('/')
                .to_owned();
            if short == "logits" {
                index = Some(argmax(tensor.f32()));
            } else {
                cache.push((short.replace("present", "past_key_values"), tensor));
            }
        }
        past.cache = cache;
        let index = index.ok_or_else(|| failed(&self.name, "a step gave no logits"))?;
        if self.episode.decides(step) {
            let index = Tensor::integer(index);
            self.lookup
                .bind(&[("codebook/lookup/index".into(), &index)])?;
            self.lookup.call()?;
            let found = self.lookup.outputs()?.pop();
            past.plan = found
                .ok_or_else(|| failed(&self.name, "codebook/lookup gave no plan"))?
                .1;
        }
        self.act.bind(&[
            ("low_level/act/observation".into(), &observation),
            ("low_level/act/plan".into(), &past.plan),
        ])?;
        self.act.call()?;
        self.act.read(0, &mut self.action)?;
        self.clip();
        past.action.clone_from(&self.action);
        Ok(index as u32)
    }

    fn clip(&mut self) {
        for (action, &(min, max)) in self.action.iter_mut().zip(&self.episode.limits) {
            *action = action.clamp(min, max);
        }
    }

    /// Returns the context after the words of the instruction.
    fn beginning(&mut self) -> Result<Past, BenchError> {
        self.instruct
            .bind(&[("high_level/instruct/words".into(), &self.words)])?;
        self.instruct.call()?;
        let outputs = self.instruct.outputs()?;
        let rename = |name: &str| {
            name.trim_start_matches("high_level/instruct/")
                .replace("present", "past_key_values")
        };
        let cache = outputs
            .iter()
            .map(|(name, rows)| (rename(name), rows.first_rows(self.word_count)));
        let (cache, action) = (cache.collect(), vec![0.0; self.action.len()]);
        Ok(Past {
            cache,
            action,
            plan: Tensor::row(&[]),
        })
    }

    /// Walks to a control step that was not reached before, and keeps the state that it starts from.
    fn walk_to(&mut self, step: usize) -> Result<(), BenchError> {
        if self.pasts.contains_key(&step) {
            return Ok(());
        }
        let (from, mut past) = match self.pasts.range(..step).next_back() {
            Some((&from, past)) => (from, past.clone()),
            None => (0, self.beginning()?),
        };
        for before in from..step {
            self.advance(before, &mut past)?;
        }
        self.pasts.insert(step, past);
        Ok(())
    }

    /// Binds all that a timed control step needs, and checks that it computes the same as the untimed steps before.
    fn bind(&mut self, step: usize) -> Result<(), BenchError> {
        let step = step.max(1);
        if self.bound == Some(step) {
            return Ok(());
        }
        self.walk_to(step)?;
        let mut past = self
            .pasts
            .get(&step)
            .cloned()
            .ok_or_else(|| failed(&self.name, "a step was not reached"))?;
        let before = past.clone();
        // This binds both entries at this very context; the timed calls overwrite observation, action and plan.
        let plan = self.advance(step, &mut past)?;
        let expected = past.action.clone();
        if past.plan.f32().is_empty() || before.plan.f32().is_empty() {
            return Err(failed(&self.name, "no plan was in force"));
        }
        self.plan = before.plan.f32().to_vec();
        let names = self.step.output_names();
        let logits = place(&names, "logits")?;
        self.logits = self.step.outputs()?.swap_remove(logits).1.f32().to_vec();
        self.bound = Some(step);
        let ports = self.ports()?;
        self.control_step(&ports, step, step, &before.action)?;
        if self.decide(ports.logits)? as u32 != plan || self.action != expected {
            return Err(failed(&self.name, "bound and fresh calls differ"));
        }
        Ok(())
    }

    fn ports(&self) -> Result<Ports, BenchError> {
        let (step, act) = (self.step.input_names(), self.act.input_names());
        Ok(Ports {
            action: place(&step, "action")?,
            observation: place(&step, "observation")?,
            logits: place(&self.step.output_names(), "logits")?,
            act_observation: place(&act, "observation")?,
            act_plan: place(&act, "plan")?,
        })
    }

    /// Runs one timed control step at the bound context, as step number `as_step` of its horizon.
    fn control_step(
        &mut self,
        ports: &Ports,
        as_step: usize,
        seen: usize,
        before: &[f32],
    ) -> Result<Kind, BenchError> {
        let observation = self.episode.observation(seen);
        self.step.write(ports.action, before)?;
        self.step.write(ports.observation, observation)?;
        self.step.call()?;
        let kind = self.episode.kind(as_step);
        if kind == Kind::Decision {
            let index = self.decide(ports.logits)?;
            self.lookup.write_integer(0, index as i64)?;
            self.lookup.call()?;
            self.lookup.read(0, &mut self.plan)?;
        }
        self.act.write(ports.act_plan, &self.plan)?;
        self.act.write(ports.act_observation, observation)?;
        self.act.call()?;
        self.act.read(0, &mut self.action)?;
        self.clip();
        Ok(kind)
    }
}

struct Ports {
    action: usize,
    observation: usize,
    logits: usize,
    act_observation: usize,
    act_plan: usize,
}

fn argmax(logits: &[f32]) -> usize {
    let best = logits
        .iter()
        .enumerate()
        .fold((0, f32::NEG_INFINITY), |best, (i, &x)| {
            if x > best.1 { (i, x) } else { best }
        });
    best.0
}

impl Contender for General<'_> {
    fn name(&self) -> &str {
        &self.name
    }

    fn detail(&self) -> String {
        self.detail.clone()
    }

    fn replay(&mut self, steps: usize) -> Result<Vec<Computed>, BenchError> {
        self.bound = None;
        let mut past = self.beginning()?;
        let mut in_force = 0;
        let mut computed = vec![];
        for step in 0..steps {
            let best = self.advance(step, &mut past)?;
            if self.episode.decides(step) {
                in_force = best;
            }
            computed.push(Computed {
                selected: Some(in_force),
                action: past.action.clone(),
            });
        }
        Ok(computed)
    }

    fn offers(&self, work: Work) -> bool {
        !matches!(work, Work::Recompute { .. })
    }

    fn block(&mut self, block: &Block, samples: &mut Vec<Sample>) -> Result<(), BenchError> {
        match block.work {
            Work::Act => {
                self.bind(1)?;
                let ports = self.ports()?;
                measure(block, samples, |number| {
                    self.act.write(ports.act_plan, &self.plan)?;
                    self.act
                        .write(ports.act_observation, self.episode.observation(number))?;
                    self.act.call()?;
                    self.act.read(0, &mut self.action)?;
                    self.clip();
                    Ok((Kind::Act, 0))
                })
            }
            Work::Steps { first } => {
                let middle = block.middle().max(1);
                self.bind(middle)?;
                let ports = self.ports()?;
                let before = self.action.clone();
                measure(block, samples, |number| {
                    let step = (first + number).saturating_sub(block.settle);
                    let kind = self.control_step(&ports, step, step, &before)?;
                    Ok((kind, middle))
                })
            }
            Work::Instruct => {
                self.bound = None;
                self.instruct
                    .bind(&[("high_level/instruct/words".into(), &self.words)])?;
                measure(block, samples, |_| {
                    self.instruct.call().map(|()| (Kind::Instruct, 0))
                })
            }
            Work::Recompute { .. } => {
                let wrong = "it keeps keys and values, and recomputes nothing";
                Err(failed(&self.name, wrong))
            }
        }
    }
}
