//! Interface of a simulated environment, as a rollout needs it; independent of any particular one.
//!
//! Invariants of every implementation: the same [`EpisodeSeed`] and actions give the same observations, bit for bit, on one machine;
//! completions are latched (a sub-task that is undone later still counts) and chronological; an action that is refused changes nothing.

use std::borrow::Cow;
use std::sync::Arc;

use mujoco_rs::wrappers::{MjData, MjModel};
use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use lads_proof::episode::Completion;

use crate::frames::Rendering;

/// Simulator state and viewpoint, for pictures.
pub struct Stage<'e> {
    /// The simulator's state; drawing it changes nothing that the next control step depends on.
    pub data: &'e mut MjData<Arc<MjModel>>,
    /// Viewpoint of the camera.
    pub view: View,
}

/// Viewpoint of a camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum View {
    /// A camera of the scene, by its name.
    Camera(Cow<'static, str>),
    /// A camera outside the scene's description.
    Free {
        /// Point that the camera looks at, in metres in the world's frame.
        look_at: [f64; 3],
        /// Distance of the camera from `look_at`, in metres.
        distance: f64,
        /// Azimuth of the camera, degrees around the vertical.
        azimuth: f64,
        /// Elevation of the camera, degrees above the horizon.
        elevation: f64,
    },
}

/// Identifies one episode's random stream: the run's seed, the index of the instruction, the number of the episode.
///
/// An environment draws everything random from `numpy.random.default_rng([seed, instruction, episode])`, see [`crate::random`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct EpisodeSeed {
    /// Seed of the whole run.
    pub seed: u64,
    /// Index of the instruction in its list.
    pub instruction: u64,
    /// Number of the episode among those of the instruction.
    pub episode: u64,
}

impl EpisodeSeed {
    /// Entropy of the stream: seed, instruction and episode, as numpy's `default_rng` takes them.
    pub fn entropy(self) -> [u64; 3] {
        [self.seed, self.instruction, self.episode]
    }
}

/// Why an action cannot be executed. The environment is unchanged.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum ActionError {
    /// The action has another length than the environment's.
    #[error("the action has {got} elements, the environment takes {needed}")]
    WrongLen {
        /// Elements of the action.
        got: usize,
        /// Elements that [`Environment::action_len`] asks for.
        needed: usize,
    },
    /// An element is NaN or infinite.
    #[error("element {index} of the action is not finite")]
    NotFinite {
        /// Index of the first such element.
        index: usize,
    },
}

/// What an environment is, and what its observations and actions consist of.
#[derive(Clone, Copy, Debug)]
pub struct Description {
    /// Name as in a bundle's contract, for example `franka-kitchen`.
    pub id: &'static str,
    /// Version of the environment's behaviour, as in a bundle's contract.
    pub version: &'static str,
    /// Time between two control steps, in seconds.
    pub control_period_s: f64,
    /// Name of every element of an observation.
    pub observation_names: &'static [&'static str],
    /// Name of every element of an action.
    pub action_names: &'static [&'static str],
    /// Names of the sub-tasks that are watched, in a fixed order.
    pub sub_tasks: &'static [&'static str],
}

/// A simulated environment that runs in control steps.
///
/// Observations and states are in the simulator's own precision; a policy takes them as `f32`.
pub trait Environment: Send {
    /// What it is, and what its observations and actions consist of.
    fn description(&self) -> &Description;
    /// Control steps of a full episode of an instruction in `split`. The caller ends the episode; stepping on is allowed.
    fn max_steps(&self, split: &str) -> usize;

    /// Starts an episode that is to complete the sub-tasks `commanded` (indices in [`Environment::sub_tasks`]) and returns its first
    /// observation. Benchmarks prepare the objects that an instruction speaks of; without commanded sub-tasks the start is random.
    fn reset(&mut self, seed: EpisodeSeed, commanded: &[usize]) -> &[f64];
    /// Applies `action` for one control period and returns the observation after it.
    fn step(&mut self, action: &[f64]) -> Result<&[f64], ActionError>;

    /// The latest observation, as a policy sees it.
    fn observation(&self) -> &[f64];
    /// Noise-free quantities behind the latest observation, in the same order.
    fn state(&self) -> &[f64];
    /// Number of control steps since the reset.
    fn steps(&self) -> usize;
    /// Completions since the reset, in the order in which they happened.
    fn completions(&self) -> &[Completion];

    /// Whether an instruction that commands these sub-tasks is carried out at this moment: each was completed at some time, unless the
    /// environment asks for more.
    fn succeeded(&self, commanded: &[usize]) -> bool {
        commanded
            .iter()
            .all(|&sub_task| self.completed_at(sub_task).is_some())
    }

    /// Position of the gripper, in metres in the world's frame, for pictures; `None` in an environment without one.
    fn gripper(&self) -> Option<[f64; 3]> {
        None
    }

    /// Simulator state and viewpoint for pictures; `None` in an environment without a simulator.
    fn stage(&mut self) -> Option<Stage<'_>> {
        None
    }

    /// Rendering of the benchmark's images; `None` in an environment without images.
    fn rendering(&self) -> Option<Rendering> {
        None
    }

    /// The scene for drawing its states, with meshes whose details are smaller than this many metres put together
    /// ([`crate::frames::thin`]), or whole where it is 0; `None` in an environment without a simulator.
    fn scenery(&self, mesh_cell_m: f64) -> Option<Result<MjModel, String>> {
        let _ = mesh_cell_m;
        None
    }

    /// Name as in a bundle's contract.
    fn id(&self) -> &'static str {
        self.description().id
    }
    /// Version of the environment's behaviour.
    fn version(&self) -> &'static str {
        self.description().version
    }
    /// Time between two control steps, in seconds.
    fn control_period_s(&self) -> f64 {
        self.description().control_period_s
    }
    /// Name of every element of an observation.
    fn observation_names(&self) -> &'static [&'static str] {
        self.description().observation_names
    }
    /// Name of every element of an action.
    fn action_names(&self) -> &'static [&'static str] {
        self.description().action_names
    }
    /// Names of the sub-tasks that are watched, in a fixed order.
    fn sub_tasks(&self) -> &'static [&'static str] {
        self.description().sub_tasks
    }
    /// Elements of an observation.
    fn observation_len(&self) -> usize {
        self.observation_names().len()
    }
    /// Elements of an action.
    fn action_len(&self) -> usize {
        self.action_names().len()
    }
    /// Control step at which a sub-task was completed, if it was.
    fn completed_at(&self, sub_task: usize) -> Option<usize> {
        self.completions()
            .iter()
            .find(|completion| completion.sub_task == sub_task)
            .map(|completion| completion.step)
    }
}

/// Checks an action's length and values, for implementations of [`Environment::step`].
pub(crate) fn check_action(action: &[f64], needed: usize) -> Result<(), ActionError> {
    if action.len() != needed {
        return Err(ActionError::WrongLen {
            got: action.len(),
            needed,
        });
    }
    match action.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(ActionError::NotFinite { index }),
        None => Ok(()),
    }
}

/// Adds a completion unless the sub-task was completed before, for implementations of
/// [`Environment::step`].
pub fn latch(completions: &mut Vec<Completion>, sub_task: usize, step: usize) {
    if completions.iter().all(|done| done.sub_task != sub_task) {
        completions.push(Completion { sub_task, step });
    }
}
