//! Runs one episode: the compiled policy drives an environment until its commanded sub-tasks are done or the episode is full.
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
    /// A camera of the policy has no frame.
    #[error("control step {step} has no frame: {error}")]
    Sight {
        /// Control step, from 0.
        step: usize,
        /// The reason.
        error: SightError,
    },
    /// The observer stopped the episode.
    #[error("stopped by its observer")]
    Stopped,
}

/// State of a running episode, as passed to its [`Observer`].
pub struct Snapshot<'g> {
    /// The episode's task: instruction, seed, limits.
    pub task: &'g Task<'g>,
    /// Whether a control step is about to be executed, or the last one was.
    pub phase: Phase,
    /// The environment in its present state; mutable only because rendering needs it, not to be changed.
    pub environment: &'g mut dyn Environment,
}

/// Phase of an episode at the moment it is observed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// The next action is about to be executed.
    Acting {
        /// Plan in force; `None` if the policy selects none.
        plan: Option<u32>,
    },
    /// The last action was executed.
    Ended {
        /// Whether the instruction was carried out.
        success: bool,
    },
}

/// An [`Observer`]'s decision on how its episode continues.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Executes the next control step.
    Continue,
    /// Runs the same episode again from its start.
    Restart,
    /// Ends the run.
    Stop,
}

/// Observes running episodes: at every control step between decision and action, and once after the last. It may block.
pub trait Observer: std::fmt::Debug + Sync {
    /// Called at each control step and once at the end of the episode; says how the episode continues.
    fn observe(&self, snapshot: Snapshot<'_>) -> Control;
}

/// Control steps of a recorded episode that keep what the cameras showed, as files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pictures {
    /// None of them.
    #[default]
    None,
    /// The first, and those that decide a plan.
    Decisions,
    /// All of them.
    All,
}

/// Source of the actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Actor {
    /// The policy chooses the actions.
    #[default]
    Policy,
    /// Actions are uniform in the contract's limits: the floor that policies are measured against. The floor that policies are measured
    /// against.
    Uniform,
}

/// Fourth number of the entropy of the stream that uniform actions are drawn from.
const UNIFORM_STREAM: u64 = 3;

/// The episode to run.
#[derive(Debug, Clone)]
pub struct Task<'t> {
    /// Index of the instruction in the policy's table.
    pub instruction: u32,
    /// Word embeddings `[n, E]` that replace those of the instruction.
    pub words: Option<&'t [f32]>,
    /// Indices, in the environment's list, of the sub-tasks that the instruction commands; if empty, the episode lasts its full time and
    /// has no success.
    pub commanded: &'t [usize],
    /// Number of control steps after which the episode ends.
    pub max_steps: usize,
    /// Random streams of the environment.
    pub seed: EpisodeSeed,
    /// Decision rule for plans, with the seed of this episode where they are sampled.
    pub decision: Decision,
    /// Seeds of the other random draws of the policy, with the seed of this episode.
    pub noise: Noise,
    /// Source of the actions.
    pub actor: Actor,
    /// Faults between policy and environment.
    pub faults: Faults,
    /// Plans that the policy is to follow; the episode ends with them. `None`: the policy decides.
    pub plans: Option<Commanded<'t>>,
}

/// A sequence of plans for the policy to follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Commanded<'t> {
    /// Indices of the plans, in order.
    pub plans: &'t [u32],
    /// Number of control steps for which each plan is followed.
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

/// Runs a controller in an environment, one episode after the other.
pub struct Driver<'a, 'm, 'e> {
    controller: Controller<'a, 'm>,
    environment: &'e mut dyn Environment,
    /// Channel that the vector of numbers goes to; `None` for a policy that has cameras alone.
    channel: Option<ChannelId>,
    /// Cameras of the policy.
    sight: Sight,
    observation: Vec<f32>,
    action: Vec<f32>,
    executed: Vec<f32>,
    command: Vec<f64>,
    limits: Vec<(f64, f64)>,
    /// Plans decided in the episode.
    plans: Vec<u32>,
    /// Control steps of the episode, if they are recorded.
    recording: Option<Vec<Step>>,
    /// Which of them keep what the cameras showed.
    pictures: Pictures,
    observer: Option<&'e dyn Observer>,
    /// Durations measured so far.
    pub timing: Timing,
}

impl<'a, 'm, 'e> Driver<'a, 'm, 'e> {
    /// Joins a controller and an environment whose fit was checked (see [`crate::fit`]), with the policy's cameras.
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
        let observation_len = channel.map_or(0, |channel| channel.len());
        let action_len = environment.action_len();
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
            pictures: Pictures::default(),
            observer: None,
            timing: Timing::default(),
        }
    }

    /// Records the control steps of the episodes that follow, for [`take_recording`](Self::take_recording).
    pub fn record(&mut self, pictures: Pictures) {
        self.recording = Some(Vec::new());
        self.pictures = pictures;
    }

    /// Takes the recorded control steps of the last episode; empty unless [`record`](Self::record) was called.
    pub fn take_recording(&mut self) -> Vec<Step> {
        self.recording
            .as_mut()
            .map(std::mem::take)
            .unwrap_or_default()
    }

    /// Outcome of the last episode as far as it got, also where [`run`](Self::run) has failed.
    pub fn outcome(&self, task: &Task<'_>) -> Episode {
        Episode {
            steps: self.environment.steps(),
            success: self.succeeded(task),
            completions: self.environment.completions().to_vec(),
            plans: self.plans.clone(),
            final_state: self.environment.state().to_vec(),
        }
    }

    /// Sets the observer of the episodes that follow; `None` removes it.
    pub fn set_observer(&mut self, observer: Option<&'e dyn Observer>) {
        self.observer = observer;
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

    /// Runs the episode once; `None` if the observer asked for a restart.
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
                    match self.observe(task, Phase::Acting { plan }) {
                        Control::Continue => {}
                        Control::Restart => return Ok(None),
                        Control::Stop => return Err(RolloutError::Stopped),
                    }
                    let before_cpu = cpu_time();
                    link.actuate(&self.action, &mut self.executed);
                    self.keep(step, (selected, elapsed_ns), task.plans.is_some())?;
                    self.execute(step)?;
                    self.timing.simulator_cpu += cpu_since(before_cpu);
                }
                Some(stream) => self.uniform_step(step, stream)?,
            }
            step += 1;
            self.sense(&mut link, sees, step)?;
        }
        let success = self.succeeded(task);
        let control = self.observe(task, Phase::Ended { success });
        Ok((control != Control::Restart).then(|| self.outcome(task)))
    }

    /// Passes the episode's state to the observer, if there is one.
    fn observe(&mut self, task: &Task<'_>, phase: Phase) -> Control {
        self.observer.map_or(Control::Continue, |observer| {
            observer.observe(Snapshot {
                task,
                phase,
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

    /// Asks the policy for an action: returns its selection, and the time that it took in nanoseconds.
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

    /// Updates what the policy sees from the environment, through the link's faults; `step` is the step that sees
    /// it, and frames are drawn only if it `sees`.
    fn sense(&mut self, link: &mut Link, sees: bool, step: usize) -> Result<(), RolloutError> {
        let (observation, state) = (self.environment.observation(), self.environment.state());
        link.sense(observation, state, &mut self.observation);
        if sees {
            let looked = self.sight.look(state);
            looked.map_err(|error| RolloutError::Sight { step, error })?;
        }
        Ok(())
    }

    /// Applies the executed action to the environment.
    fn execute(&mut self, step: usize) -> Result<(), RolloutError> {
        for (command, &action) in self.command.iter_mut().zip(&self.executed) {
            *command = f64::from(action);
        }
        self.environment
            .step(&self.command)
            .map_err(|error| RolloutError::Action { step, error })?;
        Ok(())
    }

    /// Records the control step, if steps are recorded.
    fn keep(
        &mut self,
        step: usize,
        (selected, controller_ns): (Option<Selected>, u64),
        commanded: bool,
    ) -> Result<(), RolloutError> {
        let Some(recording) = &mut self.recording else {
            return Ok(());
        };
        let decided = selected.is_some_and(|selected| selected.fresh);
        let pictures = match self.pictures {
            Pictures::All => self.sight.pictures(),
            Pictures::Decisions if decided || step == 0 => self.sight.pictures(),
            Pictures::Decisions | Pictures::None => Ok(Vec::new()),
        };
        let pictures = pictures.map_err(|error| RolloutError::Sight { step, error })?;
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
            shown: self.sight.digest(),
            pictures,
        });
        Ok(())
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
