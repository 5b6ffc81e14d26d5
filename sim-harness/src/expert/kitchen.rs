//! The seven sub-tasks of Franka Kitchen as closed-loop routines.
//!
//! Every routine is: move in joint space to a point before the object, servo to the contact, manipulate until the object is well past its
//! threshold, retreat mainly towards -y so that the next transit is free. Way points are relative to the scene's sites, which move with
//! their objects, so a routine that failed half-way can simply be run again. Distances in metres, angles in radians, z up, the kitchen
//! towards +y.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::arm::{Pose, site_id};
use super::{Move, OutOfTime, Performer};
use crate::environment::Environment;
use crate::kitchen::spec::SUB_TASK_NAMES;
use mujoco_rs::wrappers::mj_model::MjtObjBase;

const OPEN: bool = true;
const CLOSED: bool = false;
/// Attempts of one sub-task before the demonstration is given up.
const ATTEMPTS: usize = 3;

// Elements of the state.
const BOTTOM_KNOB: usize = 11;
const TOP_KNOB: usize = 15;
const SWITCH: usize = 17;
const SLIDE: usize = 19;
const HINGE: usize = 21;
const MICROWAVE: usize = 22;
const KETTLE: usize = 23;

/// The hand points towards +y with the fingers opening along x; then turned about the world's axes.
fn grasp() -> Rotation3<f64> {
    Rotation3::from_matrix_unchecked(Matrix3::new(0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0))
}

fn pitched(angle: f64) -> Rotation3<f64> {
    Rotation3::from_axis_angle(&Vector3::x_axis(), angle) * grasp()
}

fn rolled(angle: f64) -> Rotation3<f64> {
    Rotation3::from_axis_angle(&Vector3::y_axis(), angle)
}

fn turned(angle: f64) -> Rotation3<f64> {
    Rotation3::from_axis_angle(&Vector3::z_axis(), angle)
}

fn vector(x: f64, y: f64, z: f64) -> Vector3<f64> {
    Vector3::new(x, y, z)
}

fn pose(position: Vector3<f64>, rotation: Rotation3<f64>) -> Pose {
    Pose { position, rotation }
}

impl Performer<'_> {
    /// Performs a sub-task, with another approach where one fails. Whether it succeeded is the environment's to say.
    ///
    /// # Errors
    /// The episode's time ran out.
    pub fn perform(&mut self, sub_task: usize) -> Result<bool, OutOfTime> {
        for _ in 0..ATTEMPTS {
            match SUB_TASK_NAMES[sub_task] {
                "microwave" => self.microwave(),
                "kettle" => self.kettle(),
                "bottom burner" => self.knob("knob2_site", BOTTOM_KNOB, 0.0),
                "top burner" => self.knob("knob4_site", TOP_KNOB, 15_f64.to_radians()),
                "light switch" => self.light_switch(),
                "slide cabinet" => self.slide_cabinet(),
                _ => self.hinge_cabinet(),
            }?;
            if self.environment().completed_at(sub_task).is_some() {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn site(&self, name: &str) -> Vector3<f64> {
        let physics = self.environment().physics();
        physics.site_xpos()[site_id(physics, name)].into()
    }

    fn anchor(&self, joint: &str) -> Vector3<f64> {
        let physics = self.environment().physics();
        let id = physics.model().name_to_id(MjtObjBase::mjOBJ_JOINT, joint);
        id.map_or_else(Vector3::zeros, |id| physics.xanchor()[id].into())
    }

    /// Backs off by `way` with the hand as it is, far enough for the next transit.
    fn retreat(&mut self, open: bool, way: Vector3<f64>) -> Result<(), OutOfTime> {
        let hand = self.hand();
        self.reach(Move::new(open, 0.07, 8).any_rotation(), pose(hand.position + way, hand.rotation))?;
        Ok(())
    }

    /// Holds still while the fingers open or close.
    fn fingers(&mut self, open: bool, steps: usize, hold: Pose) -> Result<(), OutOfTime> {
        self.reach(Move::new(open, 0.0, steps), hold)?;
        Ok(())
    }

    fn microwave(&mut self) -> Result<(), OutOfTime> {
        let inwards = vector(-0.2955, 0.955, 0.0);
        let rotation = turned(0.3) * grasp();
        let anchor = self.anchor("microwave");
        let handle = |this: &Self| {
            let site = this.site("microhandle_site");
            vector(site.x, site.y, 1.79)
        };
        let start = handle(self) - 0.15 * inwards + self.jitter();
        self.transit(&pose(start, rotation), OPEN, 0.15, 45)?;
        let contact = |this: &Self| pose(handle(this) - 0.012 * inwards, rotation);
        self.follow(Move::new(OPEN, 0.02, 25), contact, |_| false)?;
        self.follow(Move::new(CLOSED, 0.0, 3), contact, |_| false)?;
        let pull = |this: &Self| {
            let arm = handle(this) - anchor;
            pose(handle(this) + 0.07 * vector(arm.y, -arm.x, 0.0).normalize(), turned(0.5) * grasp())
        };
        self.follow(Move::new(CLOSED, 0.0, 60), pull, |this| {
            this.position(MICROWAVE) < -0.70 || (this.hand().position - handle(this)).norm() > 0.15
        })?;
        let hold = pose(self.hand().position, rotation);
        self.fingers(OPEN, 3, hold)?;
        self.retreat(OPEN, vector(0.08, -0.13, 0.05))
    }

    fn kettle(&mut self) -> Result<(), OutOfTime> {
        let rotation = pitched(-35_f64.to_radians());
        let kettle = |this: &Self| vector(this.position(KETTLE), this.position(KETTLE + 1), this.position(KETTLE + 2));
        let hand = self.hand().position;
        if hand.z > 1.95 && hand.y > 0.3 {
            // Coming from above: down in front of the kettle, not across its handle.
            self.transit(&pose(kettle(self) + vector(0.0, -0.27, 0.36), rotation), CLOSED, 0.4, 45)?;
        }
        let start = kettle(self) + vector(0.0, -0.24, 0.14) + self.jitter();
        self.transit(&pose(start, rotation), CLOSED, 0.15, 45)?;
        let push = |this: &Self| pose(vector(kettle(this).x, kettle(this).y - 0.05, 1.72), rotation);
        self.follow(Move::new(CLOSED, 0.02, 60), push, |this| kettle(this).y > 0.66)?;
        self.retreat(CLOSED, vector(0.0, -0.15, 0.10))
    }

    fn knob(&mut self, site: &str, element: usize, pitch: f64) -> Result<(), OutOfTime> {
        let rotation = pitched(pitch);
        let centre = self.site(site);
        let contact = centre + vector(0.0, -0.033, 0.0);
        let turn = |this: &Self| -this.position(element);
        let jitter = 0.7 * self.jitter();
        let start = centre + vector(0.0, -0.13, -0.13 * pitch.tan()) + jitter;
        let grip = rolled(turn(self)) * rotation;
        self.transit(&pose(start, grip), OPEN, 0.15, 45)?;
        self.reach(Move::new(OPEN, 0.015, 20), pose(contact, grip))?;
        self.fingers(CLOSED, 3, pose(contact, grip))?;
        let roll = |this: &Self| pose(contact, rolled((turn(this) + 0.6).min(1.35)) * rotation);
        self.follow(Move::new(CLOSED, 0.0, 40), roll, |this| turn(this) > 0.82)?;
        let hold = self.hand();
        self.fingers(OPEN, 2, hold)?;
        self.retreat(OPEN, vector(0.0, -0.13, 0.0))
    }

    fn light_switch(&mut self) -> Result<(), OutOfTime> {
        let centre = self.site("light_site") + 0.7 * self.jitter();
        let at = |x: f64, y: f64| pose(centre + vector(x, y, 0.0), grasp());
        self.transit(&at(0.075, -0.13), CLOSED, 0.15, 45)?;
        self.reach(Move::new(CLOSED, 0.025, 20), at(0.060, -0.04))?;
        self.follow(Move::new(CLOSED, 0.0, 40), |_| at(-0.12, -0.04), |this| this.position(SWITCH) < -0.66)?;
        self.retreat(CLOSED, vector(0.0, -0.13, 0.0))
    }

    fn slide_cabinet(&mut self) -> Result<(), OutOfTime> {
        let pitch = 30_f64.to_radians();
        let rotation = pitched(pitch);
        let backwards = vector(0.0, -pitch.cos(), -pitch.sin());
        let site = self.site("slide_site");
        let contact = vector(site.x - 0.07, site.y, 2.49) + 0.045 * backwards + self.jitter();
        self.transit(&pose(contact + 0.15 * backwards, rotation), CLOSED, 0.15, 45)?;
        self.reach(Move::new(CLOSED, 0.025, 20), pose(contact, rotation))?;
        let push = |this: &Self| pose(vector(this.site("slide_site").x + 0.06, contact.y, contact.z), rotation);
        self.follow(Move::new(CLOSED, 0.0, 60).linear(0.8), push, |this| this.position(SLIDE) > 0.30)?;
        self.retreat(CLOSED, vector(-0.03, -0.13, 0.0))
    }

    fn hinge_cabinet(&mut self) -> Result<(), OutOfTime> {
        let rotation = pitched(15_f64.to_radians());
        let anchor = self.anchor("right_hinge_cabinet");
        let handle = |this: &Self| {
            let site = this.site("hinge_site2");
            vector(site.x, site.y, 2.49)
        };
        let start = handle(self) + vector(0.0, -0.15, 0.0) + self.jitter();
        self.transit(&pose(start, rotation), OPEN, 0.15, 45)?;
        let contact = |this: &Self| pose(handle(this) + vector(0.0, -0.012, 0.0), rotation);
        self.follow(Move::new(OPEN, 0.025, 25), contact, |_| false)?;
        self.follow(Move::new(CLOSED, 0.0, 3), contact, |_| false)?;
        let pull = |this: &Self| {
            let ahead = anchor + turned(16_f64.to_radians()) * (handle(this) - anchor);
            pose(ahead, turned(-0.4 + 0.8 * this.position(HINGE)) * rotation)
        };
        self.follow(Move::new(CLOSED, 0.0, 80).linear(0.7), pull, |this| {
            this.position(HINGE) > 1.22 || (this.hand().position - handle(this)).norm() > 0.15
        })?;
        let hold = self.hand();
        self.fingers(OPEN, 3, hold)?;
        self.retreat(OPEN, vector(-0.02, -0.15, -0.05))
    }
}
