//! One episode: the compiled policy drives an environment until its commanded sub-tasks are done or the episode is full.
//!
//! Invariants: what happens depends only on the policy, the environment's seed and the decision rule; the controller is the one that runs
//! on a robot, with memory allocated once per driver. What can fail: the controller refuses an observation, or the environment an action.

use std::time::{Duration, Instant};

use lads_core::{
    ChannelId, Controller, DType, Data, Decision, FollowError, Instruction, InstructionError,
    Noise, Selected, StepError,
};
use rustix::time::{ClockId, clock_gettime};
use thiserror::Error;

pub use lads_proof::episode::Episode;
pub use lads_proof::timing::Timing;

use crate::environment::{ActionError, Environment, EpisodeSeed};
use crate::faults::{Faults, Link};
use crate::random::Stream;
use crate::sight::{Sight, SightError};
use crate::trace::Step;

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
    /// The policy refused a plan that it was to follow.
    #[error("the policy gives no action for the plan of control step {step}: {error}")]
    Follow {
        /// Control step, from 0.
        step: usize,
        /// The controller's reason.
        error: FollowError,
    },
    /// The environment refused an action.
    #[error("the environment refuses the action of control step {step}: {error}")]
    Action {
        /// Control step, from 0.
        step: usize,
        /// The environment's reason.
        error: ActionError,
    },
    /// A camera of the policy shows nothing.
    #[error("control step {step} has no frame: {error}")]
    Sight {
        /// Control step, from 0.
        step: usize,
        /// The reason.
        error: SightError,
    },
    /// Who looks on has seen enough.
    #[error("stopped while it was looked at")]
    Stopped,
}

/// An episode as it stands, for who looks on.
pub struct Glimpse<'g> {
    /// Which episode.
    pub task: &'g Task<'g>,
    /// How far it is.
    pub stand: Stand,
    /// To look at, not to change.
    pub environment: &'g mut dyn Environment,
}

/// How far an episode is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stand {
    /// The next action is about to be executed.
    Acting {
        /// The plan in force; `None` of a policy that selects none.
        plan: Option<u32>,
    },
    /// The last action was executed.
    Ended {
        /// Whether the instruction was carried out.
        success: bool,
    },
}

/// How an episode that is looked at goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Go {
    /// With the next control step.
    On,
    /// From its start, as it was.
    Again,
    /// Not at all.
    Stop,
}

/// Looks on while episodes run, at every control step between decision and action, and once after the last. It may take its time.
pub trait Onlooker: std::fmt::Debug + Sync {
    /// One control step.
    fn look(&self, glimpse: Glimpse<'_>) -> Go;
}

/// Who acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Actor {
    /// The policy.
    #[default]
    Policy,
    /// Nobody: actions are uniform in the contract's limits. The floor that policies are measured against.
    Uniform,
}

/// Fourth number of the entropy of the stream that uniform actions are drawn from.
const UNIFORM_STREAM: u64 = 3;

/// Which episode to run.
#[derive(Debug, Clone)]
pub struct Task<'t> {
    /// Index of the instruction in the policy's table.
    pub instruction: u32,
    /// Word embeddings `[n, E]` that are heard instead of that instruction's.
    pub words: Option<&'t [f32]>,
    /// Indices, in the environment's list, of the sub-tasks that the instruction commands; with none there is nothing to carry out, and the
    /// episode lasts its full time.
    pub commanded: &'t [usize],
    /// Control steps after which the episode ends.
    pub max_steps: usize,
    /// Random streams of the environment.
    pub seed: EpisodeSeed,
    /// How plans are chosen, with the seed of this episode where they are sampled.
    pub decision: Decision,
    /// What else the policy draws at random, with the seed of this episode.
    pub noise: Noise,
    /// Who acts.
    pub actor: Actor,
    /// What is wrong between policy and environment.
    pub faults: Faults,
    /// Plans that the policy is to follow; the episode ends with them. `None`: the policy decides.
    pub plans: Option<Commanded<'t>>,
}

/// Plans that are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Commanded<'t> {
    /// In order.
    pub plans: &'t [u32],
    /// Control steps that each is followed for.
    pub period: usize,
}

/// CPU time that this thread has used: unlike the wall clock's, its differences do not depend on what else the machine does.
fn cpu_time() -> Duration {
    // The clock starts at zero, so it always converts.
    Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).unwrap_or_default()
}

/// CPU time that this thread has used since it was `earlier`.
fn cpu_since(earlier: Duration) -> Duration {
    cpu_time().saturating_sub(earlier)
}

/// A controller in an environment, for one episode after the other.
pub struct Driver<'a, 'm, 'e> {
    controller: Controller<'a, 'm>,
    environment: &'e mut dyn Environment,
    /// The channel that the vector of numbers goes to; `None` of a policy that has cameras alone.
    channel: Option<ChannelId>,
    sight: Sight,
    observation: Vec<f32>,
    action: Vec<f32>,
    executed: Vec<f32>,
    command: Vec<f64>,
    limits: Vec<(f64, f64)>,
    /// Plans decided in the episode.
    plans: Vec<u32>,
    /// Control steps of the episode, where they are kept.
    recording: Option<Vec<Step>>,
    onlooker: Option<&'e dyn Onlooker>,
    /// What was measured so far.
    pub timing: Timing,
}

impl<'a, 'm, 'e> Driver<'a, 'm, 'e> {
    /// Joins a controller and an environment that were checked to fit (see [`crate::fit`]), with the policy's cameras.
    pub fn new(
        controller: Controller<'a, 'm>,
        environment: &'e mut dyn Environment,
        sight: Sight,
    ) -> Self {
        let contract = controller.policy().contract();
        let limits = contract.action_limits();
        let limits = limits.map(|limits| (f64::from(limits.min), f64::from(limits.max)));
        let limits = limits.collect();
        let mut seen = contract.observations();
        let channel = seen.find(|channel| channel.dtype() == DType::F32);
        let (observation_len, action_len) =
            (environment.observation_len(), environment.action_len());
        Self {
            controller,
            environment,
            channel: channel.map(|channel| channel.id()),
            sight,
            observation: vec![0.0; observation_len],
            action: vec![0.0; action_len],
            executed: vec![0.0; action_len],
            command: vec![0.0; action_len],
            limits,
            plans: Vec::new(),
            recording: None,
            onlooker: None,
            timing: Timing::default(),
        }
    }

    /// Keeps the control steps of the episodes to come, for [`take_recording`](Self::take_recording).
    pub fn record(&mut self) {
        self.recording = Some(Vec::new());
    }

    /// The control steps of the last episode; empty where none were kept.
    pub fn take_recording(&mut self) -> Vec<Step> {
        self.recording
            .as_mut()
            .map(std::mem::take)
            .unwrap_or_default()
    }

    /// What the last episode came to as far as it got, also where [`run`](Self::run) has failed.
    pub fn outcome(&self, task: &Task<'_>) -> Episode {
        Episode {
            steps: self.environment.steps(),
            success: self.succeeded(task),
            completions: self.environment.completions().to_vec(),
            plans: self.plans.clone(),
            final_state: self.environment.state().to_vec(),
        }
    }

    /// Lets someone look on at the policy's episodes to come.
    pub fn show(&mut self, onlooker: Option<&'e dyn Onlooker>) {
        self.onlooker = onlooker;
    }

    /// Runs one episode to its end: the instruction is carried out, or the steps or the commanded plans are used up.
    pub fn run(&mut self, task: &Task<'_>) -> Result<Episode, RolloutError> {
        let episode_cpu = cpu_time();
        let episode = loop {
            if let Some(episode) = self.attempt(task)? {
                break episode;
            }
        };
        self.timing.episodes_cpu += cpu_since(episode_cpu);
        Ok(episode)
    }

    /// An episode; `None` if who looks on wants it again.
    fn attempt(&mut self, task: &Task<'_>) -> Result<Option<Episode>, RolloutError> {
        if let Some(recording) = &mut self.recording {
            recording.clear();
        }
        self.instruct(task)?;
        let reset_cpu = cpu_time();
        self.environment.reset(task.seed, task.commanded);
        let mut link = Link::new(task.faults, task.seed);
        let sees = task.actor == Actor::Policy;
        self.sense(&mut link, sees, 0)?;
        self.executed.fill(0.0);
        self.timing.simulator_cpu += cpu_since(reset_cpu);

        let most = task.plans.map_or(task.max_steps, |given| {
            let steps = given.plans.len().saturating_mul(given.period);
            task.max_steps.min(steps)
        });
        self.plans.clear();
        let mut uniform = task.actor.stream(task.seed);
        let mut step = 0;
        while step < most && !self.succeeded(task) {
            match &mut uniform {
                None => {
                    let (selected, elapsed_ns) = self.decide(step, task.plans)?;
                    let fresh = selected.filter(|selected| selected.fresh);
                    self.plans.extend(fresh.map(|selected| selected.index));
                    let plan = selected.map(|selected| selected.index);
                    match self.look(task, Stand::Acting { plan }) {
                        Go::On => {}
                        Go::Again => return Ok(None),
                        Go::Stop => return Err(RolloutError::Stopped),
                    }
                    let before_cpu = cpu_time();
                    link.actuate(&self.action, &mut self.executed);
                    self.keep(selected, elapsed_ns, task.plans.is_some());
                    self.execute(step)?;
                    self.timing.simulator_cpu += cpu_since(before_cpu);
                }
                Some(stream) => self.uniform_step(step, stream)?,
            }
            step += 1;
            self.sense(&mut link, sees, step)?;
        }
        let success = self.succeeded(task);
        let go = self.look(task, Stand::Ended { success });
        Ok((go != Go::Again).then(|| self.outcome(task)))
    }

    /// Shows the episode as it stands to who looks on.
    fn look(&mut self, task: &Task<'_>, stand: Stand) -> Go {
        self.onlooker.map_or(Go::On, |onlooker| {
            onlooker.look(Glimpse {
                task,
                stand,
                environment: &mut *self.environment,
            })
        })
    }

    fn succeeded(&self, task: &Task<'_>) -> bool {
        !task.commanded.is_empty() && self.environment.succeeded(task.commanded)
    }

    fn instruct(&mut self, task: &Task<'_>) -> Result<(), RolloutError> {
        self.controller.set_decision(task.decision);
        self.controller.set_noise(task.noise);
        let instruction = task
            .words
            .map_or(Instruction::Id(task.instruction), Instruction::Words);
        let (start, start_cpu) = (Instant::now(), cpu_time());
        let known = self.controller.set_instruction(instruction);
        self.timing.controller_cpu += cpu_since(start_cpu);
        self.timing.instruct_ns.push(nanoseconds(start.elapsed()));
        known.map_err(RolloutError::Instruction)
    }

    fn uniform_step(&mut self, step: usize, stream: &mut Stream) -> Result<(), RolloutError> {
        for (command, &(low, high)) in self.command.iter_mut().zip(&self.limits) {
            *command = stream.uniform(low, high);
        }
        let before_cpu = cpu_time();
        let done = self.environment.step(&self.command);
        done.map_err(|error| RolloutError::Action { step, error })?;
        self.timing.simulator_cpu += cpu_since(before_cpu);
        Ok(())
    }

    /// The policy's action for what it sees: what was selected for it, and how long that took in nanoseconds.
    fn decide(
        &mut self,
        step: usize,
        commanded: Option<Commanded<'_>>,
    ) -> Result<(Option<Selected>, u64), RolloutError> {
        let numbers = Data::F32(&self.observation);
        let numbers = self.channel.map(|channel| (channel, numbers));
        let seen: Vec<_> = numbers.into_iter().chain(self.sight.given()).collect();
        let before_cpu = cpu_time();
        let start = Instant::now();
        let given = commanded.and_then(|given| {
            let period = given.period.max(1);
            Some((*given.plans.get(step / period)?, period))
        });
        let selected = match given {
            None => self
                .controller
                .step_with(&seen, &mut self.action)
                .map_err(|error| RolloutError::Step { step, error })
                .map(|report| report.selected),
            Some((index, period)) => self
                .controller
                .follow(&seen, index, &mut self.action)
                .map_err(|error| RolloutError::Follow { step, error })
                .map(|()| {
                    Some(Selected {
                        index,
                        margin: f32::INFINITY,
                        fresh: step.is_multiple_of(period),
                    })
                }),
        };
        let elapsed_ns = nanoseconds(start.elapsed());
        self.timing.controller_cpu += cpu_since(before_cpu);
        let selected = selected?;
        if selected.is_some_and(|selected| selected.fresh) {
            self.timing.decision_ns.push(elapsed_ns);
        } else {
            self.timing.ordinary_ns.push(elapsed_ns);
        }
        Ok((selected, elapsed_ns))
    }

    /// Lets what the policy sees follow the environment, as far as the link lets it through; `step` sees it. Only who `sees`
    /// needs frames.
    fn sense(&mut self, link: &mut Link, sees: bool, step: usize) -> Result<(), RolloutError> {
        let (observation, state) = (self.environment.observation(), self.environment.state());
        link.sense(observation, state, &mut self.observation);
        if sees {
            let looked = self.sight.look(state);
            looked.map_err(|error| RolloutError::Sight { step, error })?;
        }
        Ok(())
    }

    /// Hands the environment the action that the actuators execute.
    fn execute(&mut self, step: usize) -> Result<(), RolloutError> {
        for (command, &action) in self.command.iter_mut().zip(&self.executed) {
            *command = f64::from(action);
        }
        self.environment
            .step(&self.command)
            .map_err(|error| RolloutError::Action { step, error })?;
        Ok(())
    }

    /// Records the step, where steps are kept.
    fn keep(&mut self, selected: Option<Selected>, controller_ns: u64, commanded: bool) {
        let Some(recording) = &mut self.recording else {
            return;
        };
        let decided = selected.is_some_and(|selected| selected.fresh);
        let scores = if decided && !commanded {
            self.controller.scores()
        } else {
            &[]
        };
        let margin = selected.map(|selected| selected.margin);
        recording.push(Step {
            observation: (self.channel)
                .map(|_| self.observation.clone())
                .unwrap_or_default(),
            action: self.action.clone(),
            executed: self.executed.clone(),
            plan: selected.map(|selected| selected.index),
            decided,
            margin: margin.filter(|margin| margin.is_finite()),
            scores: scores.to_vec(),
            controller_ns,
            gripper: self.environment.gripper(),
        });
    }
}

impl Actor {
    fn stream(self, seed: EpisodeSeed) -> Option<Stream> {
        let [run, instruction, episode] = seed.entropy();
        let entropy = [run, instruction, episode, UNIFORM_STREAM];
        (self == Self::Uniform).then(|| Stream::new(&entropy))
    }
}

fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}
