//! What the window shows and what it asks for, between its thread and the one that runs episodes.
//!
//! [`Show`] looks on at the episodes ([`Onlooker`]), copies each state and lets the control step begin when it is due. It only reads, so
//! an episode is the same with and without it. What can fail: nothing.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use mujoco_rs::wrappers::{MjData, MjModel};

use super::pace::Pace;
use crate::environment::Completion;
use crate::rollout::{Glimpse, Go, Onlooker, Stand};

/// How long the start of an episode stays in view, and its end.
const START: Duration = Duration::from_millis(500);
const END: Duration = Duration::from_secs(2);
/// How often an interrupt is looked for.
const GLANCE: Duration = Duration::from_millis(50);

/// An episode as it is shown.
pub struct Shown {
    /// The simulator's state.
    pub data: MjData<Arc<MjModel>>,
    /// Index of the instruction.
    pub instruction: u32,
    /// Number of the episode.
    pub episode: u64,
    /// The sub-tasks that the instruction commands.
    pub commanded: Vec<usize>,
    /// Control steps of a full episode.
    pub max_steps: usize,
    /// Plan of every control step that was executed.
    pub plans: Vec<Option<u32>>,
    /// Completions so far.
    pub completions: Vec<Completion>,
    /// What comes next; `None` before the first control step of all.
    pub stand: Option<Stand>,
    /// What the person asked for.
    pub wish: Wish,
}

/// What a person asked for.
#[derive(Debug, Clone, Copy)]
pub struct Wish {
    /// No control step begins.
    pub paused: bool,
    /// Control steps that begin nevertheless.
    pub single: u32,
    /// The episode is to start again.
    pub again: bool,
    /// Deadlines of control steps.
    pub pace: Pace,
    /// Whether there is a window that shows it.
    pub window: Window,
}

/// A window's life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Window {
    /// Not open yet: episodes wait.
    Awaited,
    /// Open.
    Open,
    /// Closed: episodes stop.
    Closed,
}

/// What both threads know.
pub struct Show<'s> {
    shown: Mutex<Shown>,
    changed: Condvar,
    /// Raised by an interrupt.
    stop: &'s AtomicBool,
    /// Tells the window that there is something new.
    tell: Box<dyn Fn() + Send + Sync + 's>,
}

impl fmt::Debug for Show<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Show").finish_non_exhaustive()
    }
}

impl<'s> Show<'s> {
    /// Nothing to see yet. `model` is the scene's, `period_s` the control period; `tell` is called whenever there is something new.
    pub fn new(
        model: Arc<MjModel>,
        period_s: f64,
        stop: &'s AtomicBool,
        tell: Box<dyn Fn() + Send + Sync + 's>,
    ) -> Self {
        let wish = Wish {
            paused: false,
            single: 0,
            again: false,
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
            stand: None,
            wish,
        };
        Self {
            shown: Mutex::new(shown),
            changed: Condvar::new(),
            stop,
            tell,
        }
    }

    /// What is shown now, while the other thread waits.
    pub fn now(&self) -> MutexGuard<'_, Shown> {
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes what is asked for.
    pub fn ask(&self, change: impl FnOnce(&mut Wish)) {
        change(&mut self.now().wish);
        self.changed.notify_all();
    }

    /// Waits until the control step is due, or `hold` is over where there is one, or what is shown is to end otherwise.
    fn wait(&self, mut shown: MutexGuard<'_, Shown>, hold: Option<Duration>) -> Go {
        let come = Instant::now();
        loop {
            let wish = &mut shown.wish;
            if self.stop.load(Ordering::Relaxed) || wish.window == Window::Closed {
                return Go::Stop;
            }
            if wish.again {
                wish.again = false;
                wish.pace.rest();
                return Go::Again;
            }
            let now = Instant::now();
            let held = wish.window == Window::Awaited || (wish.paused && wish.single == 0);
            let due = hold.map_or_else(|| wish.pace.due(now), |hold| come + hold);
            if held {
                wish.pace.rest();
            } else if now >= due || wish.single > 0 {
                wish.single = wish.single.saturating_sub(1);
                wish.pace.step(due);
                return Go::On;
            }
            let left = due.saturating_duration_since(now);
            let glance = if held { GLANCE } else { left.min(GLANCE) };
            let woken = self.changed.wait_timeout(shown, glance);
            (shown, _) = woken.unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl Shown {
    /// Takes over what there is to see; `None` if the environment has no simulator.
    fn take(&mut self, glimpse: Glimpse<'_>) -> Option<()> {
        let Glimpse {
            task,
            stand,
            environment,
        } = glimpse;
        self.stand = Some(stand);
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

impl Onlooker for Show<'_> {
    fn look(&self, glimpse: Glimpse<'_>) -> Go {
        let stand = glimpse.stand;
        let mut shown = self.now();
        // The window's camera has refused an environment without a simulator.
        let _ = shown.take(glimpse);
        (self.tell)();
        let hold = match stand {
            Stand::Ended { .. } => Some(END),
            Stand::Acting { .. } => shown.plans.is_empty().then_some(START),
        };
        let go = self.wait(shown, hold);
        if let (Go::On, Stand::Acting { plan }) = (go, stand) {
            self.now().plans.push(plan);
        }
        go
    }
}
