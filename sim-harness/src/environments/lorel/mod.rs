//! `LOReL`'s table in MuJoCo: a Sawyer arm, a drawer, a faucet and two mugs, with Meta-World's meshes in a scene of our own.
//!
//! An action moves a mocap body that the hand is welded to, so the hand lags behind what was asked for: the displacements add up on the
//! mocap body. Observations are the simulator's positions, without noise. An instruction is carried out when all its sub-tasks hold at one
//! time, relative to the start of the episode. Loading the scene can fail, running it cannot.
//!
//! Settling the hand takes 1000 physics steps and depends on its target alone, so the settled postures are kept: one at home, and
//! [`POSTURES`] above the mugs, each made when it is first needed. Which one an episode gets is drawn like everything else.

pub mod collect;
pub mod label;
pub mod spec;

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use mujoco_rs::prelude::{MjtObjBase, MjtState};
use mujoco_rs::wrappers::{MjData, MjModel, MjSpec};
use thiserror::Error;

use crate::assets::{MissingAssets, OtherMujoco, asset, check_mujoco, remedy};
use crate::environment::{
    ActionError, Completion, Description, Environment, EpisodeSeed, Stage, View, check_action,
    latch,
};
use crate::frames::{Rendering, thin};
use crate::random::Stream;
use spec::{
    ACTION_LEN, ACTION_NAMES, ACTION_SCALE, BLACK_MUG, COMPOSITE, CONTROL_PERIOD_S, DRAWER,
    DRAWER_START, DRAWER_START_TO_CLOSE, DRAWER_START_TO_OPEN, FAUCET, FAUCET_SPREAD,
    FAUCET_SPREAD_COMMANDED, FRAME_SKIP, HAND_ABOVE_MUGS, HAND_FOR_MUG, HAND_FOR_OTHERS, HAND_HOME,
    HAND_SPREAD, HOME, MAX_STEPS, MAX_STEPS_COMPOSITE, MOCAP_HIGH, MOCAP_LOW, MOCAP_QUATERNION,
    MUG_SPREAD, MUG_SPREAD_COMMANDED, MUG_START, OBSERVATION_LEN, OBSERVATION_NAMES, PARKED_MUGS,
    SUB_TASK_NAMES, SUB_TASKS, SubTask, WHITE_MUG,
};

/// Name of the environment in contracts and datasets.
pub const ID: &str = "lorel-table";
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
/// Name of the only noise level, which has no noise.
pub const NOISE: &str = "none";
/// Number of settled postures above the mugs.
pub const POSTURES: usize = 256;

/// Body that marks the gripper in pictures.
const HAND: &str = "hand";
/// Viewpoint of LOReL's images.
pub(crate) const VIEW: View = View::Camera(Cow::Borrowed("cam0"));
const SCENE: &str = include_str!("scene.xml");
/// Folder of the scene's assets in the vendor folder, and one file of it.
const ASSETS: &str = "assets/metaworld";
const ONE_ASSET: &str = "assets/metaworld/meshes/drawer/drawer.stl";
/// Entropy of the streams from which the hand's targets above the mugs are drawn, with the number of the posture.
const POSTURE_STREAM: u64 = 0x706f_7374_7572_6573;
/// Parts of the simulator's state that a time step depends on: all of them.
const FULL_STATE: u32 = MjtState::mjSTATE_INTEGRATION as u32;
const GRIPPER_OPEN: [f64; 2] = [-1.0, 1.0];

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
    #[error("MuJoCo cannot load the LOReL table: {0}; {remedy}", remedy = remedy(.0))]
    Refused(String),
}

/// The compiled scene and the settled postures, shared by all threads.
#[derive(Clone)]
pub struct Scene {
    /// Folder of the meshes.
    folder: PathBuf,
    model: Arc<MjModel>,
    postures: Arc<[OnceLock<Box<[f64]>>]>,
}

impl Scene {
    /// Loads the scene with the meshes in the folder that `make setup` fills, see [`crate::assets::vendor_dir`].
    pub fn load(vendor: &Path) -> Result<Self, SceneError> {
        check_mujoco()?;
        asset(vendor, ONE_ASSET)?;
        let refused = |reason: String| SceneError::Refused(reason);
        let folder = vendor.join(ASSETS);
        let model = specification(&folder)
            .map_err(refused)?
            .compile()
            .map_err(|error| refused(error.to_string()))?;
        let model = Arc::new(model);
        // Every worker needs a state of its own; without memory for one there is nothing to begin.
        MjData::try_new(Arc::clone(&model)).map_err(|error| refused(error.to_string()))?;
        Ok(Self {
            folder,
            model,
            postures: (0..=POSTURES).map(|_| OnceLock::new()).collect(),
        })
    }

    /// Simulator state with the hand at rest: posture 0 at home, the others above the mugs.
    fn settled(&self, posture: usize) -> &[f64] {
        self.postures[posture].get_or_init(|| {
            let mut hand = HAND_HOME;
            if posture > 0 {
                let mut stream = Stream::new(&[POSTURE_STREAM, posture as u64]);
                let [x, y, z] = HAND_ABOVE_MUGS;
                let mut near = |middle| stream.uniform(middle - HAND_SPREAD, middle + HAND_SPREAD);
                hand = [near(x), near(y), z];
            }
            let mut data = MjData::new(Arc::clone(&self.model));
            let positions = data.qpos_mut();
            positions[..HOME.len()].copy_from_slice(&HOME);
            positions[WHITE_MUG..FAUCET].copy_from_slice(&PARKED_MUGS);
            data.mocap_quat_mut()[0] = MOCAP_QUATERNION;
            data.mocap_pos_mut()[0] = HAND_HOME;
            data.forward();
            data.mocap_pos_mut()[0] = hand;
            data.ctrl_mut().copy_from_slice(&GRIPPER_OPEN);
            advance(&mut data, 100 * FRAME_SKIP);
            data.ctrl_mut().fill(0.0);
            advance(&mut data, 100 * FRAME_SKIP);
            data.state(FULL_STATE)
        })
    }
}

/// The scene before it is compiled, with the meshes of a folder.
fn specification(folder: &Path) -> Result<MjSpec, String> {
    let mut scene = MjSpec::from_xml_string(SCENE).map_err(|error| error.to_string())?;
    let named = folder.to_str();
    scene.set_modelfiledir(named.ok_or_else(|| format!("{} is not UTF-8", folder.display()))?);
    Ok(scene)
}

fn advance(data: &mut MjData<Arc<MjModel>>, physics_steps: usize) {
    for _ in 0..physics_steps {
        data.step();
    }
}

/// The `LOReL` table with a simulator state of its own, one per worker.
pub struct Lorel {
    scene: Scene,
    data: MjData<Arc<MjModel>>,
    /// Index of the body that carries the fingers.
    hand: usize,
    start: [f64; OBSERVATION_LEN],
    steps: usize,
    completions: Vec<Completion>,
}

impl Lorel {
    /// Makes an environment at the start of episode (0, 0, 0).
    pub fn new(scene: &Scene) -> Self {
        let mut lorel = Self {
            scene: scene.clone(),
            data: MjData::new(Arc::clone(&scene.model)),
            // Past the end where the scene has none.
            hand: scene
                .model
                .name_to_id(MjtObjBase::mjOBJ_BODY, HAND)
                .unwrap_or(usize::MAX),
            start: [0.0; OBSERVATION_LEN],
            steps: 0,
            completions: Vec::with_capacity(SUB_TASKS.len()),
        };
        let first = EpisodeSeed {
            seed: 0,
            instruction: 0,
            episode: 0,
        };
        lorel.reset(first, &[]);
        lorel
    }

    /// Places everything for the start of a recorded trajectory: the hand at rest, everything else at random.
    fn scatter(&mut self, stream: &mut Stream) {
        let posture = if stream.unit() < 0.5 {
            0
        } else {
            1 + (stream.unit() * POSTURES as f64) as usize
        };
        let settled = self.scene.settled(posture);
        // The state comes from this model, so its length fits.
        let _ = self.data.set_state(settled, FULL_STATE);
        let positions = self.data.qpos_mut();
        for mug in [WHITE_MUG, BLACK_MUG] {
            place_mug(&mut positions[mug..], MUG_SPREAD, stream);
        }
        positions[FAUCET] = stream.uniform(-FAUCET_SPREAD, FAUCET_SPREAD);
        let [low, high] = DRAWER_START;
        positions[DRAWER] = stream.uniform(low, high);
        self.data.forward();
        advance(&mut self.data, 100);
    }

    /// Places everything for the start of an evaluation: the objects that the instruction speaks of, in the order of the sub-tasks, then
    /// the hand.
    fn prepare(&mut self, commanded: &[usize], stream: &mut Stream) {
        let positions = self.data.qpos_mut();
        let mut hand = HAND_FOR_OTHERS;
        let tasks = SUB_TASKS.iter().enumerate();
        for (_, task) in tasks.filter(|(index, _)| commanded.contains(index)) {
            match *task {
                SubTask {
                    element: DRAWER,
                    sign,
                    ..
                } => {
                    let opens = sign < 0.0;
                    let [low, high] = if opens {
                        DRAWER_START_TO_OPEN
                    } else {
                        DRAWER_START_TO_CLOSE
                    };
                    positions[DRAWER] = stream.uniform(low, high);
                }
                SubTask {
                    element: FAUCET, ..
                } => {
                    let spread = FAUCET_SPREAD_COMMANDED;
                    positions[FAUCET] = stream.uniform(-spread, spread);
                }
                SubTask { element, .. } => {
                    let mug = if element < BLACK_MUG {
                        WHITE_MUG
                    } else {
                        BLACK_MUG
                    };
                    place_mug(&mut positions[mug..], MUG_SPREAD_COMMANDED, stream);
                    hand = HAND_FOR_MUG;
                }
            }
        }
        self.data.forward();
        self.data.mocap_pos_mut()[0] = hand;
        self.data.ctrl_mut().copy_from_slice(&GRIPPER_OPEN);
        advance(&mut self.data, 100 * FRAME_SKIP + 50);
        self.data.qvel_mut().fill(0.0);
        self.data.qacc_mut().fill(0.0);
        advance(&mut self.data, 1);
    }
}

fn place_mug(position: &mut [f64], spread: f64, stream: &mut Stream) {
    for (coordinate, middle) in position.iter_mut().zip(MUG_START) {
        *coordinate = middle + stream.uniform(-spread, spread);
    }
}

impl Environment for Lorel {
    fn description(&self) -> &Description {
        &DESCRIPTION
    }

    fn max_steps(&self, split: &str) -> usize {
        if split.starts_with(COMPOSITE) {
            MAX_STEPS_COMPOSITE
        } else {
            MAX_STEPS
        }
    }

    fn reset(&mut self, seed: EpisodeSeed, commanded: &[usize]) -> &[f64] {
        let mut stream = Stream::new(&seed.entropy());
        self.scatter(&mut stream);
        if !commanded.is_empty() {
            self.prepare(commanded, &mut stream);
        }
        self.start.copy_from_slice(self.data.qpos());
        self.steps = 0;
        self.completions.clear();
        self.data.qpos()
    }

    fn step(&mut self, action: &[f64]) -> Result<&[f64], ActionError> {
        check_action(action, ACTION_LEN)?;
        let mocap = &mut self.data.mocap_pos_mut()[0];
        for (axis, position) in mocap.iter_mut().enumerate() {
            let moved = *position + ACTION_SCALE * action[axis].clamp(-1.0, 1.0);
            *position = moved.clamp(MOCAP_LOW[axis], MOCAP_HIGH[axis]);
        }
        let gripper = action[ACTION_LEN - 1];
        self.data.ctrl_mut().copy_from_slice(&[gripper, -gripper]);
        advance(&mut self.data, FRAME_SKIP);
        self.steps += 1;
        for (sub_task, task) in SUB_TASKS.iter().enumerate() {
            if task.holds(&self.start, self.data.qpos()) {
                latch(&mut self.completions, sub_task, self.steps);
            }
        }
        Ok(self.data.qpos())
    }

    fn observation(&self) -> &[f64] {
        self.data.qpos()
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
        self.data.xpos().get(self.hand).copied()
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
        let Scene { folder, model, .. } = &self.scene;
        let scene = specification(folder);
        Some(scene.and_then(|scene| thin::thinned(scene, model, mesh_cell_m)))
    }

    fn succeeded(&self, commanded: &[usize]) -> bool {
        let tasks = commanded.iter().filter_map(|&index| SUB_TASKS.get(index));
        tasks
            .into_iter()
            .all(|task| task.holds(&self.start, self.data.qpos()))
    }
}
