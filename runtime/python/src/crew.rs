//! Threads of a batch: a control step of many controllers, by the caller and by threads of the
//! batch's own.
//!
//! A control step of the batch is an order: a number, and the observations of all rows. The caller
//! gives it and works at it himself, the threads help. Each row has a lock of its own and knows the
//! number of the last order that it followed: whoever locks it first steps it, nobody does so twice,
//! and the caller locks every row in the end and steps what nobody has begun. So no order waits for
//! a thread that sleeps, and one that wakes late finds nothing to do.
//!
//! After an order the threads watch for the next one for [`WATCH`] before they sleep: the system
//! takes longer to wake a thread than some controllers to step. What can fail: the system has no
//! more threads; a step that panics, after which the batch is of no use ([`Broken`]).

use std::hint;
use std::io;
use std::num::NonZero;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockWriteGuard, TryLockError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use lads_core::{ChannelId, Data, StepError, StepReport};

use crate::arrays::Staged;
use crate::cell::Working;

/// Time for which a thread looks for the next order before it sleeps: a loop that steps
/// again at once finds it awake, one at a robot's rate pays 0.5 % of a core for it.
const WATCH: Duration = Duration::from_micros(100);

/// Looks at a lock or an order between two looks at the clock.
const LOOKS: usize = 64;

/// Number of the order that ends the threads.
const END: u64 = u64::MAX;

/// One of the controllers, with the results of its last step.
pub struct Row {
    /// The running controller.
    pub working: Working,
    /// Its last action.
    pub action: Vec<f32>,
    /// Report of its last step that was not refused.
    pub report: StepReport,
    /// Why its last step gave no action.
    pub failed: Option<StepError>,
    order: u64,
}

impl Row {
    /// Makes a row of a controller without a step, whose actions have `action_len` elements.
    pub fn new(working: Working, action_len: usize) -> Self {
        Self {
            working,
            action: vec![0.0; action_len],
            report: StepReport {
                timestep: 0,
                selected: None,
            },
            failed: None,
            order: 0,
        }
    }

    /// Steps the controller by an order that it has not followed yet.
    fn follow(&mut self, order: &Order, i: usize, count: usize) {
        if self.order == order.number {
            return;
        }
        self.order = order.number;
        let (working, action) = (&mut self.working, &mut self.action);
        let stepped = working.with(|controller| match &order.staged[..] {
            [only] => match only.row(i, count) {
                (_, Data::F32(values)) => controller.step(values, action),
                other => controller.step_with(&[other], action),
            },
            _ => controller.step_with(&order.inputs(i, count), action),
        });
        self.failed = stepped.as_ref().err().copied();
        if let Ok(report) = stepped {
            self.report = report;
        }
    }
}

/// Observations of all rows, and the number of the control step that they belong to.
pub struct Order {
    /// Copies of the observations, `[count, ...]` for each channel.
    pub staged: Vec<Staged>,
    number: u64,
}

impl Order {
    /// Returns the observations of row `i` of `count`.
    pub fn inputs(&self, i: usize, count: usize) -> Vec<(ChannelId, Data<'_>)> {
        self.staged.iter().map(|row| row.row(i, count)).collect()
    }
}

/// What the caller and the threads share.
struct Shared {
    order: RwLock<Order>,
    rows: Vec<Mutex<Row>>,
    /// Number of the last order, for those who wait for the next.
    latest: AtomicU64,
    watch: Duration,
}

impl Shared {
    /// Steps the rows that nobody works at, from row `first` on.
    fn work(&self, first: usize) {
        let order = self.order.read().unwrap_or_else(PoisonError::into_inner);
        let count = self.rows.len();
        for i in (first..count).chain(0..first) {
            if let Ok(mut row) = self.rows[i].try_lock() {
                row.follow(&order, i, count);
            }
        }
    }

    /// Waits for another order than `seen` and returns its number.
    fn next(&self, seen: u64) -> u64 {
        let begun = Instant::now();
        loop {
            for _ in 0..LOOKS {
                let latest = self.latest.load(Ordering::Acquire);
                if latest != seen {
                    return latest;
                }
                hint::spin_loop();
            }
            if begun.elapsed() >= self.watch {
                thread::park();
            }
        }
    }

    /// Works at all orders until the last.
    fn serve(&self, first: usize) {
        let mut seen = 0;
        loop {
            seen = self.next(seen);
            if seen == END {
                return;
            }
            self.work(first);
        }
    }

    /// Publishes the number of an order.
    fn publish(&self, number: u64, threads: &[JoinHandle<()>]) {
        self.latest.store(number, Ordering::Release);
        for thread in threads {
            thread.thread().unpark();
        }
    }
}

/// A controller panicked in a step.
#[derive(Debug)]
pub struct Broken;

/// Controllers with the threads that step them; dropping it ends the threads.
pub struct Crew {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl Crew {
    /// Starts the threads, one less than `workers`, for the caller is one.
    pub fn start(rows: Vec<Row>, staged: Vec<Staged>, workers: usize) -> io::Result<Self> {
        let count = rows.len();
        // More threads than cores would take the time from each other, watching.
        let cores = thread::available_parallelism().map_or(1, NonZero::get);
        let shared = Arc::new(Shared {
            order: RwLock::new(Order { staged, number: 0 }),
            rows: rows.into_iter().map(Mutex::new).collect(),
            latest: AtomicU64::new(0),
            watch: if workers <= cores {
                WATCH
            } else {
                Duration::ZERO
            },
        });
        let mut crew = Self {
            shared,
            threads: vec![],
        };
        for place in 1..workers {
            let shared = Arc::clone(&crew.shared);
            let first = place * count / workers;
            let named = thread::Builder::new().name(format!("lads-{place}"));
            crew.threads.push(named.spawn(move || shared.serve(first))?);
        }
        Ok(crew)
    }

    /// Returns the next order, whose observations are to be written.
    pub fn order(&self) -> RwLockWriteGuard<'_, Order> {
        let order = self.shared.order.write();
        order.unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the row `i`.
    pub fn row(&self, i: usize) -> Result<MutexGuard<'_, Row>, Broken> {
        self.shared.rows[i].lock().map_err(|_| Broken)
    }

    /// Returns a row that somebody may be working at, and will soon have done.
    fn done(&self, i: usize) -> Result<MutexGuard<'_, Row>, Broken> {
        let mut begun = None;
        loop {
            for _ in 0..LOOKS {
                match self.shared.rows[i].try_lock() {
                    Ok(row) => return Ok(row),
                    Err(TryLockError::Poisoned(_)) => return Err(Broken),
                    Err(TryLockError::WouldBlock) => hint::spin_loop(),
                }
            }
            if begun.get_or_insert_with(Instant::now).elapsed() >= self.shared.watch {
                return self.row(i);
            }
        }
    }

    /// Steps all rows by the order, and calls `each` with the number of every row and the row.
    pub fn step(&self, mut each: impl FnMut(usize, &Row)) -> Result<(), Broken> {
        let number = {
            let mut order = self.order();
            order.number += 1;
            order.number
        };
        self.shared.publish(number, &self.threads);
        self.shared.work(0);
        let order = self.shared.order.read();
        let order = order.unwrap_or_else(PoisonError::into_inner);
        let count = self.shared.rows.len();
        for i in 0..count {
            let mut row = self.done(i)?;
            row.follow(&order, i, count);
            each(i, &row);
        }
        Ok(())
    }

    /// Checks the observations of the order with `check`; returns the refused rows.
    pub fn refused<E>(
        &self,
        check: impl Fn(&[(ChannelId, Data<'_>)]) -> Result<(), E>,
    ) -> Vec<(usize, E)> {
        let order = self.shared.order.read();
        let order = order.unwrap_or_else(PoisonError::into_inner);
        let count = self.shared.rows.len();
        (0..count)
            .filter_map(|i| Some((i, check(&order.inputs(i, count)).err()?)))
            .collect()
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        self.shared.publish(END, &self.threads);
        for thread in self.threads.drain(..) {
            // One that panicked has said so.
            let _ = thread.join();
        }
    }
}
