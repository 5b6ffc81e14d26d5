//! State shared between the window's thread and the one that runs episodes: what to show, and what the person asked for.
//!
//! [`Show`] is the [`Observer`] of the episodes: it copies each state and lets the control step begin when it is due. It only reads, so
//! an episode is the same with and without it. What can fail: nothing.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use mujoco_rs::wrappers::{MjData, MjModel};

use super::pace::Pace;
use crate::environment::Completion;
use crate::rollout::{Control, Observer, Phase, Snapshot};

/// Time that the start of an episode stays in view, and below, that of its end.
const START: Duration = Duration::from_millis(500);
const END: Duration = Duration::from_secs(2);
/// Interval at which an interrupt is looked for.
const GLANCE: Duration = Duration::from_millis(50);

/// State of the episode that the window shows.
pub struct Shown {
    /// The simulator's state.
    pub data: MjData<Arc<MjModel>>,
    /// Index of the instruction.
    pub instruction: u32,
    /// Number of the episode.
    pub episode: u64,
    /// Indices of the sub-tasks that the instruction commands.
    pub commanded: Vec<usize>,
    /// Number of control steps of a full episode.
    pub max_steps: usize,
    /// Plan of every control step that was executed.
    pub plans: Vec<Option<u32>>,
    /// Completions so far.
    pub completions: Vec<Completion>,
    /// Phase of the episode; `None` before the first control step of all.
    pub phase: Option<Phase>,
    /// Requests of the person at the window.
    pub request: Request,
}

/// Requests of the person at the window.
#[derive(Debug, Clone, Copy)]
pub struct Request {
    /// Whether control steps wait.
    pub paused: bool,
    /// Number of control steps to execute nevertheless.
    pub single: u32,
    /// Whether the episode is to start again.
    pub restart: bool,
    /// Pace of the control steps.
    pub pace: Pace,
    /// State of the window.
    pub window: Window,
}

/// State of the viewer's window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Window {
    /// The window is not open yet: episodes wait.
    Awaited,
    /// The window is open.
    Open,
    /// The window is closed: episodes stop.
    Closed,
}

/// Connection between the window's thread and the episodes' thread.
pub struct Show<'s> {
    shown: Mutex<Shown>,
    changed: Condvar,
    /// Raised by an interrupt.
    stop: &'s AtomicBool,
    /// Tells the window that there is something new to draw.
    tell: Box<dyn Fn() + Send + Sync + 's>,
}

impl fmt::Debug for Show<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Show").finish_non_exhaustive()
    }
}

impl<'s> Show<'s> {
    /// Makes a connection with nothing to show yet. `model` is the scene's, `period_s` the control period; `tell` is called whenever there
    /// is something new.
    pub fn new(
        model: Arc<MjModel>,
        period_s: f64,
        stop: &'s AtomicBool,
        tell: Box<dyn Fn() + Send + Sync + 's>,
    ) -> Self {
        let request = Request {
            paused: false,
            single: 0,
            restart: false,
            pace: Pace::new(period_s),
            window: Window::Awaited,
        };
        let shown = Shown {
            data: MjData::new(model),
            instruction: 0,
            episode: 0,
            commanded: Vec::new(),
            max_steps: 0,
            plans: Vec::new(),
            completions: Vec::new(),
            phase: None,
            request,
        };
        Self {
            shown: Mutex::new(shown),
            changed: Condvar::new(),
            stop,
            tell,
        }
    }

    /// Locks and returns the shown state; the other thread waits meanwhile.
    pub fn now(&self) -> MutexGuard<'_, Shown> {
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the person's requests and wakes the episodes' thread.
    pub fn ask(&self, change: impl FnOnce(&mut Request)) {
        change(&mut self.now().request);
        self.changed.notify_all();
    }

    /// Waits until the control step is due, or `hold` is over where given, or the episode is to stop or restart.
    fn wait(&self, mut shown: MutexGuard<'_, Shown>, hold: Option<Duration>) -> Control {
        let come = Instant::now();
        loop {
            let request = &mut shown.request;
            if self.stop.load(Ordering::Relaxed) || request.window == Window::Closed {
                return Control::Stop;
            }
            if request.restart {
                request.restart = false;
                request.pace.rest();
                return Control::Restart;
            }
            let now = Instant::now();
            let held = request.window == Window::Awaited || (request.paused && request.single == 0);
            let due = hold.map_or_else(|| request.pace.due(now), |hold| come + hold);
            if held {
                request.pace.rest();
            } else if now >= due || request.single > 0 {
                request.single = request.single.saturating_sub(1);
                request.pace.step(due);
                return Control::Continue;
            }
            let left = due.saturating_duration_since(now);
            let glance = if held { GLANCE } else { left.min(GLANCE) };
            let woken = self.changed.wait_timeout(shown, glance);
            (shown, _) = woken.unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl Shown {
    /// Copies the snapshot into the shown state; `None` if the environment has no simulator.
    fn take(&mut self, snapshot: Snapshot<'_>) -> Option<()> {
        let Snapshot {
            task,
            phase,
            environment,
        } = snapshot;
        self.phase = Some(phase);
        self.instruction = task.instruction;
        self.episode = task.seed.episode;
        self.max_steps = task.max_steps;
        self.commanded.clear();
        self.commanded.extend_from_slice(task.commanded);
        self.plans.truncate(environment.steps());
        self.completions.clear();
        self.completions
            .extend_from_slice(environment.completions());
        let seen = environment.stage()?.data.copy_visual_to(&mut self.data);
        seen.ok()
    }
}

impl Observer for Show<'_> {
    fn observe(&self, snapshot: Snapshot<'_>) -> Control {
        let phase = snapshot.phase;
        let mut shown = self.now();
        // The window's camera has refused an environment without a simulator.
        let _ = shown.take(snapshot);
        (self.tell)();
        let hold = match phase {
            Phase::Ended { .. } => Some(END),
            Phase::Acting { .. } => shown.plans.is_empty().then_some(START),
        };
        let control = self.wait(shown, hold);
        if let (Control::Continue, Phase::Acting { plan }) = (control, phase) {
            self.now().plans.push(plan);
        }
        control
    }
}
