//! `frames`: what the environment's camera sees in every state of a dataset, or in states that another program sends.

#[cfg(feature = "camera")]
pub use with::run;
#[cfg(not(feature = "camera"))]
pub use without::run;

#[cfg(feature = "camera")]
mod with {
    use std::fmt::Display;
    use std::io;
    use std::path::Path;
    use std::process::ExitCode;
    use std::sync::atomic::AtomicBool;

    use lads_sim::environment::Environment;
    use lads_sim::frames::Rendering;
    use lads_sim::frames::cache::{self, States};
    use lads_sim::frames::stream::{self, Heading};
    use lads_sim::{assets, registry, results};

    use crate::arguments::Frames;
    use crate::end::{End, print, refused};
    use crate::{INTERRUPTED, progress_over, threads};

    /// Draws what was asked for.
    pub fn run(asked: &Frames, stop: &AtomicBool) -> Result<ExitCode, End> {
        match (&asked.stream, &asked.data, &asked.output) {
            (Some(environment), ..) => serve(asked, environment),
            (None, Some(data), Some(output)) => file(asked, (data, output), stop),
            _ => Err(refused("frames: name a dataset and -o FILE, or --stream")),
        }
    }

    /// Draws a dataset's into a file, or goes on with it.
    fn file(
        asked: &Frames,
        (data, output): (&Path, &Path),
        stop: &AtomicBool,
    ) -> Result<ExitCode, End> {
        let threads = threads(asked.threads, false)?;
        let states = States::read(data).map_err(refused)?;
        let open = load(&states.environment)?;
        let rendering = rendering(asked, &states.environment, open().as_ref())?;
        let bar = progress_over(states.len(), "frames");
        let made = cache::make(
            (&states, &rendering),
            output,
            (&open, threads),
            stop,
            &mut |done| bar.set_position(done as u64),
        );
        bar.finish_and_clear();
        let made = made.map_err(refused)?;
        if made.done < made.all {
            eprintln!(
                "interrupted: {} of {} frames are kept; the same command goes on",
                made.done, made.all
            );
            return Ok(ExitCode::from(INTERRUPTED));
        }
        print(&format!("{} frames in {}\n", made.all, output.display()))?;
        Ok(ExitCode::SUCCESS)
    }

    /// Draws states as they come, until there are no more.
    fn serve(asked: &Frames, id: &str) -> Result<ExitCode, End> {
        let environment = load(id)?();
        let rendering = rendering(asked, id, environment.as_ref())?;
        let mut frames =
            lads_sim::frames::Frames::new(environment.as_ref(), &rendering).map_err(refused)?;
        let heading = Heading {
            environment: id,
            rendering: &rendering,
            positions: environment.state().len(),
            versions: results::versions(),
        };
        let drawing = (&mut frames, &heading);
        let served = stream::serve(drawing, io::stdin().lock(), io::stdout().lock());
        served.map_err(|error| refused(format!("--stream {id}: {error}")))?;
        Ok(ExitCode::SUCCESS)
    }

    /// Opens an environment's scene; what it observes does not matter.
    fn load(id: &str) -> Result<registry::Opener, End> {
        let noise = registry::default_noise(id).unwrap_or("none");
        registry::load(id, noise, &assets::vendor_dir()).map_err(refused)
    }

    /// How the frames are drawn: as asked, or as the environment's benchmark has it.
    fn rendering(
        asked: &Frames,
        id: &str,
        environment: &dyn Environment,
    ) -> Result<Rendering, End> {
        match &asked.rendering {
            Some(path) => read(path),
            None => environment.rendering().ok_or_else(|| {
                let wrong = format!("environment {id} has no camera");
                refused(format!("{wrong}; name another"))
            }),
        }
    }

    /// The rendering in a file.
    fn read(path: &Path) -> Result<Rendering, End> {
        let refused = |wrong: &dyn Display| {
            refused(format!(
                "--rendering {}: {wrong}; take the `rendering` of a bundle's image channel",
                path.display()
            ))
        };
        let text = lads_host::input::read_to_string(path).map_err(|error| refused(&error))?;
        let rendering: Rendering = serde_json::from_str(&text).map_err(|error| refused(&error))?;
        rendering.check().map_err(|wrong| refused(&wrong))?;
        Ok(rendering)
    }
}

#[cfg(not(feature = "camera"))]
mod without {
    use std::process::ExitCode;
    use std::sync::atomic::AtomicBool;

    use crate::arguments::Frames;
    use crate::end::{End, refused};

    /// Refuses: the renderer is not built in.
    pub fn run(_: &Frames, _: &AtomicBool) -> Result<ExitCode, End> {
        Err(refused(
            "frames: this lads-run was built without cameras; build it with --features camera",
        ))
    }
}
