//! Constants of Franka Kitchen, as in D4RL and Gymnasium-Robotics' FrankaKitchen-v1.
//!
//! Elements of an observation (30): arm joints 1-7 \[rad\], fingers \[m\], four knobs each followed by its burner, light switch and light,
//! slide cabinet \[m\], left and right hinge cabinet, microwave \[rad\], kettle position \[m\] and quaternion (w, x, y, z).

use crate::environment::View;
use crate::frames::Rendering;

/// Elements of an observation, equal to the model's generalised positions.
pub const OBSERVATION_LEN: usize = 30;
/// Elements of an action: seven arm joints, two fingers.
pub const ACTION_LEN: usize = 9;
/// Number of physics steps of 2 ms in a control step.
pub const FRAME_SKIP: usize = 40;
/// Control period in seconds.
pub const CONTROL_PERIOD_S: f64 = 0.08;
/// Number of control steps of an episode.
pub const MAX_STEPS: usize = 280;
/// Joint velocity that an action of 1 asks for, rad/s (fingers: m/s).
pub const ACTION_SCALE: f64 = 2.0;
/// Distance (L2) to the goal below which a sub-task counts as completed.
pub const COMPLETION_DISTANCE: f64 = 0.3;

/// Names of the observation's elements: joints as in the model, the kettle's seven coordinates spelled out.
pub const OBSERVATION_NAMES: [&str; OBSERVATION_LEN] = [
    "robot:panda0_joint1",
    "robot:panda0_joint2",
    "robot:panda0_joint3",
    "robot:panda0_joint4",
    "robot:panda0_joint5",
    "robot:panda0_joint6",
    "robot:panda0_joint7",
    "robot:panda0_finger_joint1",
    "robot:panda0_finger_joint2",
    "knob_Joint_1",
    "bottom_right_burner",
    "knob_Joint_2",
    "bottom_left_burner",
    "knob_Joint_3",
    "top_right_burner",
    "knob_Joint_4",
    "top_left_burner",
    "light_switch",
    "light_joint",
    "slide_cabinet",
    "left_hinge_cabinet",
    "right_hinge_cabinet",
    "microwave",
    "kettle_x",
    "kettle_y",
    "kettle_z",
    "kettle_qw",
    "kettle_qx",
    "kettle_qy",
    "kettle_qz",
];

/// Names of the action's elements: the joint that each one moves.
pub const ACTION_NAMES: [&str; ACTION_LEN] = [
    "robot:panda0_joint1",
    "robot:panda0_joint2",
    "robot:panda0_joint3",
    "robot:panda0_joint4",
    "robot:panda0_joint5",
    "robot:panda0_joint6",
    "robot:panda0_joint7",
    "robot:panda0_finger_joint1",
    "robot:panda0_finger_joint2",
];

/// Positions at the start of every episode; velocities are zero.
pub const INITIAL_POSITIONS: [f64; OBSERVATION_LEN] = [
    1.48388023e-01,
    -1.76848573e+00,
    1.84390296e+00,
    -2.47685760e+00,
    2.60252026e-01,
    7.12533105e-01,
    1.59515394e+00,
    4.79267505e-02,
    3.71350919e-02,
    -2.66279850e-04,
    -5.18043486e-05,
    3.12877220e-05,
    -4.51199853e-05,
    -3.90842156e-06,
    -4.22629655e-05,
    6.28065475e-05,
    4.04984708e-05,
    4.62730939e-04,
    -2.26906415e-04,
    -4.65501369e-04,
    -6.44129196e-03,
    -1.77048263e-03,
    1.08009684e-03,
    -2.69397440e-01,
    3.50383255e-01,
    1.61944683e+00,
    1.00618764e+00,
    4.06395120e-03,
    -6.62095997e-03,
    -2.68278933e-04,
];

/// Lower bounds of the position set-points that reach the servos.
pub const SET_POINT_LOW: [f64; ACTION_LEN] = [-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9, 0.0, 0.0];
/// Upper bounds of the position set-points that reach the servos.
pub const SET_POINT_HIGH: [f64; ACTION_LEN] = [2.9, 1.8, 2.9, 0.0, 2.9, 3.8, 2.9, 0.04, 0.04];

/// `pos_noise_amp` of `franka_config.xml`, the amplitude of each element's noise before the ratio of [`Noise`] is applied.
const NOISE_AMPLITUDES: [f64; OBSERVATION_LEN] = [
    0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.005, 0.005, 0.0005, 0.0005, 0.0005, 0.0005,
    0.0005, 0.0005, 0.005, 0.005, 0.005, 0.1, 0.1, 0.1, 0.005, 0.005, 0.005, 0.1, 0.1, 0.1, 0.005,
];

/// A sub-task: the observation elements that must come near to the goal.
pub struct SubTask {
    /// Name as in the instructions' `sub_tasks`.
    pub name: &'static str,
    /// Index of the sub-task's first element in the observation; the others follow it.
    pub first: usize,
    /// Positions that the elements must reach.
    pub goal: &'static [f64],
}

/// The seven sub-tasks, in the order of [`SUB_TASK_NAMES`].
pub const SUB_TASKS: [SubTask; 7] = [
    SubTask {
        name: "microwave",
        first: 22,
        goal: &[-0.75],
    },
    SubTask {
        name: "kettle",
        first: 23,
        goal: &[-0.23, 0.75, 1.62, 0.99, 0.0, 0.0, -0.06],
    },
    SubTask {
        name: "bottom burner",
        first: 11,
        goal: &[-0.88, -0.01],
    },
    SubTask {
        name: "top burner",
        first: 15,
        goal: &[-0.92, -0.01],
    },
    SubTask {
        name: "light switch",
        first: 17,
        goal: &[-0.69, -0.05],
    },
    SubTask {
        name: "slide cabinet",
        first: 19,
        goal: &[0.37],
    },
    SubTask {
        name: "hinge cabinet",
        first: 20,
        goal: &[0.0, 1.45],
    },
];

/// Names of the sub-tasks.
pub const SUB_TASK_NAMES: [&str; 7] = [
    "microwave",
    "kettle",
    "bottom burner",
    "top burner",
    "light switch",
    "slide cabinet",
    "hinge cabinet",
];

impl SubTask {
    /// Distance (L2) of the true positions to the goal.
    pub fn distance(&self, state: &[f64]) -> f64 {
        state
            .iter()
            .skip(self.first)
            .zip(self.goal)
            .map(|(x, goal)| (x - goal).powi(2))
            .sum::<f64>()
            .sqrt()
    }

    /// Whether the sub-task is completed in this state.
    pub fn is_done(&self, state: &[f64]) -> bool {
        self.distance(state) < COMPLETION_DISTANCE
    }
}

/// Level of uniform noise on the observations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Noise {
    /// No noise: observations equal the state.
    None,
    /// D4RL's level, used for the paper's data: a tenth of the configured amplitudes, 0.01 rad for the arm.
    #[default]
    V0,
    /// FrankaKitchen-v1's level: a hundredth for the robot; objects a two-thousandth, with the amplitudes shifted by one as there.
    V1,
}

impl Noise {
    /// Largest deviation of each element.
    pub fn amplitudes(self) -> [f64; OBSERVATION_LEN] {
        std::array::from_fn(|index| match self {
            Self::None => 0.0,
            Self::V0 => 0.1 * NOISE_AMPLITUDES[index],
            Self::V1 if index < ACTION_LEN => 0.01 * NOISE_AMPLITUDES[index],
            Self::V1 => 0.0005 * NOISE_AMPLITUDES[index - 1],
        })
    }

    /// Name of the level on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::V0 => "v0",
            Self::V1 => "v1",
        }
    }
}

impl std::str::FromStr for Noise {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        [Self::None, Self::V0, Self::V1]
            .into_iter()
            .find(|noise| noise.name() == name)
            .ok_or_else(|| format!("unknown noise level \"{name}\": use none, v0 or v1"))
    }
}
/// The paper's images: 4:3 pictures squeezed to 224x224; without shadows, which would take twenty times as long without a GPU.
pub fn rendering(view: View) -> Rendering {
    Rendering {
        view,
        size: [224, 224],
        drawn: [224, 298],
        samples: 4,
        shadow_size: 0,
        shadow_clip: 1.0,
        reflections: false,
        hidden: Vec::new(),
        mesh_cell_m: 0.008,
    }
}
