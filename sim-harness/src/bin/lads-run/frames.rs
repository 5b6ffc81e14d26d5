//! `frames`: what the environment's camera sees in every state of a dataset.

#[cfg(feature = "camera")]
pub use with::run;
#[cfg(not(feature = "camera"))]
pub use without::run;

#[cfg(feature = "camera")]
mod with {
    use std::process::ExitCode;
    use std::sync::atomic::AtomicBool;

    use lads_sim::frames::cache::{self, States};
    use lads_sim::{assets, registry};

    use crate::arguments::Frames;
    use crate::end::{End, print, refused};
    use crate::{progress_over, threads};

    /// Draws them into a file, or goes on with it.
    pub fn run(asked: &Frames, stop: &AtomicBool) -> Result<ExitCode, End> {
        let threads = threads(asked.threads, false)?;
        let states = States::read(&asked.data).map_err(refused)?;
        let id = &states.environment;
        let noise = registry::default_noise(id).unwrap_or("none");
        let open = registry::load(id, noise, &assets::vendor_dir()).map_err(refused)?;
        let rendering = open().rendering().ok_or_else(|| {
            refused(format!(
                "environment {id} has no camera; name a dataset of another"
            ))
        })?;
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
            return Err(refused(format!(
                "stopped after {} of {} frames; the same command goes on",
                made.done, made.all
            )));
        }
        print(&format!("{} frames in {path}\n", made.all))?;
        Ok(ExitCode::SUCCESS)
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
