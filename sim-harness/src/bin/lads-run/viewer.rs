//! The `view` subcommand: episodes in a window.
//!
//! The display and EGL are looked at before the first episode. A window that is closed ends the run with what was finished.

#[cfg(feature = "viewer")]
pub use with::{Viewer, check, prepare};
#[cfg(not(feature = "viewer"))]
pub use without::{Viewer, check, prepare};

#[cfg(feature = "viewer")]
mod with {
    use std::sync::atomic::{AtomicBool, Ordering};

    use lads_sim::evaluate::{Evaluated, Evaluation, Setup};
    use lads_sim::film::FilmError;
    use lads_sim::registry::Opener;
    use lads_sim::viewer::{self, Texts, Viewer as Window, ViewerError};

    use crate::end::{End, refused};
    use crate::{progress, unfinished};

    /// A window and its texts, ready to show episodes.
    pub struct Viewer {
        window: Window,
        texts: Texts,
    }

    fn about(error: ViewerError) -> End {
        match error {
            ViewerError::Picture(FilmError::Interrupted) => End::Interrupted,
            error => refused(format!("view: {error}")),
        }
    }

    /// Refuses early if there can be no display.
    pub fn check(asked: bool) -> Result<(), End> {
        if asked {
            viewer::check().map_err(about)?;
        }
        Ok(())
    }

    /// Connects to the display and opens a camera; `None` for other jobs.
    pub fn prepare(
        asked: bool,
        evaluation: &Evaluation<'_>,
        open: &Opener,
    ) -> Result<Option<Viewer>, End> {
        if !asked {
            return Ok(None);
        }
        let mut environment = open();
        let window = Window::new(environment.as_mut()).map_err(about)?;
        let instructions = evaluation.assignments.iter().filter_map(|assignment| {
            let known = evaluation.instruction(assignment.instruction)?;
            Some((assignment.instruction, known.text.to_owned()))
        });
        let texts = Texts {
            instructions: instructions.collect(),
            sub_tasks: environment.sub_tasks(),
            episodes: evaluation.episodes,
            period_s: environment.control_period_s(),
        };
        Ok(Some(Viewer { window, texts }))
    }

    impl Viewer {
        /// Runs the episodes in view, one after the other; returns those that were finished when the window was closed.
        pub fn evaluate(
            self,
            evaluation: &Evaluation<'_>,
            open: &Opener,
            stop: &AtomicBool,
        ) -> Result<Evaluated, End> {
            let bar = progress(evaluation.len());
            let shown = self.window.run(&self.texts, stop, |observer| {
                let setup = Setup {
                    observer: Some(observer),
                    ..evaluation.setup
                };
                let seen = Evaluation {
                    setup,
                    ..*evaluation
                };
                seen.run_until(open, stop, &|| bar.inc(1))
            });
            bar.finish_and_clear();
            let evaluated = shown.map_err(about)?.map_err(unfinished)?;
            let stopped = stop.load(Ordering::Relaxed);
            (!stopped).then_some(evaluated).ok_or(End::Interrupted)
        }
    }
}

/// Stand-in for builds without a window.
#[cfg(not(feature = "viewer"))]
mod without {
    use std::sync::atomic::AtomicBool;

    use lads_sim::evaluate::{Evaluated, Evaluation};
    use lads_sim::registry::Opener;

    use crate::end::{End, refused};

    /// Uninhabited: this build has no window.
    pub enum Viewer {}

    /// Refuses `view`, which this build does not have.
    pub fn check(asked: bool) -> Result<(), End> {
        if !asked {
            return Ok(());
        }
        Err(refused(
            "view: this lads-run was built without a window; build it with \"cargo build --release -p lads-sim --features viewer\"",
        ))
    }

    /// Always `None`: [`check`] has refused `view`.
    #[expect(
        clippy::unnecessary_wraps,
        reason = "with a window there may be no display"
    )]
    pub fn prepare(_: bool, _: &Evaluation<'_>, _: &Opener) -> Result<Option<Viewer>, End> {
        Ok(None)
    }

    impl Viewer {
        pub fn evaluate(
            self,
            _: &Evaluation<'_>,
            _: &Opener,
            _: &AtomicBool,
        ) -> Result<Evaluated, End> {
            match self {}
        }
    }
}
