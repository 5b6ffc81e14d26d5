//! One episode: the compiled policy drives an environment until its commanded sub-tasks are done or the episode is full.
//!
//! Invariants: what happens depends only on the policy, the environment's seed and the decision rule; the controller is the one that runs
//! on a robot, with memory allocated once per driver. What can fail: the controller refuses an observation, or the environment an action.

use std::time::{Duration, Instant};

use lads_core::{
    Controller, Decision, Instruction, InstructionError, Policy, StepError, Workspace,
    WorkspaceTooSmall,
};
use thiserror::Error;

use crate::environment::{ActionError, Completion, Environment, EpisodeSeed};

/// Why an episode could not be finished.
#[derive(Debug, Error)]
pub enum RolloutError {
    /// The policy does not know the instruction.
    #[error("the policy refuses the instruction: {0}")]
    Instruction(InstructionError),
    /// The controller refused an observation.
    #[error("the controller refuses the observation of control step {step}: {error}")]
    Step {
        /// Control step, from 0.
        step: usize,
        /// The controller's reason.
        error: StepError,
    },
    /// The environment refused an action.
    #[error("the environment refuses the action of control step {step}: {error}")]
    Action {
        /// Control step, from 0.
        step: usize,
        /// The environment's reason.
        error: ActionError,
    },
}

/// Which episode to run.
#[derive(Debug, Clone)]
pub struct Task<'t> {
    /// Index of the instruction in the policy's table.
    pub instruction: u32,
    /// Indices, in the environment's list, of the sub-tasks that the instruction commands.
    pub commanded: &'t [usize],
    /// Random streams of the environment.
    pub seed: EpisodeSeed,
    /// How plans are chosen, with the seed of this episode where they are sampled.
    pub decision: Decision,
}

/// What happened in one episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Episode {
    /// Control steps executed.
    pub steps: usize,
    /// Completed sub-tasks, in order of time.
    pub completions: Vec<Completion>,
    /// Plan indices in the order in which they were decided.
    pub plans: Vec<u32>,
}

/// How long everything took, over all episodes of one driver.
#[derive(Debug, Clone, Default)]
pub struct Timing {
    /// Every control step that kept its plan, in nanoseconds.
    pub ordinary_ns: Vec<u64>,
    /// Every control step that decided a plan, in nanoseconds.
    pub decision_ns: Vec<u64>,
    /// Every change of instruction, in nanoseconds.
    pub instruct_ns: Vec<u64>,
    /// Inside the environment's reset and step, which is physics but for noise and task checks.
    pub simulator: Duration,
    /// Inside episodes as a whole.
    pub episodes: Duration,
}

impl Timing {
    /// Adds another driver's durations.
    pub fn absorb(&mut self, other: Self) {
        self.ordinary_ns.extend(other.ordinary_ns);
        self.decision_ns.extend(other.decision_ns);
        self.instruct_ns.extend(other.instruct_ns);
        self.simulator += other.simulator;
        self.episodes += other.episodes;
    }

    /// Inside the controller, all kinds of calls together.
    pub fn controller(&self) -> Duration {
        let all = [&self.ordinary_ns, &self.decision_ns, &self.instruct_ns];
        Duration::from_nanos(all.into_iter().flatten().sum())
    }
}

/// The memory of one controller, allocated once.
#[derive(Debug)]
pub struct Memory {
    arena: Vec<f32>,
    state: Vec<f32>,
}

impl Memory {
    /// As much as `policy` asks for.
    pub fn of(policy: &Policy<'_>) -> Self {
        Self {
            arena: vec![0.0; policy.arena_len()],
            state: vec![0.0; policy.state_len()],
        }
    }

    /// A controller that works in this memory.
    pub fn controller<'p, 'm>(
        &'m mut self,
        policy: &Policy<'p>,
    ) -> Result<Controller<'p, 'm>, WorkspaceTooSmall> {
        let workspace = Workspace::new(policy, &mut self.arena, &mut self.state)?;
        Ok(Controller::new(*policy, workspace))
    }
}

/// A controller in an environment, for one episode after the other.
pub struct Driver<'a, 'm, 'e> {
    controller: Controller<'a, 'm>,
    environment: &'e mut dyn Environment,
    observation: Vec<f32>,
    action: Vec<f32>,
    command: Vec<f64>,
    /// What was measured so far.
    pub timing: Timing,
}

impl<'a, 'm, 'e> Driver<'a, 'm, 'e> {
    /// Joins a controller and an environment that were checked to fit (see [`crate::fit`]).
    pub fn new(controller: Controller<'a, 'm>, environment: &'e mut dyn Environment) -> Self {
        let (observation_len, action_len) =
            (environment.observation_len(), environment.action_len());
        Self {
            controller,
            environment,
            observation: vec![0.0; observation_len],
            action: vec![0.0; action_len],
            command: vec![0.0; action_len],
            timing: Timing::default(),
        }
    }

    /// Runs one episode to its end: all commanded sub-tasks completed, or the environment's number of steps.
    pub fn run(&mut self, task: &Task<'_>) -> Result<Episode, RolloutError> {
        let start = Instant::now();
        self.controller.set_decision(task.decision);
        let instruct = Instant::now();
        let known = self
            .controller
            .set_instruction(Instruction::Id(task.instruction));
        self.timing
            .instruct_ns
            .push(nanoseconds(instruct.elapsed()));
        known.map_err(RolloutError::Instruction)?;

        let reset = Instant::now();
        narrow(self.environment.reset(task.seed), &mut self.observation);
        self.timing.simulator += reset.elapsed();

        let mut plans = Vec::with_capacity(self.environment.max_steps());
        for step in 0..self.environment.max_steps() {
            if task
                .commanded
                .iter()
                .all(|&sub_task| self.environment.completed_at(sub_task).is_some())
            {
                break;
            }
            self.control_step(step, &mut plans)?;
        }
        self.timing.episodes += start.elapsed();
        Ok(Episode {
            steps: self.environment.steps(),
            completions: self.environment.completions().to_vec(),
            plans,
        })
    }

    fn control_step(&mut self, step: usize, plans: &mut Vec<u32>) -> Result<(), RolloutError> {
        let start = Instant::now();
        let report = self.controller.step(&self.observation, &mut self.action);
        let elapsed_ns = nanoseconds(start.elapsed());
        let report = report.map_err(|error| RolloutError::Step { step, error })?;
        if report.decided {
            plans.push(report.plan.0);
            self.timing.decision_ns.push(elapsed_ns);
        } else {
            self.timing.ordinary_ns.push(elapsed_ns);
        }

        for (command, &action) in self.command.iter_mut().zip(&self.action) {
            *command = f64::from(action);
        }
        let start = Instant::now();
        let observation = self
            .environment
            .step(&self.command)
            .map_err(|error| RolloutError::Action { step, error })?;
        self.timing.simulator += start.elapsed();
        narrow(observation, &mut self.observation);
        Ok(())
    }
}

/// The policy's precision.
fn narrow(from: &[f64], to: &mut [f32]) {
    for (to, &from) in to.iter_mut().zip(from) {
        *to = from as f32;
    }
}

fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}
