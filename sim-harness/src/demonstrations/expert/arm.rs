//! Kinematics of the Franka arm for the experts: from poses to joint displacements to actions.
//!
//! Kinematics come from MuJoCo (site pose and Jacobian). A displacement is a damped least-squares step with a pull towards the home posture
//! in the null space; joints at their limits are taken out of the step (active set). Nothing here can fail: unreachable poses give the
//! nearest pose that the limits allow.

use std::sync::Arc;

use mujoco_rs::wrappers::mj_model::MjtObjBase;
use mujoco_rs::wrappers::{MjData, MjModel};
use nalgebra::{Matrix3, Matrix6, Rotation3, SMatrix, SVector, Vector3, Vector6};

use crate::kitchen::spec::{ACTION_LEN, ACTION_SCALE, CONTROL_PERIOD_S, INITIAL_POSITIONS};

/// Joints of the arm, without the fingers.
pub const JOINTS: usize = 7;
/// Joint angles or displacements of the arm, rad.
pub type Joints = SVector<f64, JOINTS>;
type Jacobian = SMatrix<f64, 6, JOINTS>;
type Physics = MjData<Arc<MjModel>>;

/// Joint limits that the experts keep: the model's, less a margin; joint 6 also respects the environment's lower bound of 0.
const LIMIT_LOW: [f64; JOINTS] = [-2.85, -1.74, -2.85, -3.03, -2.85, 0.02, -2.85];
const LIMIT_HIGH: [f64; JOINTS] = [2.85, 1.74, 2.85, -0.45, 2.85, 2.08, 2.85];
/// Stiffness of the position servos, N m/rad (actuator.xml).
const STIFFNESS: [f64; JOINTS] = [870.0, 870.0, 870.0, 870.0, 120.0, 120.0, 120.0];
/// Set-point offset of a full action, rad.
const FULL_OFFSET: f64 = ACTION_SCALE * CONTROL_PERIOD_S;
/// Share of a commanded offset that the arm covers within one control step (measured: 0.5 to 0.6).
const RESPONSE: f64 = 0.6;

const POSITION_GAIN: f64 = 0.7;
const ROTATION_GAIN: f64 = 0.6;
const ROTATION_WEIGHT: f64 = 0.3;
const NULL_SPACE_GAIN: f64 = 0.08;
const DAMPING: f64 = 0.05;
/// Rounds of the active set; each takes at least one joint out.
const ACTIVE_SET_ROUNDS: usize = 5;
/// Iterations after which inverse kinematics has converged for every pose that the experts use.
const INVERSE_KINEMATICS_STEPS: usize = 150;

/// Pose of the hand, present or wanted, in world coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Position of the `end_effector` site, m. The fingertips lie 5 cm beyond it.
    pub position: Vector3<f64>,
    /// Orientation of the `end_effector` site.
    pub rotation: Rotation3<f64>,
}

/// Largest speeds of the hand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pace {
    /// Linear speed, m/s.
    pub linear: f64,
    /// Angular speed, rad/s.
    pub angular: f64,
}

/// Kinematics of the arm.
pub struct Arm {
    site: usize,
    home: Joints,
    scratch: Physics,
}

impl Arm {
    /// Takes the arm from the model that `physics` belongs to.
    pub fn new(physics: &Physics) -> Self {
        let site = site_id(physics, "end_effector");
        let home = Joints::from_iterator(INITIAL_POSITIONS.iter().copied());
        Self {
            site,
            home,
            scratch: MjData::new(physics.model_clone()),
        }
    }

    /// Pose of the hand.
    pub fn pose(&self, physics: &Physics) -> Pose {
        let rotation = Matrix3::from_row_slice(&physics.site_xmat()[self.site]);
        Pose {
            position: physics.site_xpos()[self.site].into(),
            rotation: Rotation3::from_matrix_unchecked(rotation),
        }
    }

    /// Computes the joint displacement of one control step towards a pose.
    pub fn displacement(&self, physics: &Physics, goal: &Pose, pace: Pace) -> Joints {
        let pose = self.pose(physics);
        let linear = POSITION_GAIN * (goal.position - pose.position);
        let angular = ROTATION_GAIN * (goal.rotation * pose.rotation.inverse()).scaled_axis();
        let mut twist = Vector6::zeros();
        twist
            .fixed_rows_mut::<3>(0)
            .copy_from(&linear.cap_magnitude(pace.linear * CONTROL_PERIOD_S));
        twist
            .fixed_rows_mut::<3>(3)
            .copy_from(&(ROTATION_WEIGHT * angular.cap_magnitude(pace.angular * CONTROL_PERIOD_S)));
        let angles = joint_angles(physics);
        let mut room = [(0.0, 0.0); JOINTS];
        for (joint, room) in room.iter_mut().enumerate() {
            *room = (
                (LIMIT_LOW[joint] - angles[joint]).min(0.0),
                (LIMIT_HIGH[joint] - angles[joint]).max(0.0),
            );
        }
        limited_step(
            &self.jacobian(physics),
            &twist,
            &(NULL_SPACE_GAIN * (self.home - angles)),
            &room,
        )
    }

    /// Finds the joint angles that bring the hand to a pose, always from the home posture, so that a pose has one posture.
    pub fn inverse_kinematics(&mut self, physics: &Physics, goal: &Pose) -> Joints {
        let start =
            Joints::from_fn(|joint, _| self.home[joint].clamp(LIMIT_LOW[joint], LIMIT_HIGH[joint]));
        self.scratch.qpos_mut().copy_from_slice(physics.qpos());
        self.scratch.qpos_mut()[..JOINTS].copy_from_slice(start.as_slice());
        for _ in 0..INVERSE_KINEMATICS_STEPS {
            self.scratch.kinematics();
            self.scratch.com_pos();
            let step = self.displacement(
                &self.scratch,
                goal,
                Pace {
                    linear: 0.6,
                    angular: 2.5,
                },
            );
            for (angle, step) in self.scratch.qpos_mut().iter_mut().zip(step.iter()) {
                *angle += step;
            }
            if step.amax() < 1e-5 {
                break;
            }
        }
        joint_angles(&self.scratch)
    }

    /// Jacobian of the `end_effector` site: three translation rows, three weighted rotation rows.
    fn jacobian(&self, physics: &Physics) -> Jacobian {
        let (translation, rotation) = physics.jac_site(true, true, self.site);
        let columns = translation.len() / 3;
        Jacobian::from_fn(|row, joint| {
            if row < 3 {
                translation[row * columns + joint]
            } else {
                ROTATION_WEIGHT * rotation[(row - 3) * columns + joint]
            }
        })
    }
}

/// Computes the damped least-squares step for a weighted twist, with the joints kept inside their `room`.
fn limited_step(
    jacobian: &Jacobian,
    twist: &Vector6<f64>,
    posture: &Joints,
    room: &[(f64, f64); JOINTS],
) -> Joints {
    let mut step = Joints::zeros();
    let mut free = [true; JOINTS];
    for _ in 0..ACTIVE_SET_ROUNDS {
        let mask = Joints::from_fn(|joint, _| if free[joint] { 1.0 } else { 0.0 });
        let fixed = step.component_mul(&mask.map(|m| 1.0 - m));
        let open = jacobian * SMatrix::<f64, JOINTS, JOINTS>::from_diagonal(&mask);
        let normal = open * open.transpose() + DAMPING * DAMPING * Matrix6::identity();
        // Symmetric with eigenvalues of at least DAMPING^2, so the factorisation exists.
        let Some(factor) = normal.cholesky() else {
            return step;
        };
        let pull = posture.component_mul(&mask);
        let residual = twist - jacobian * fixed - open * pull;
        step = fixed + pull + open.transpose() * factor.solve(&residual);
        let outside = |joint: usize, step: &Joints| {
            step[joint] < room[joint].0 || step[joint] > room[joint].1
        };
        let violating: Vec<usize> = (0..JOINTS)
            .filter(|&joint| free[joint] && outside(joint, &step))
            .collect();
        if violating.is_empty() {
            break;
        }
        for joint in violating {
            step[joint] = step[joint].clamp(room[joint].0, room[joint].1);
            free[joint] = false;
        }
    }
    step
}

/// Computes the action that displaces the arm's joints within one control step, scaled down as a whole where it asks for too much.
///
/// `share` is the part of the full speed that may be used; `open` opens or closes the fingers with full force.
pub fn action(
    physics: &Physics,
    displacement: &Joints,
    share: f64,
    open: bool,
) -> [f64; ACTION_LEN] {
    // The servos have no integral part: gravity and Coriolis forces are offset beforehand.
    let gravity = Joints::from_fn(|joint, _| physics.qfrc_bias()[joint] / STIFFNESS[joint]);
    let wanted = displacement / RESPONSE;
    let excess = (0..JOINTS)
        .map(|joint| wanted[joint].abs() / (share * FULL_OFFSET - gravity[joint].abs()).max(1e-3))
        .fold(1.0, f64::max);
    let offset = (wanted / excess + gravity) / FULL_OFFSET;
    let fingers = if open { 1.0 } else { -1.0 };
    std::array::from_fn(|index| {
        if index < JOINTS {
            offset[index].clamp(-1.0, 1.0)
        } else {
            fingers
        }
    })
}

/// The arm's joint angles.
pub fn joint_angles(physics: &Physics) -> Joints {
    Joints::from_iterator(physics.qpos().iter().copied())
}

/// Index of a site of the scene.
///
/// # Panics
/// Where the scene has no such site: the experts only name sites of the pinned scene.
pub fn site_id(physics: &Physics, name: &str) -> usize {
    let id = physics.model().name_to_id(MjtObjBase::mjOBJ_SITE, name);
    id.unwrap_or_else(|| panic!("the scene has no site {name}"))
}
