//! The `record` subcommand: films an episode.
//!
//! The place, ffmpeg and EGL are looked at before the first episode; filming follows after the last, and is renamed to its place at the end.

#[cfg(all(feature = "record", feature = "report"))]
pub use with::scene;
#[cfg(feature = "record")]
pub use with::{Recording, check, prepare};
#[cfg(not(feature = "record"))]
pub use without::{Recording, check, prepare};

#[cfg(feature = "record")]
mod with {
    use std::fmt::Display;
    use std::path::{Path, PathBuf};
    use std::sync::atomic::AtomicBool;

    use lads_sim::environment::Environment;
    use lads_sim::evaluate::Evaluation;
    use lads_sim::film::camera::Camera;
    use lads_sim::film::file::{Finished, Form};
    use lads_sim::film::{FilmError, PICTURE, Scene};
    use lads_sim::registry::Opener;
    use lads_sim::trace::Trace;

    use crate::arguments::Record;
    use crate::end::{End, refused};
    use crate::progress_over;

    /// A place, an environment and a camera, ready to film.
    pub struct Recording {
        form: Form,
        path: PathBuf,
        episode: u32,
        environment: Box<dyn Environment>,
        camera: Camera,
    }

    /// A complete film under a temporary name.
    pub struct Film {
        finished: Finished,
        path: PathBuf,
    }

    fn about(path: &Path, wrong: impl Display) -> End {
        refused(format!("record {}: {wrong}", path.display()))
    }

    fn failed(path: &Path, error: FilmError) -> End {
        match error {
            FilmError::Interrupted => End::Interrupted,
            error => about(path, error),
        }
    }

    /// Refuses early if pictures could not be written.
    pub fn check(asked: Option<&Record>) -> Result<(), End> {
        let Some(Record { out, .. }) = asked else {
            return Ok(());
        };
        Form::of(out).map(drop).map_err(|error| about(out, error))
    }

    /// Opens an environment and a camera in it; `None` for other jobs.
    pub fn prepare(
        asked: Option<&Record>,
        evaluation: &Evaluation<'_>,
        open: &Opener,
    ) -> Result<Option<Recording>, End> {
        let Some(&Record {
            out: ref path,
            episode,
            ..
        }) = asked
        else {
            return Ok(None);
        };
        let episodes = evaluation.episodes;
        if episode >= episodes {
            return Err(refused(format!(
                "--episode {episode}: there are {episodes} episodes, counted from 0; give more --episodes"
            )));
        }
        let form = Form::of(path).map_err(|error| about(path, error))?;
        let mut environment = open();
        let camera = Camera::new(environment.as_mut(), PICTURE);
        Ok(Some(Recording {
            form,
            path: path.clone(),
            episode,
            camera: camera.map_err(|error| failed(path, error))?,
            environment,
        }))
    }

    /// Prepares a recorded episode for filming; `None` if it is not an episode of this evaluation.
    pub fn scene<'s>(evaluation: &'s Evaluation<'_>, trace: &'s Trace) -> Option<Scene<'s>> {
        let mut assignments = evaluation.assignments.iter();
        let assignment = assignments.find(|it| it.instruction == trace.instruction)?;
        let known = evaluation.instruction(assignment.instruction)?;
        Some(Scene {
            trace,
            instruction: known.text,
            commanded: &assignment.commanded,
            seed: evaluation.seed,
        })
    }

    impl Recording {
        /// Films the episode of the first instruction that ran.
        pub fn film(
            mut self,
            evaluation: &Evaluation<'_>,
            traces: &[Trace],
            stop: &AtomicBool,
        ) -> Result<Film, End> {
            // Traces are in the order of the assignments.
            let mut traces = traces.iter();
            let trace = traces.find(|trace| trace.episode == self.episode);
            let Some(scene) = trace.and_then(|trace| scene(evaluation, trace)) else {
                return Err(about(&self.path, "no episode ran"));
            };
            let bar = progress_over(scene.trace.steps.len() + 1, "pictures");
            let finished = scene.film(
                self.environment.as_mut(),
                &mut self.camera,
                (self.form, &self.path),
                stop,
                &|| bar.inc(1),
            );
            bar.finish_and_clear();
            Ok(Film {
                finished: finished.map_err(|error| failed(&self.path, error))?,
                path: self.path,
            })
        }
    }

    impl Film {
        /// Moves the film to its final path.
        pub fn write(self) -> Result<(), End> {
            let written = self.finished.persist(&self.path);
            written.map_err(|error| failed(&self.path, error))
        }
    }
}

/// Stand-in for builds without pictures.
#[cfg(not(feature = "record"))]
mod without {
    use std::sync::atomic::AtomicBool;

    use lads_sim::evaluate::Evaluation;
    use lads_sim::registry::Opener;
    use lads_sim::trace::Trace;

    use crate::arguments::Record;
    use crate::end::{End, refused};

    /// Uninhabited: this build cannot record.
    pub enum Recording {}

    /// Uninhabited: this build cannot record.
    pub enum Film {}

    /// Refuses `record`, which this build does not have.
    pub fn check(asked: Option<&Record>) -> Result<(), End> {
        match asked {
            None => Ok(()),
            Some(_) => Err(refused(
                "record: this lads-run was built without pictures; build it with \"cargo build --release -p lads-sim --features record\"",
            )),
        }
    }

    /// Always `None`: [`check`] has refused `record`.
    #[expect(
        clippy::unnecessary_wraps,
        reason = "with pictures there may be no EGL"
    )]
    pub fn prepare(
        _: Option<&Record>,
        _: &Evaluation<'_>,
        _: &Opener,
    ) -> Result<Option<Recording>, End> {
        Ok(None)
    }

    impl Recording {
        pub fn film(self, _: &Evaluation<'_>, _: &[Trace], _: &AtomicBool) -> Result<Film, End> {
            match self {}
        }
    }

    impl Film {
        pub fn write(self) -> Result<(), End> {
            match self {}
        }
    }
}
