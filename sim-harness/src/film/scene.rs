//! Filming one episode, with captions. What can fail: an episode that ends elsewhere when it is run again, a file that cannot be written.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::camera::Camera;
use super::canvas::Canvas;
use super::caption::{self, Caption, Progress};
use super::file::{Finished, Form, Sink, shown_s};
use super::{FilmError, Look, Moment, play};
use crate::environment::Environment;
use crate::rollout::Phase;
use crate::trace::Trace;

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
