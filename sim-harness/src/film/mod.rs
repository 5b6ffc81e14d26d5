//! Films an episode after it ran.
//!
//! A film runs the executed actions of a [`Trace`] once more, in an environment of its own, and looks at every state on the way. So
//! filming cannot change or slow down the rollout, and what is shown is what happened: a second run that ends elsewhere is refused.
//! [`camera`] draws a state without a display, [`caption`] writes around it, [`file`](mod@file) makes it a GIF, a film or a folder of pictures.
//! What can fail: a machine without EGL, an environment without a simulator, a file that cannot be written.

pub mod camera;
pub mod canvas;
pub mod caption;
pub mod file;
mod gif;
mod mp4;
#[cfg(feature = "report")]
pub mod strip;

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use thiserror::Error;

use self::camera::Camera;
use self::canvas::Canvas;
use self::caption::{Caption, Progress};
use self::file::{Finished, Form, Sink, shown_s};
use crate::environment::{ActionError, Environment, EpisodeSeed};
use crate::rollout::Phase;
use crate::trace::{Step, Trace};

/// Why an episode cannot be filmed or drawn.
#[derive(Debug, Error)]
pub enum FilmError {
    /// The environment has no simulator to draw.
    #[error("environment {0} has no simulator to look into")]
    NoStage(&'static str),
    /// The scene lacks the camera that its environment names.
    #[error("the scene has no camera '{0}' (run \"make setup\" to restore the assets)")]
    NoCamera(&'static str),
    /// OpenGL without a display is not available.
    #[error(
        "pictures need OpenGL without a display, by EGL: {0}; install it (Debian: apt-get install libegl1 libgl1-mesa-dri)"
    )]
    NoEgl(String),
    /// Drawing failed later than at the start.
    #[error("a picture cannot be drawn: {0}")]
    Draw(String),
    /// The environment refused an action that it executed in the first run.
    #[error("control step {step} cannot be run again: {error}")]
    Action {
        /// Control step, from 0.
        step: usize,
        /// The environment's error.
        error: ActionError,
    },
    /// The second run ended in another state than the first.
    #[error(
        "the episode ended elsewhere when it was run again: it is not the one that was recorded"
    )]
    OtherEpisode,
    /// The file cannot be written.
    #[error("cannot be written ({0}); name a file in an existing, writable folder with room")]
    Write(#[from] std::io::Error),
    /// The program that compresses films, ffmpeg, failed.
    #[error("ffmpeg cannot make it: {0}")]
    Ffmpeg(String),
    /// Filming was stopped by the caller.
    #[error("interrupted")]
    Interrupted,
}

/// A state of the episode: before control step `number`, or, if `step` is `None`, after the last.
#[derive(Debug, Clone, Copy)]
pub struct Moment<'t> {
    /// Number of control steps executed so far.
    pub number: usize,
    /// The policy's next control step.
    pub step: Option<&'t Step>,
}

/// Callback for every state of a second run.
pub type Look<'l> = dyn FnMut(Moment<'_>, &mut dyn Environment) -> Result<(), FilmError> + 'l;

/// Runs the executed actions of `trace` again and calls `look` at every state, the first and the last included. `commanded` are the
/// sub-tasks that its instruction commands, `seed` is the run's.
pub fn play(
    trace: &Trace,
    commanded: &[usize],
    seed: u64,
    environment: &mut dyn Environment,
    look: &mut Look<'_>,
) -> Result<(), FilmError> {
    let seed = EpisodeSeed {
        seed,
        instruction: u64::from(trace.instruction),
        episode: u64::from(trace.episode),
    };
    environment.reset(seed, commanded);
    let mut command = vec![0.0; environment.action_len()];
    for (number, step) in trace.steps.iter().enumerate() {
        let moment = Moment {
            number,
            step: Some(step),
        };
        look(moment, environment)?;
        for (command, &executed) in command.iter_mut().zip(&step.executed) {
            *command = f64::from(executed);
        }
        let done = environment.step(&command);
        done.map_err(|error| FilmError::Action {
            step: number,
            error,
        })?;
    }
    let moment = Moment {
        number: trace.steps.len(),
        step: None,
    };
    look(moment, environment)?;
    let outcome = &trace.outcome;
    let same = environment.state() == outcome.final_state
        && environment.completions() == outcome.completions;
    same.then_some(()).ok_or(FilmError::OtherEpisode)
}

/// Width and height of the simulator's pictures in a film, in pixels.
pub const PICTURE: [u32; 2] = [640, 480];

/// Number of pictures that a GIF's palette is made from.
const SAMPLES: usize = 8;

/// An episode to be filmed.
pub struct Scene<'s> {
    /// Recorded control steps of the episode.
    pub trace: &'s Trace,
    /// Text of the episode's instruction.
    pub instruction: &'s str,
    /// The environment's indices of the sub-tasks that the instruction commands.
    pub commanded: &'s [usize],
    /// Seed of the run.
    pub seed: u64,
}

impl Scene<'_> {
    /// Films the episode in `environment`, every control step, with captions; `camera` takes pictures of size [`PICTURE`]. What comes back
    /// is complete and beside `path`. `taken` is called after each picture, `stop` ends the work early.
    pub fn film(
        &self,
        environment: &mut dyn Environment,
        camera: &mut Camera,
        (form, path): (Form, &Path),
        stop: &AtomicBool,
        taken: &dyn Fn(),
    ) -> Result<Finished, FilmError> {
        let period_s = environment.control_period_s();
        let speed = period_s / shown_s(period_s);
        let note = if speed < 0.99 {
            format!("slowed down to {speed:.2} of real time")
        } else {
            String::new()
        };
        let caption = Caption {
            instruction: self.instruction,
            sub_tasks: environment.sub_tasks(),
            commanded: self.commanded,
            steps: self.trace.steps.len(),
            period_s,
            note: &note,
        };
        let plans: Vec<Option<u32>> = self.trace.steps.iter().map(|step| step.plan).collect();
        let [width, height] = PICTURE;
        let mut canvas = Canvas::new(width, caption::HEAD + height + caption::FOOT);
        let mut sink = Sink::new(form, path, canvas.size(), period_s)?;
        let go_on = || {
            let stopped = stop.load(Ordering::Relaxed);
            (!stopped).then_some(()).ok_or(FilmError::Interrupted)
        };
        let episode = |environment: &mut dyn Environment, look: &mut Look<'_>| {
            play(self.trace, self.commanded, self.seed, environment, look)
        };
        if sink.learns() {
            let every = self.trace.steps.len().div_ceil(SAMPLES).max(1);
            episode(environment, &mut |moment, environment| {
                go_on()?;
                if moment.number.is_multiple_of(every) || moment.step.is_none() {
                    canvas.paste(camera.shoot(environment)?, width, 0, caption::HEAD);
                    sink.learn(&canvas);
                }
                Ok(())
            })?;
        }
        episode(environment, &mut |moment, environment| {
            go_on()?;
            canvas.paste(camera.shoot(environment)?, width, 0, caption::HEAD);
            let [_, bottom] = canvas.size();
            caption.draw(self.progress(moment, &plans), bottom, &mut canvas);
            sink.add(&canvas, moment.step.is_none())?;
            taken();
            Ok(())
        })?;
        sink.finish()
    }

    /// Progress of the episode at a moment, given the plans of all its control steps.
    fn progress<'p>(&'p self, moment: Moment<'_>, plans: &'p [Option<u32>]) -> Progress<'p> {
        let outcome = &self.trace.outcome;
        let done = &outcome.completions;
        let done_len = done.partition_point(|done| done.step <= moment.number);
        let success = outcome.success;
        Progress {
            plans: plans.get(..moment.number).unwrap_or(plans),
            completions: done.get(..done_len).unwrap_or(done),
            phase: moment
                .step
                .map_or(Phase::Ended { success }, |step| Phase::Acting {
                    plan: step.plan,
                }),
        }
    }
}
