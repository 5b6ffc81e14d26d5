//! `frames`: what the environment's camera sees in every state of a dataset.

#[cfg(feature = "camera")]
pub use with::run;
#[cfg(not(feature = "camera"))]
pub use without::run;

#[cfg(feature = "camera")]
mod with {
    use std::fmt::Display;
    use std::path::Path;
    use std::process::ExitCode;
    use std::sync::atomic::AtomicBool;

    use lads_sim::frames::Rendering;
    use lads_sim::frames::cache::{self, States};
    use lads_sim::{assets, registry};

    use crate::arguments::Frames;
    use crate::end::{End, print, refused};
    use crate::{INTERRUPTED, progress_over, threads};

    /// Draws them into a file, or goes on with it.
    pub fn run(asked: &Frames, stop: &AtomicBool) -> Result<ExitCode, End> {
        let threads = threads(asked.threads, false)?;
        let states = States::read(&asked.data).map_err(refused)?;
        let id = &states.environment;
        let noise = registry::default_noise(id).unwrap_or("none");
        let open = registry::load(id, noise, &assets::vendor_dir()).map_err(refused)?;
        let rendering = match &asked.rendering {
            Some(path) => read(path)?,
            None => open().rendering().ok_or_else(|| {
                let wrong = format!("environment {id} has no camera");
                refused(format!("{wrong}; name a dataset of another"))
            })?,
        };
        let bar = progress_over(states.len(), "frames");
        let made = cache::make(
            (&states, &rendering),
            &asked.output,
            (&open, threads),
            stop,
            &mut |done| bar.set_position(done as u64),
        );
        bar.finish_and_clear();
        let made = made.map_err(refused)?;
        let path = asked.output.display();
        if made.done < made.all {
            eprintln!(
                "interrupted: {} of {} frames are kept; the same command goes on",
                made.done, made.all
            );
            return Ok(ExitCode::from(INTERRUPTED));
        }
        print(&format!("{} frames in {path}\n", made.all))?;
        Ok(ExitCode::SUCCESS)
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
