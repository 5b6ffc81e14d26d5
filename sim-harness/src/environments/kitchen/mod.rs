//! Franka Kitchen in MuJoCo: the paper's environment, in FrankaKitchen-v1's scene.
//!
//! An action asks for joint velocities relative to the *observed* joint positions: `set-point = observed + 2 a * 0.08 s`, clipped, held for
//! 40 physics steps. So observation noise enters the dynamics, and one uniform draw of 30 numbers is taken per observation at every noise
//! level. Completions look at the true positions. Loading the scene can fail, running it cannot.

pub mod spec;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use mujoco_rs::prelude::MjtObjBase;
use mujoco_rs::wrappers::{MjData, MjModel, MjSpec};
use thiserror::Error;

use crate::assets::{MissingAssets, OtherMujoco, asset, check_mujoco, remedy};
use crate::environment::{
    ActionError, Completion, Description, Environment, EpisodeSeed, Stage, View, check_action,
    latch,
};
use crate::frames::{Rendering, thin};
use crate::random::Stream;
pub use spec::Noise;
use spec::{
    ACTION_LEN, ACTION_NAMES, ACTION_SCALE, CONTROL_PERIOD_S, FRAME_SKIP, INITIAL_POSITIONS,
    MAX_STEPS, OBSERVATION_LEN, OBSERVATION_NAMES, SET_POINT_HIGH, SET_POINT_LOW, SUB_TASK_NAMES,
    SUB_TASKS,
};

/// Name of the environment in contracts and datasets.
pub const ID: &str = "franka-kitchen";
/// Version of the environment's behaviour.
pub const VERSION: &str = "1";

const DESCRIPTION: Description = Description {
    id: ID,
    version: VERSION,
    control_period_s: CONTROL_PERIOD_S,
    observation_names: &OBSERVATION_NAMES,
    action_names: &ACTION_NAMES,
    sub_tasks: &SUB_TASK_NAMES,
};

/// Site that marks the gripper in pictures.
const GRIPPER: &str = "end_effector";

/// Viewpoint of FrankaKitchen-v1's own camera.
pub(crate) const VIEW: View = View::Free {
    look_at: [-0.2, 0.5, 2.0],
    distance: 2.2,
    azimuth: 70.0,
    elevation: -35.0,
};

const SCENE: &str = "assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml";

/// Why the scene cannot be loaded.
#[derive(Debug, Error)]
pub enum SceneError {
    /// The assets are missing.
    #[error(transparent)]
    Missing(#[from] MissingAssets),
    /// Another MuJoCo is loaded.
    #[error(transparent)]
    Version(#[from] OtherMujoco),
    /// MuJoCo refused the scene.
    #[error("MuJoCo cannot load {path}: {reason}; {remedy}", remedy = remedy(reason))]
    Refused {
        /// Path of the scene's file.
        path: String,
        /// MuJoCo's reason.
        reason: String,
    },
}

/// The compiled scene. Loaded once (about a second), then shared by all threads.
#[derive(Clone)]
pub struct Scene {
    path: PathBuf,
    model: Arc<MjModel>,
}

impl Scene {
    /// Loads the scene from the folder that `make setup` fills, see [`crate::assets::vendor_dir`].
    pub fn load(vendor: &Path) -> Result<Self, SceneError> {
        check_mujoco()?;
        let path = asset(vendor, SCENE)?;
        let refused = |reason: String| SceneError::Refused {
            path: path.display().to_string(),
            reason,
        };
        let model = MjModel::from_xml(&path).map_err(|error| refused(error.to_string()))?;
        if model.ffi().nq as usize != OBSERVATION_LEN || model.ffi().nu as usize != ACTION_LEN {
            return Err(refused(format!(
                "it has {} positions and {} actuators",
                model.ffi().nq,
                model.ffi().nu
            )));
        }
        let model = Arc::new(model);
        // Every worker needs a state of its own; without memory for one there is nothing to begin.
        MjData::try_new(Arc::clone(&model)).map_err(|error| refused(error.to_string()))?;
        Ok(Self { path, model })
    }
}

/// Franka Kitchen with a simulator state of its own, one per worker.
pub struct Kitchen {
    scene: Scene,
    data: MjData<Arc<MjModel>>,
    /// Index of the site between the fingers.
    gripper: usize,
    amplitudes: [f64; OBSERVATION_LEN],
    stream: Stream,
    observation: [f64; OBSERVATION_LEN],
    steps: usize,
    completions: Vec<Completion>,
}

impl Kitchen {
    /// Makes an environment at the start of episode (0, 0, 0).
    pub fn new(scene: &Scene, noise: Noise) -> Self {
        let mut kitchen = Self {
            scene: scene.clone(),
            data: MjData::new(Arc::clone(&scene.model)),
            // Past the end where the scene has none.
            gripper: scene
                .model
                .name_to_id(MjtObjBase::mjOBJ_SITE, GRIPPER)
                .unwrap_or(usize::MAX),
            amplitudes: noise.amplitudes(),
            stream: Stream::new(&[]),
            observation: [0.0; OBSERVATION_LEN],
            steps: 0,
            completions: Vec::with_capacity(SUB_TASKS.len()),
        };
        let first = EpisodeSeed {
            seed: 0,
            instruction: 0,
            episode: 0,
        };
        kitchen.reset(first, &[]);
        kitchen
    }

    /// Simulator state, which the scripted experts may see and policies may not.
    pub fn physics(&self) -> &MjData<Arc<MjModel>> {
        &self.data
    }

    fn observe(&mut self) {
        for ((seen, truth), amplitude) in self
            .observation
            .iter_mut()
            .zip(self.data.qpos())
            .zip(self.amplitudes)
        {
            *seen = truth + amplitude * self.stream.uniform(-1.0, 1.0);
        }
    }
}

impl Environment for Kitchen {
    fn description(&self) -> &Description {
        &DESCRIPTION
    }

    fn max_steps(&self, _split: &str) -> usize {
        MAX_STEPS
    }

    fn reset(&mut self, seed: EpisodeSeed, _commanded: &[usize]) -> &[f64] {
        self.data.reset();
        self.data.qpos_mut().copy_from_slice(&INITIAL_POSITIONS);
        self.data.forward();
        self.stream = Stream::new(&seed.entropy());
        self.steps = 0;
        self.completions.clear();
        self.observe();
        &self.observation
    }

    fn step(&mut self, action: &[f64]) -> Result<&[f64], ActionError> {
        check_action(action, ACTION_LEN)?;
        for (index, set_point) in self.data.ctrl_mut().iter_mut().enumerate() {
            let velocity = ACTION_SCALE * action[index].clamp(-1.0, 1.0);
            let wanted = self.observation[index] + velocity * CONTROL_PERIOD_S;
            *set_point = wanted.clamp(SET_POINT_LOW[index], SET_POINT_HIGH[index]);
        }
        for _ in 0..FRAME_SKIP {
            self.data.step();
        }
        self.steps += 1;
        for (sub_task, task) in SUB_TASKS.iter().enumerate() {
            if task.is_done(self.data.qpos()) {
                latch(&mut self.completions, sub_task, self.steps);
            }
        }
        self.observe();
        Ok(&self.observation)
    }

    fn observation(&self) -> &[f64] {
        &self.observation
    }

    fn state(&self) -> &[f64] {
        self.data.qpos()
    }

    fn steps(&self) -> usize {
        self.steps
    }

    fn completions(&self) -> &[Completion] {
        &self.completions
    }

    fn gripper(&self) -> Option<[f64; 3]> {
        self.data.site_xpos().get(self.gripper).copied()
    }

    fn stage(&mut self) -> Option<Stage<'_>> {
        Some(Stage {
            data: &mut self.data,
            view: VIEW,
        })
    }

    fn rendering(&self) -> Option<Rendering> {
        Some(spec::rendering(VIEW))
    }

    fn scenery(&self, mesh_cell_m: f64) -> Option<Result<MjModel, String>> {
        let scene = MjSpec::from_xml(&self.scene.path).map_err(|error| error.to_string());
        Some(scene.and_then(|scene| thin::thinned(scene, &self.scene.model, mesh_cell_m)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::assets::vendor_dir;

    const SLIDE: usize = 19;

    #[test]
    fn completions_are_latched_with_the_first_step() {
        let mut kitchen = Kitchen::new(
            &Scene::load(&vendor_dir()).unwrap_or_else(|error| panic!("{error}")),
            Noise::None,
        );
        let mut step_at = |slide: f64| {
            kitchen.data.qpos_mut()[SLIDE] = slide;
            kitchen.step(&[0.0; ACTION_LEN]).unwrap();
            kitchen.completions().to_vec()
        };
        assert_eq!(step_at(0.0), []);
        let once = [Completion {
            sub_task: 5,
            step: 2,
        }];
        assert_eq!(step_at(0.3), once);
        assert_eq!(
            step_at(0.0),
            once,
            "a sub-task that is undone later still counts"
        );
        assert_eq!(step_at(0.3), once, "and counts once");
    }
}
