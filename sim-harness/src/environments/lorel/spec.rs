//! Constants of the `LOReL` table.
//!
//! An observation (15) is the simulator's positions as they are: arm joints 0-6 \[rad\], right and left finger \[m\], white and black mug
//! x and y \[m\], faucet \[rad\], drawer \[m\] (0 closed, negative open). On the table, left is +x, right is -x, down is +y, up is -y.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

use crate::environment::View;
use crate::frames::Rendering;

/// Elements of an observation.
pub const OBSERVATION_LEN: usize = 15;
/// Elements of an action: three of the hand's displacement, one without effect, the gripper.
pub const ACTION_LEN: usize = 5;
/// Number of physics steps of 2.5 ms in a control step.
pub const FRAME_SKIP: usize = 5;
/// Control period in seconds.
pub const CONTROL_PERIOD_S: f64 = 0.0125;
/// Number of control steps of an episode, and of a recorded trajectory.
pub const MAX_STEPS: usize = 20;
/// Number of control steps of an episode of the composite splits, which ask for several things.
pub const MAX_STEPS_COMPOSITE: usize = 40;
/// Prefix of the composite splits' names.
pub const COMPOSITE: &str = "composite";

/// Names of the observation's elements, equal to those of the joints in the scene.
pub const OBSERVATION_NAMES: [&str; OBSERVATION_LEN] = [
    "right_j0",
    "right_j1",
    "right_j2",
    "right_j3",
    "right_j4",
    "right_j5",
    "right_j6",
    "r_close",
    "l_close",
    "white_mug_x",
    "white_mug_y",
    "black_mug_x",
    "black_mug_y",
    "faucet",
    "drawer",
];
/// Index of the white mug's x in an observation; its y follows.
pub const WHITE_MUG: usize = 9;
/// Index of the black mug's x in an observation; its y follows.
pub const BLACK_MUG: usize = 11;
/// Index of the faucet in an observation.
pub const FAUCET: usize = 13;
/// Index of the drawer in an observation.
pub const DRAWER: usize = 14;

/// Names of the action's elements.
pub const ACTION_NAMES: [&str; ACTION_LEN] = ["hand_x", "hand_y", "hand_z", "unused", "gripper"];
/// Index of the action element that has no effect.
pub const UNUSED_ACTION: usize = 3;
/// Largest absolute value of the action's elements.
pub const ACTION_LIMITS: [f64; ACTION_LEN] = [1.0, 1.0, 1.0, PI, 1.0];

/// Displacement of the mocap body for an action of 1, in metres.
pub const ACTION_SCALE: f64 = 0.2;
/// Lower corner of the box that the mocap body stays in.
pub const MOCAP_LOW: [f64; 3] = [-0.3, 0.4, 0.0];
/// Upper corner of the box that the mocap body stays in.
pub const MOCAP_HIGH: [f64; 3] = [0.3, 0.8, 0.15];
/// Orientation of the mocap body.
pub const MOCAP_QUATERNION: [f64; 4] = [FRAC_1_SQRT_2, 0.0, FRAC_1_SQRT_2, 0.0];

/// Arm and fingers at rest with the hand at (0, 0.5, 0.07), where every episode's settling starts. The arm's zero posture is stretched out;
/// pulled from there the hand catches the drawer on its way.
pub const HOME: [f64; 9] = [
    1.93333534,
    -0.499194428,
    -0.705384607,
    0.801938933,
    -2.58353956,
    -1.46084202,
    0.0536478328,
    0.04,
    -0.03,
];
/// Position of the mugs while the hand settles, out of its way.
pub const PARKED_MUGS: [f64; 4] = [-0.6, 0.4, -0.6, 0.9];
/// Target at which the hand settles in half of the episodes; in the other half it settles above the mugs, within [`HAND_SPREAD`].
pub const HAND_HOME: [f64; 3] = [0.0, 0.5, 0.07];
/// Middle of the targets above the mugs at which the hand settles.
pub const HAND_ABOVE_MUGS: [f64; 3] = [-0.2, 0.65, 0.07];
/// Half-width of the targets above the mugs at which the hand settles.
pub const HAND_SPREAD: f64 = 0.05;
/// Target of the hand for instructions about a mug.
pub const HAND_FOR_MUG: [f64; 3] = [-0.1, 0.55, 0.1];
/// Target of the hand for instructions that are not about a mug.
pub const HAND_FOR_OTHERS: [f64; 3] = [0.0, 0.45, 0.1];

/// Middle of the mugs' start positions.
pub const MUG_START: [f64; 2] = [-0.2, 0.65];
/// Half-width of a mug's start positions.
pub const MUG_SPREAD: f64 = 0.1;
/// Half-width of a mug's start positions where the instruction speaks of it.
pub const MUG_SPREAD_COMMANDED: f64 = 0.05;
/// Half-width of the faucet's start angles.
pub const FAUCET_SPREAD: f64 = PI / 4.0;
/// Half-width of the faucet's start angles where the instruction speaks of it.
pub const FAUCET_SPREAD_COMMANDED: f64 = PI / 5.0;
/// Range of the drawer's start positions.
pub const DRAWER_START: [f64; 2] = [-0.09, 0.0];
/// Range of the drawer's start positions where it is to be opened.
pub const DRAWER_START_TO_OPEN: [f64; 2] = [-0.05, 0.0];
/// Range of the drawer's start positions where it is to be closed.
pub const DRAWER_START_TO_CLOSE: [f64; 2] = [-0.15, -0.05];

/// Distance that a mug or the drawer must have moved, in metres.
pub const MOVED_M: f64 = 0.02;
/// Angle that the faucet must have turned, in radians.
pub const TURNED_RAD: f64 = PI / 10.0;

/// A sub-task: an element of the observation that must change by more than a threshold, in one direction.
#[derive(Clone, Copy, Debug)]
pub struct SubTask {
    /// Name of the sub-task, as instructions say it.
    pub name: &'static str,
    /// Index of the element in an observation.
    pub element: usize,
    /// Direction of the change: 1 or -1.
    pub sign: f64,
    /// Threshold that the element's change must strictly exceed.
    pub threshold: f64,
}

impl SubTask {
    const fn new(name: &'static str, element: usize, sign: f64, threshold: f64) -> Self {
        Self {
            name,
            element,
            sign,
            threshold,
        }
    }

    /// Whether the sub-task is carried out in `now`, for an episode that began in `start`.
    pub fn holds(&self, start: &[f64; OBSERVATION_LEN], now: &[f64]) -> bool {
        let change = now.get(self.element).unwrap_or(&f64::NAN) - start[self.element];
        self.sign * change > self.threshold
    }
}

/// The sub-tasks, in the order of [`SUB_TASK_NAMES`].
pub const SUB_TASKS: [SubTask; 12] = [
    SubTask::new("open drawer", DRAWER, -1.0, MOVED_M),
    SubTask::new("close drawer", DRAWER, 1.0, MOVED_M),
    SubTask::new("turn faucet left", FAUCET, 1.0, TURNED_RAD),
    SubTask::new("turn faucet right", FAUCET, -1.0, TURNED_RAD),
    SubTask::new("move white mug left", WHITE_MUG, 1.0, MOVED_M),
    SubTask::new("move white mug right", WHITE_MUG, -1.0, MOVED_M),
    SubTask::new("move white mug down", WHITE_MUG + 1, 1.0, MOVED_M),
    SubTask::new("move white mug up", WHITE_MUG + 1, -1.0, MOVED_M),
    SubTask::new("move black mug left", BLACK_MUG, 1.0, MOVED_M),
    SubTask::new("move black mug right", BLACK_MUG, -1.0, MOVED_M),
    SubTask::new("move black mug down", BLACK_MUG + 1, 1.0, MOVED_M),
    SubTask::new("move black mug up", BLACK_MUG + 1, -1.0, MOVED_M),
];

/// Names of the sub-tasks.
pub const SUB_TASK_NAMES: [&str; SUB_TASKS.len()] = {
    let mut names = [""; SUB_TASKS.len()];
    let mut i = 0;
    while i < names.len() {
        names[i] = SUB_TASKS[i].name;
        i += 1;
    }
    names
};

/// The benchmark's images, 64x64 of its own camera, with what cannot be told apart at that size left out: the floor's mirror image, most of
/// the shadow map, the parts of the arm that the camera does not see, and the fine detail of its meshes.
pub fn rendering(view: View) -> Rendering {
    Rendering {
        view,
        size: [64, 64],
        drawn: [64, 64],
        samples: 4,
        shadow_size: 512,
        shadow_clip: 0.3,
        reflections: false,
        hidden: ["base", "head"].map(str::to_owned).to_vec(),
        mesh_cell_m: 0.012,
    }
}
