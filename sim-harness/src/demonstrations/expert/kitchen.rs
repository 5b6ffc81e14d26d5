//! The seven sub-tasks of Franka Kitchen as closed-loop routines.
//!
//! Every routine is: move in joint space to a point before the object, servo to the contact, manipulate until the object is well past its
//! threshold, retreat mainly towards -y so that the next transit is free. Way points are relative to the scene's sites, which move with
//! their objects, so a routine that failed half-way can simply be run again. Distances in metres, angles in radians, z up, the kitchen
//! towards +y.

use std::cell::Cell;

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
/// Grips that are tried before the sub-task begins anew.
const GRIPS: usize = 3;
/// Radius of the approach's funnel: within this distance of the axis the hand may advance, m.
const FUNNEL_WIDTH: f64 = 0.012;
/// Slope of the approach's funnel: distance that the hand waits back per metre off the axis.
const FUNNEL_SLOPE: f64 = 4.0;
/// Length of the approach's funnel: farthest that the hand waits back, m.
const FUNNEL_LEN: f64 = 0.1;

// Elements of the state.
const LEFT_FINGER: usize = 7;
const RIGHT_FINGER: usize = 8;
const BOTTOM_KNOB: usize = 11;
const TOP_KNOB: usize = 15;
const SWITCH: usize = 17;
const SLIDE: usize = 19;
const HINGE: usize = 21;
const MICROWAVE: usize = 22;
const KETTLE: usize = 23;

type Sense<'a, P, T> = &'a dyn Fn(&P) -> T;

/// What to grip and how to pull it.
struct Grip<'a, P> {
    /// Pose at which the hand closes.
    contact: Sense<'a, P, Pose>,
    /// Pose that the hand pulls to, ahead of the object.
    goal: Sense<'a, P, Pose>,
    /// Displacement of the object so far.
    turned: Sense<'a, P, f64>,
    done: Sense<'a, P, bool>,
    /// Distance between the fingers below which nothing is held, m.
    width: f64,
}

/// Detects a movement that has no effect.
struct Progress {
    patience: usize,
    best: Cell<f64>,
    idle: Cell<usize>,
}

impl Progress {
    /// Makes a detector that gives up after `patience` control steps without progress.
    fn new(patience: usize) -> Self {
        Self {
            patience,
            best: Cell::new(f64::NEG_INFINITY),
            idle: Cell::new(0),
        }
    }

    /// Whether the movement has stalled; called once per control step with how far it has come.
    fn stalled(&self, value: f64) -> bool {
        if value > self.best.get() + 0.003 {
            self.best.set(value);
            self.idle.set(0);
        } else {
            self.idle.set(self.idle.get() + 1);
        }
        self.idle.get() > self.patience
    }
}

/// Orientation of the hand towards +y with the fingers opening along x, then turned about the world's axes.
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
    /// Performs a sub-task, with another approach where one fails. The environment decides whether it succeeded.
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

    /// Moves the hand back by `way` without turning it, far enough for the next transit.
    fn retreat(&mut self, open: bool, way: Vector3<f64>) -> Result<(), OutOfTime> {
        let hand = self.hand();
        self.reach(
            Move::new(open, 0.07, 8).any_rotation(),
            pose(hand.position + way, hand.rotation),
        )?;
        Ok(())
    }

    /// Moves to a contact pose along the hand's own axis: the farther the hand is off the axis, the farther back it waits.
    fn approach(
        &mut self,
        open: bool,
        near: f64,
        steps: usize,
        contact: impl Fn(&Self) -> Pose,
    ) -> Result<bool, OutOfTime> {
        let funnel = |this: &Self| {
            let contact = contact(this);
            let axis = contact.rotation * Vector3::z();
            let offset = this.hand().position - contact.position;
            let aside = (offset - axis * offset.dot(&axis)).norm();
            pose(
                contact.position
                    - axis * (FUNNEL_SLOPE * (aside - FUNNEL_WIDTH)).clamp(0.0, FUNNEL_LEN),
                contact.rotation,
            )
        };
        self.follow(Move::new(open, 0.0, steps), funnel, |this| {
            let (goal, hand) = (contact(this), this.hand());
            (goal.position - hand.position).norm() < near
                && goal.rotation.angle_to(&hand.rotation) < 0.3
        })
    }

    /// Grips what is at `contact` and pulls it along until it is `done`; grips again where the fingers slip off.
    fn grip_and_pull(&mut self, pace: f64, grip: &Grip<'_, Self>) -> Result<(), OutOfTime> {
        for _ in 0..GRIPS {
            self.approach(OPEN, 0.02, 30, grip.contact)?;
            self.follow(Move::new(CLOSED, 0.0, 3), grip.contact, |_| false)?;
            let progress = Progress::new(12);
            let held =
                |this: &Self| this.position(LEFT_FINGER) + this.position(RIGHT_FINGER) > grip.width;
            let finished = |this: &Self| {
                (grip.done)(this) || !held(this) || progress.stalled((grip.turned)(this))
            };
            self.follow(Move::new(CLOSED, 0.0, 80).linear(pace), grip.goal, finished)?;
            if (grip.done)(self) {
                break;
            }
            let hand = self.hand();
            let back = hand.position - hand.rotation * Vector3::z() * 0.09;
            self.reach(
                Move::new(OPEN, 0.03, 8).any_rotation(),
                pose(back, (grip.contact)(self).rotation),
            )?;
        }
        Ok(())
    }

    /// Opens the fingers without moving the hand.
    fn release(&mut self, steps: usize) -> Result<(), OutOfTime> {
        let hand = self.hand();
        self.reach(Move::new(OPEN, 0.0, steps), hand)?;
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
        let pull = |this: &Self| {
            let arm = handle(this) - anchor;
            pose(
                handle(this) + 0.07 * vector(arm.y, -arm.x, 0.0).normalize(),
                turned(0.8) * grasp(),
            )
        };
        self.grip_and_pull(
            0.5,
            &Grip {
                contact: &|this| pose(handle(this) - 0.012 * inwards, rotation),
                goal: &pull,
                turned: &|this| -this.position(MICROWAVE),
                done: &|this| this.position(MICROWAVE) < -0.64,
                width: 0.02,
            },
        )?;
        self.release(3)?;
        self.retreat(OPEN, vector(0.08, -0.13, 0.05))
    }

    fn kettle(&mut self) -> Result<(), OutOfTime> {
        let rotation = pitched(-35_f64.to_radians());
        let kettle = |this: &Self| {
            vector(
                this.position(KETTLE),
                this.position(KETTLE + 1),
                this.position(KETTLE + 2),
            )
        };
        let hand = self.hand().position;
        if hand.z > 1.95 && hand.y > 0.3 {
            // Coming from above: down in front of the kettle, not across its handle.
            self.transit(
                &pose(kettle(self) + vector(0.0, -0.27, 0.36), rotation),
                CLOSED,
                0.4,
                45,
            )?;
        }
        let start = kettle(self) + vector(0.0, -0.26, 0.14) + self.jitter();
        self.transit(&pose(start, rotation), CLOSED, 0.15, 45)?;
        let front = |this: &Self| {
            pose(
                vector(kettle(this).x, kettle(this).y - 0.19, 1.72),
                rotation,
            )
        };
        self.approach(CLOSED, 0.03, 15, front)?;
        let push = |this: &Self| {
            pose(
                vector(kettle(this).x, kettle(this).y - 0.05, 1.72),
                rotation,
            )
        };
        let progress = Progress::new(10);
        self.follow(Move::new(CLOSED, 0.02, 60), push, |this| {
            kettle(this).y > 0.64 || progress.stalled(kettle(this).y)
        })?;
        self.retreat(CLOSED, vector(0.0, -0.15, 0.10))
    }

    fn knob(&mut self, site: &str, element: usize, pitch: f64) -> Result<(), OutOfTime> {
        let rotation = pitched(pitch);
        let centre = self.site(site);
        let turn = |this: &Self| -this.position(element);
        let start = centre + vector(0.0, -0.13, -0.13 * pitch.tan()) + 0.7 * self.jitter();
        self.transit(&pose(start, rolled(turn(self)) * rotation), OPEN, 0.15, 45)?;
        let at = |angle: f64| pose(centre + vector(0.0, -0.02, 0.0), rolled(angle) * rotation);
        self.grip_and_pull(
            0.5,
            &Grip {
                contact: &|this| at(turn(this)),
                goal: &|this| at((turn(this) + 0.6).min(1.35)),
                turned: &|this| turn(this),
                done: &|this| turn(this) > 0.82,
                width: 0.0,
            },
        )?;
        self.release(2)?;
        self.retreat(OPEN, vector(0.0, -0.13, 0.0))
    }

    fn light_switch(&mut self) -> Result<(), OutOfTime> {
        let centre = self.site("light_site") + 0.7 * self.jitter();
        let at = |x: f64, y: f64| pose(centre + vector(x, y, 0.0), grasp());
        self.transit(&at(0.075, -0.13), CLOSED, 0.15, 45)?;
        self.approach(CLOSED, 0.02, 30, |_| at(0.05, -0.02))?;
        let progress = Progress::new(10);
        self.follow(
            Move::new(CLOSED, 0.0, 40),
            |_| at(-0.12, -0.02),
            |this| {
                let missed =
                    this.hand().position.x < centre.x - 0.03 && this.position(SWITCH) > -0.1;
                this.position(SWITCH) < -0.66 || missed || progress.stalled(-this.position(SWITCH))
            },
        )?;
        self.retreat(CLOSED, vector(0.0, -0.13, 0.0))
    }

    fn slide_cabinet(&mut self) -> Result<(), OutOfTime> {
        let rotation = grasp();
        let backwards = vector(0.0, -1.0, 0.0);
        let site = self.site("slide_site");
        let contact = vector(site.x - 0.07, site.y, 2.49) + 0.03 * backwards + self.jitter();
        self.transit(
            &pose(contact + 0.15 * backwards, rotation),
            CLOSED,
            0.15,
            45,
        )?;
        self.approach(CLOSED, 0.025, 20, |_| pose(contact, rotation))?;
        let push = |this: &Self| {
            pose(
                vector(this.site("slide_site").x + 0.06, contact.y, contact.z),
                rotation,
            )
        };
        let progress = Progress::new(12);
        self.follow(Move::new(CLOSED, 0.0, 60).linear(0.8), push, |this| {
            this.position(SLIDE) > 0.24 || progress.stalled(this.position(SLIDE))
        })?;
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
        let pull = |this: &Self| {
            let ahead = anchor + turned(16_f64.to_radians()) * (handle(this) - anchor);
            pose(ahead, turned(-0.8 + 0.8 * this.position(HINGE)) * rotation)
        };
        self.grip_and_pull(
            0.9,
            &Grip {
                contact: &|this| {
                    let yaw = 0.5 * this.position(HINGE);
                    pose(
                        handle(this) + turned(yaw) * vector(0.0, -0.012, 0.0),
                        turned(yaw) * rotation,
                    )
                },
                goal: &pull,
                turned: &|this| this.position(HINGE),
                done: &|this| this.position(HINGE) > 1.19,
                width: 0.02,
            },
        )?;
        self.release(3)?;
        self.retreat(OPEN, vector(-0.02, -0.15, -0.05))
    }
}
