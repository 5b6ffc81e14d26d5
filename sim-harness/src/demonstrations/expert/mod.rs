//! Scripted experts: they see the true state, perform sub-tasks one after the other, and their actions are the demonstrations' labels.
//!
//! A [`Performer`] owns the episode while it lasts: every action goes through one place, which adds the recovery noise to what is
//! executed (never to the label), records the step and stops the performance when its time is up. Each sub-task is a loop that tries again
//! from a fresh approach when a grip is lost or nothing moves, see [`kitchen`].

pub mod arm;
pub mod kitchen;

use nalgebra::Vector3;

use crate::environment::{Environment, EpisodeSeed};
use crate::kitchen::Kitchen;
use crate::kitchen::spec::{ACTION_LEN, OBSERVATION_LEN};
use crate::random::Stream;
use arm::{Arm, JOINTS, Joints, Pace, Pose, action, joint_angles};

/// Correlation of the recovery noise from one control step to the next.
pub const NOISE_CORRELATION: f64 = 0.7;
/// Second word of the entropy of the experts' own random stream, which keeps it apart from the environment's stream of the same episode.
const EXPERT_STREAM: u64 = 0x6578_7065_7274;
/// Gain of joint-space moves.
const TRANSIT_GAIN: f64 = 0.9;

/// Random variation of one demonstration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Style {
    /// Factor on all speeds.
    pub speed: f64,
    /// Half width of the uniform jitter on approach points, m.
    pub jitter: f64,
    /// Standard deviation of the correlated noise on the executed actions of joints 1-7.
    pub recovery_noise: f64,
}

impl Style {
    /// Style without any variation.
    pub const PLAIN: Self = Self {
        speed: 1.0,
        jitter: 0.0,
        recovery_noise: 0.0,
    };

    /// Draws a random style: speed 0.85 to 1.2, jitter 9 mm, noise of a standard deviation between 0 and `recovery_noise`.
    pub fn draw(stream: &mut Stream, recovery_noise: f64) -> Self {
        Self {
            speed: stream.uniform(0.85, 1.2),
            jitter: 0.009,
            recovery_noise: recovery_noise * stream.unit(),
        }
    }
}

/// One control step of a demonstration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// Observation before the step, as a policy sees it.
    pub observation: [f32; OBSERVATION_LEN],
    /// Observation before the step, without noise.
    pub state: [f32; OBSERVATION_LEN],
    /// The expert's intended action: the label.
    pub action: [f32; ACTION_LEN],
    /// Executed action, recovery noise included.
    pub executed: [f32; ACTION_LEN],
}

/// The episode's time has run out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutOfTime;

/// End condition and speed of a movement.
#[derive(Clone, Copy, Debug)]
struct Move {
    open: bool,
    pace: Pace,
    /// Distance at which the pose counts as reached, m.
    near: f64,
    /// Angle at which the pose counts as reached, rad.
    aligned: f64,
    /// Control steps after which the movement ends anyway.
    steps: usize,
}

impl Move {
    /// Makes a movement with open or closed fingers that ends within `near` metres of its goal or after `steps` control steps.
    const fn new(open: bool, near: f64, steps: usize) -> Self {
        Self {
            open,
            pace: Pace {
                linear: 0.5,
                angular: 2.5,
            },
            near,
            aligned: 0.3,
            steps,
        }
    }

    const fn linear(mut self, speed: f64) -> Self {
        self.pace.linear = speed;
        self
    }

    const fn any_rotation(mut self) -> Self {
        self.aligned = f64::INFINITY;
        self
    }
}

/// Performs sub-tasks in an environment and records the control steps.
pub struct Performer<'k> {
    kitchen: &'k mut Kitchen,
    arm: Arm,
    stream: Stream,
    style: Style,
    drift: [f64; JOINTS],
    transitions: Vec<Transition>,
    max_steps: usize,
}

impl<'k> Performer<'k> {
    /// Starts an episode of at most `max_steps` control steps, with a style drawn from the episode's seed.
    pub fn new(
        kitchen: &'k mut Kitchen,
        seed: EpisodeSeed,
        recovery_noise: f64,
        max_steps: usize,
    ) -> Self {
        let [run, instruction, episode] = seed.entropy();
        let mut stream = Stream::new(&[run, EXPERT_STREAM, instruction, episode]);
        let style = Style::draw(&mut stream, recovery_noise);
        Self::with_style(kitchen, seed, stream, style, max_steps)
    }

    /// Starts an episode with a given style, whose noise and jitter are drawn from `stream`.
    pub fn with_style(
        kitchen: &'k mut Kitchen,
        seed: EpisodeSeed,
        stream: Stream,
        style: Style,
        max_steps: usize,
    ) -> Self {
        kitchen.reset(seed, &[]);
        let arm = Arm::new(kitchen.physics());
        Self {
            kitchen,
            arm,
            stream,
            style,
            drift: [0.0; JOINTS],
            transitions: Vec::with_capacity(max_steps),
            max_steps,
        }
    }

    /// Style of this demonstration.
    pub fn style(&self) -> Style {
        self.style
    }

    /// Control steps so far.
    pub fn transitions(&self) -> &[Transition] {
        &self.transitions
    }

    /// Environment in its present state.
    pub fn environment(&self) -> &Kitchen {
        self.kitchen
    }

    /// Returns the recorded control steps.
    pub fn into_transitions(self) -> Vec<Transition> {
        self.transitions
    }

    /// Executes a label, disturbed by the recovery noise.
    fn act(&mut self, label: [f64; ACTION_LEN]) -> Result<(), OutOfTime> {
        if self.transitions.len() >= self.max_steps {
            return Err(OutOfTime);
        }
        let innovation =
            (1.0 - NOISE_CORRELATION * NOISE_CORRELATION).sqrt() * self.style.recovery_noise;
        let mut executed = label;
        for (drift, executed) in self.drift.iter_mut().zip(&mut executed) {
            *drift = NOISE_CORRELATION * *drift + innovation * self.stream.normal();
            *executed = (*executed + *drift).clamp(-1.0, 1.0);
        }
        self.transitions.push(Transition {
            observation: narrow(self.kitchen.observation()),
            state: narrow(self.kitchen.state()),
            action: narrow(&label),
            executed: narrow(&executed),
        });
        // The label is clamped and finite, so the environment takes it.
        let executed: [f64; ACTION_LEN] = narrow(&executed).map(f64::from);
        self.kitchen.step(&executed).map_err(|_| OutOfTime)?;
        Ok(())
    }

    fn position(&self, index: usize) -> f64 {
        self.kitchen.state()[index]
    }

    fn hand(&self) -> Pose {
        self.arm.pose(self.kitchen.physics())
    }

    fn jitter(&mut self) -> Vector3<f64> {
        let width = self.style.jitter;
        Vector3::from_fn(|_, _| self.stream.uniform(-width, width))
    }

    /// Moves in joint space to the posture of a pose; precise to `near` rad in every joint.
    fn transit(
        &mut self,
        goal: &Pose,
        open: bool,
        near: f64,
        steps: usize,
    ) -> Result<(), OutOfTime> {
        let posture = self.arm.inverse_kinematics(self.kitchen.physics(), goal);
        for _ in 0..steps {
            let error: Joints = posture - joint_angles(self.kitchen.physics());
            if error.amax() < near {
                break;
            }
            let label = action(
                self.kitchen.physics(),
                &(TRANSIT_GAIN * error),
                self.style.speed.min(1.0),
                open,
            );
            self.act(label)?;
        }
        Ok(())
    }

    /// Follows a goal that may move, until it is reached, `done` or `steps` are over. True when it was reached or done.
    fn follow(
        &mut self,
        how: Move,
        goal: impl Fn(&Self) -> Pose,
        done: impl Fn(&Self) -> bool,
    ) -> Result<bool, OutOfTime> {
        let pace = Pace {
            linear: how.pace.linear * self.style.speed,
            angular: how.pace.angular * self.style.speed,
        };
        for step in 0..how.steps {
            if done(self) {
                return Ok(true);
            }
            let (goal, hand) = (goal(self), self.hand());
            let near = (goal.position - hand.position).norm() < how.near;
            if step > 0 && near && goal.rotation.angle_to(&hand.rotation) < how.aligned {
                return Ok(true);
            }
            let physics = self.kitchen.physics();
            let label = action(
                physics,
                &self.arm.displacement(physics, &goal, pace),
                1.0,
                how.open,
            );
            self.act(label)?;
        }
        Ok(done(self))
    }

    /// Moves to a fixed pose; true when it was reached.
    fn reach(&mut self, how: Move, goal: Pose) -> Result<bool, OutOfTime> {
        self.follow(how, |_| goal, |_| false)
    }
}

fn narrow<const N: usize>(values: &[f64]) -> [f32; N] {
    std::array::from_fn(|index| values[index] as f32)
}
