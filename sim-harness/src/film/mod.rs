//! Films an episode after it ran.
//!
//! A film runs the executed actions of a [`Trace`] once more, in an environment of its own, and looks at every state on the way. So
//! filming cannot change or slow down the rollout, and what is shown is what happened: a second run that ends elsewhere is refused.
//! [`camera`] draws a state without a display, [`caption`] writes around it, [`file`](mod@file) makes it a GIF, a film or a folder of pictures.
//! What can fail: a machine without EGL, an environment without a simulator, a file that cannot be written.

pub mod camera;
#[cfg(feature = "record")]
pub mod canvas;
#[cfg(feature = "record")]
pub mod caption;
#[cfg(unix)]
pub mod driver;
#[cfg(feature = "record")]
pub mod file;
#[cfg(feature = "record")]
mod gif;
#[cfg(feature = "record")]
mod mp4;
#[cfg(feature = "record")]
mod scene;
#[cfg(feature = "report")]
pub mod strip;

use thiserror::Error;

use crate::environment::{ActionError, Environment, EpisodeSeed};
use crate::trace::{Step, Trace};

#[cfg(feature = "record")]
pub use self::scene::{PICTURE, Scene};

/// Why an episode cannot be filmed or drawn.
#[derive(Debug, Error)]
pub enum FilmError {
    /// The environment has no simulator to draw.
    #[error("environment {0} has no simulator to look into")]
    NoStage(&'static str),
    /// The scene lacks the camera that its environment names.
    #[error("the scene has no camera '{0}' (run \"make setup\" to restore the assets)")]
    NoCamera(String),
    /// OpenGL without a display is not available.
    #[error(
        "pictures need OpenGL without a display, by EGL: {0}; install it (Debian: apt-get install libegl1 libgl1-mesa-dri)"
    )]
    NoEgl(String),
    /// A frame cannot be drawn as requested.
    #[error("frames cannot be drawn: {0}")]
    Rendering(String),
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
