//! The `--report` option: an HTML page of the results. Film strips need the cargo feature `record`, and EGL when it runs; without either
//! the page says so.

#[cfg(feature = "report")]
pub use with::{check, drawn, page, write};
#[cfg(not(feature = "report"))]
pub use without::{check, page, write};

#[cfg(feature = "report")]
mod with {
    use std::path::Path;
    use std::sync::atomic::AtomicBool;

    use lads_sim::evaluate::Evaluation;
    use lads_sim::output;
    use lads_sim::registry::Opener;
    use lads_sim::report::{Report, Strip, composed};
    use lads_sim::results::Results;
    use lads_sim::starts::{self, Drawn};
    use lads_sim::trace::Trace;

    use crate::end::{End, refused, unwritable};

    /// Refuses early if a report could not be written.
    pub fn check(path: Option<&Path>) -> Result<(), End> {
        let outputs: Vec<_> = path.iter().map(|&path| ("--report", path)).collect();
        output::check(&[], &outputs).map_err(refused)
    }

    /// Draws plans at the start of composite instructions and their parts.
    pub fn drawn(evaluation: &Evaluation<'_>, traces: &[Trace]) -> Result<Drawn, End> {
        let instructions = composed(evaluation.contract, traces);
        starts::draw(evaluation, traces, &instructions).map_err(refused)
    }

    /// Renders the page, film strips included.
    pub fn page(
        results: &Results,
        traces: &[Trace],
        evaluation: &Evaluation<'_>,
        open: &Opener,
        (stop, path): (&AtomicBool, &Path),
    ) -> Result<String, End> {
        let drawn = drawn(evaluation, traces)?;
        let report = Report {
            results,
            traces,
            contract: evaluation.contract,
            plans: evaluation.policy.index_count() as usize,
            sub_tasks: open().sub_tasks(),
            drawn: &drawn,
            strips: strips(traces, evaluation, open, stop)?,
        };
        let html = report.html();
        html.map_err(|error| unwritable("--report", path, &error))
    }

    /// Writes the page to `path`.
    pub fn write(page: &str, path: &Path) -> Result<(), End> {
        lads_sim::output::write(path, page.as_bytes())
            .map_err(|error| unwritable("--report", path, &error))
    }

    /// Film strips of the chosen episodes, or why there are none.
    #[cfg(feature = "record")]
    fn strips(
        traces: &[Trace],
        evaluation: &Evaluation<'_>,
        open: &Opener,
        stop: &AtomicBool,
    ) -> Result<Result<Vec<Strip>, String>, End> {
        use lads_sim::film::FilmError;
        use lads_sim::film::camera::Camera;
        use lads_sim::film::strip::STILL;

        let chosen = lads_sim::report::chosen(traces);
        let mut environment = open();
        let mut camera = match Camera::new(environment.as_mut(), STILL) {
            Ok(camera) => camera,
            Err(error) => return Ok(Err(error.to_string())),
        };
        let bar = crate::progress_over(chosen.len(), "film strips");
        let mut strips = Vec::new();
        for trace in chosen {
            let Some(scene) = crate::record::scene(evaluation, trace) else {
                continue;
            };
            match scene.strip(environment.as_mut(), &mut camera, stop) {
                Ok(stills) => strips.push(Strip {
                    title: lads_sim::report::title(evaluation.contract, trace),
                    stills,
                }),
                Err(FilmError::Interrupted) => return Err(End::Interrupted),
                Err(error) => return Ok(Err(error.to_string())),
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(Ok(strips))
    }

    /// Says why there are no film strips: this build has no pictures.
    #[cfg(not(feature = "record"))]
    #[expect(
        clippy::unnecessary_wraps,
        reason = "with pictures it can be interrupted"
    )]
    fn strips(
        _: &[Trace],
        _: &Evaluation<'_>,
        _: &Opener,
        _: &AtomicBool,
    ) -> Result<Result<Vec<Strip>, String>, End> {
        Ok(Err(
            "this lads-run was built without pictures (cargo feature record)".to_owned(),
        ))
    }
}

/// Stand-in for builds without reports.
#[cfg(not(feature = "report"))]
mod without {
    use std::path::Path;
    use std::sync::atomic::AtomicBool;

    use lads_sim::evaluate::Evaluation;
    use lads_sim::registry::Opener;
    use lads_sim::results::Results;
    use lads_sim::trace::Trace;

    use crate::end::{End, refused};

    /// Refuses `--report`, which this build does not have.
    pub fn check(path: Option<&Path>) -> Result<(), End> {
        match path {
            None => Ok(()),
            Some(_) => Err(refused(
                "--report: this lads-run was built without reports; build it with \"cargo build --release -p lads-sim --features report\"",
            )),
        }
    }

    /// Never called: [`check`] refuses `--report`.
    pub fn page(
        _: &Results,
        _: &[Trace],
        _: &Evaluation<'_>,
        _: &Opener,
        (_, path): (&AtomicBool, &Path),
    ) -> Result<String, End> {
        check(Some(path)).map(|()| String::new())
    }

    /// Never called: [`check`] refuses `--report`.
    pub fn write(_: &str, path: &Path) -> Result<(), End> {
        check(Some(path))
    }
}
