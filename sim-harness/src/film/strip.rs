//! Film strips of a report: an episode at its start, at its completions and at its end. What can fail: what can fail in a film.

use std::sync::atomic::{AtomicBool, Ordering};

use jpeg_encoder::{ColorType, Encoder};

use super::camera::Camera;
use super::{FilmError, Moment, Scene, play};
use crate::environment::Environment;
use crate::report::Still;

/// Width and height of a picture, in pixels; the page shows it smaller, and in this size when it is enlarged.
pub const STILL: [u32; 2] = [640, 480];

/// JPEG quality of the pictures in per cent.
const QUALITY: u8 = 80;

impl Scene<'_> {
    /// Draws the episode in a few pictures; `camera` takes them of size [`STILL`].
    pub fn strip(
        &self,
        environment: &mut dyn Environment,
        camera: &mut Camera,
        stop: &AtomicBool,
    ) -> Result<Vec<Still>, FilmError> {
        let names = environment.sub_tasks();
        let completions = &self.trace.outcome.completions;
        let mut stills = Vec::new();
        let mut look = |moment: Moment<'_>, environment: &mut dyn Environment| {
            if stop.load(Ordering::Relaxed) {
                return Err(FilmError::Interrupted);
            }
            let done = completions.iter().filter(|done| done.step == moment.number);
            let done = done.map(|done| names.get(done.sub_task).copied().unwrap_or("?"));
            let mut what: Vec<&str> = done.collect();
            match moment.step {
                Some(_) if moment.number == 0 => what.push("start"),
                None if what.is_empty() => what.push("end"),
                _ => {}
            }
            if !what.is_empty() {
                stills.push(Still {
                    caption: format!("step {}: {}", moment.number, what.join(", ")),
                    jpeg: jpeg(camera.shoot(environment)?)?,
                });
            }
            Ok(())
        };
        play(
            self.trace,
            self.commanded,
            self.seed,
            environment,
            &mut look,
        )?;
        Ok(stills)
    }
}

fn jpeg(rgb: &[u8]) -> Result<Vec<u8>, FilmError> {
    let [width, height] = STILL.map(|pixels| pixels as u16);
    let mut bytes = Vec::new();
    let encoder = Encoder::new(&mut bytes, QUALITY);
    let encoded = encoder.encode(rgb, width, height, ColorType::Rgb);
    encoded.map_err(|error| FilmError::Draw(error.to_string()))?;
    Ok(bytes)
}
