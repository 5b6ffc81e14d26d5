//! A window in which a person sees the policy run, at real time.
//!
//! Episodes run on a thread of their own, which only copies each state for the window ([`show`]): they are the same episodes as without it,
//! whatever is dragged, paused or slow to draw. The picture is a film's ([`crate::film`]): drawn off-screen through EGL, with the same
//! captions, and then put into the window, so that the window itself needs no OpenGL. What can fail: no display, no EGL, an environment
//! without a simulator.
//!
//! The simulator's own viewer is not used: it has no place for the captions, for keys of ours or for the scene's camera without an unsafe
//! call or a whole toolkit, and it writes what is dragged back into the simulation.

mod pace;
pub mod show;
mod window;

use std::panic::{self, AssertUnwindSafe};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::thread;

use mujoco_rs::wrappers::MjModel;
use thiserror::Error;
use winit::event_loop::{EventLoop, EventLoopProxy};

use self::show::Show;
use self::window::Screen;
use crate::environment::{Environment, EpisodeSeed};
use crate::film::FilmError;
use crate::film::camera::Camera;
use crate::rollout::Observer;

/// Why no window can be opened.
#[derive(Debug, Error)]
pub enum ViewerError {
    /// No display is named by the environment.
    #[error(
        "no display: set DISPLAY to that of an X server (a Wayland desktop brings one, Xwayland), or film an episode with lads-run record"
    )]
    NoDisplay,
    /// No window can be opened on the display.
    #[error(
        "no window can be opened on display {display}: {reason}; set DISPLAY to that of a running X server with its client libraries (Debian: apt-get install libx11-6 libx11-xcb1 libxcursor1 libxi6 libxkbcommon-x11-0), or film an episode with lads-run record"
    )]
    NoWindow {
        /// Value of `DISPLAY`.
        display: String,
        /// The reason that the display gave.
        reason: String,
    },
    /// The picture cannot be drawn: no EGL, or an environment without a simulator.
    #[error(transparent)]
    Picture(#[from] FilmError),
}

/// Returns the display that X11 programs use, from the environment variable `DISPLAY`.
fn display() -> Result<String, ViewerError> {
    let display = std::env::var("DISPLAY").unwrap_or_default();
    let there = !display.is_empty();
    there.then_some(display).ok_or(ViewerError::NoDisplay)
}

#[expect(clippy::needless_pass_by_value, reason = "what map_err takes")]
fn no_window(reason: impl ToString) -> ViewerError {
    let (display, reason) = (display().unwrap_or_default(), reason.to_string());
    // winit begins with a place in its source: "os error at FILE.rs:LINE: ".
    let said = reason.strip_prefix("os error at ").and_then(|rest| {
        let (_, said) = rest.split_once(".rs:")?;
        Some(said.split_once(": ")?.1.to_owned())
    });
    let reason = said.unwrap_or(reason);
    ViewerError::NoWindow { display, reason }
}

/// Checks early whether there can be a display.
pub fn check() -> Result<(), ViewerError> {
    display().map(drop)
}

/// Texts that the window writes around the pictures.
pub struct Texts {
    /// Index and text of every instruction that may run.
    pub instructions: Vec<(u32, String)>,
    /// Names of the environment's sub-tasks.
    pub sub_tasks: &'static [&'static str],
    /// Episodes of each instruction.
    pub episodes: u32,
    /// Control period in seconds.
    pub period_s: f64,
}

/// A display and a camera, ready for a window.
pub struct Viewer {
    events: EventLoop<()>,
    camera: Camera,
    model: Arc<MjModel>,
}

impl Viewer {
    /// Connects to the display and opens a camera in the scene of `environment`. Must be called on the main thread, once in a program.
    pub fn new(environment: &mut dyn Environment) -> Result<Self, ViewerError> {
        check()?;
        let events = quietly(|| EventLoop::with_user_event().build())?.map_err(no_window)?;
        // Cameras are where they are once the scene is set up; which episode that is does not matter.
        let any = EpisodeSeed {
            seed: 0,
            instruction: 0,
            episode: 0,
        };
        environment.reset(any, &[]);
        let camera = Camera::free(environment, window::picture(window::SIZE))?;
        let id = environment.id();
        let stage = environment.stage().ok_or(FilmError::NoStage(id))?;
        let model = Arc::new(MjModel::clone(stage.data.model()));
        Ok(Self {
            events,
            camera,
            model,
        })
    }

    /// Opens the window and runs `work` beside it, passing the observer for its episodes; closes the window afterwards. A person who closes
    /// the window stops the episodes, and so does `stop`.
    pub fn run<W: Send>(
        self,
        texts: &Texts,
        stop: &AtomicBool,
        work: impl FnOnce(&dyn Observer) -> W + Send,
    ) -> Result<W, ViewerError> {
        let proxy = self.events.create_proxy();
        let tell = proxy.clone();
        let tell = Box::new(move || {
            // A window that is gone has nothing to be told.
            let _ = tell.send_event(());
        });
        let show = Show::new(self.model, texts.period_s, stop, tell);
        let mut screen = Screen::new(&show, self.camera, texts);
        thread::scope(|scope| {
            let done = Done(proxy, screen.done());
            let show = &show;
            let worker = scope.spawn(move || {
                let _done = done;
                work(show)
            });
            let ran = self.events.run_app(&mut screen).map_err(no_window);
            show.ask(|request| request.window = show::Window::Closed);
            let worked = worker.join();
            let worked = worked.unwrap_or_else(|panic| panic::resume_unwind(panic));
            screen.failed().map_or(ran, Err).map(|()| worked)
        })
    }
}

/// Tells the window, when dropped, that the work has ended.
struct Done(EventLoopProxy<()>, Arc<AtomicBool>);

impl Drop for Done {
    fn drop(&mut self) {
        self.1.store(true, std::sync::atomic::Ordering::Relaxed);
        // A window that is gone has nothing to be told.
        let _ = self.0.send_event(());
    }
}

/// Opens a display through winit, and turns a panic of winit, as it does where a library or an extension of the display is missing, into an
/// error.
fn quietly<T>(open: impl FnOnce() -> T) -> Result<T, ViewerError> {
    let hook = panic::take_hook();
    panic::set_hook(Box::new(|_| {}));
    let opened = panic::catch_unwind(AssertUnwindSafe(open));
    panic::set_hook(hook);
    opened.map_err(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or(panic.downcast_ref::<&str>().copied());
        no_window(text.unwrap_or("its libraries gave up"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_library_that_panics_is_a_reason_in_words() {
        assert_eq!(quietly(|| 3).unwrap(), 3);
        let error = quietly(|| panic!("no library {}", "libX")).unwrap_err();
        assert!(error.to_string().contains("no library libX"), "{error}");
        let error = no_window("os error at a/b.rs:7: no server: none");
        assert!(error.to_string().contains(": no server: none;"), "{error}");
        assert!(!error.to_string().contains("b.rs"), "{error}");
    }
}
