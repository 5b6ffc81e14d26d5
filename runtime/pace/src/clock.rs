//! Periodic clock with absolute deadlines, as in a control loop: a late tick does not shift the
//! ones after it.
//!
//! Nothing can fail: where the kernel cannot sleep until a deadline (not Linux), the ticker sleeps
//! for the remaining time.

use std::time::Duration;

use rustix::time::{ClockId, Timespec, clock_gettime};

/// Returns the time of the monotonic clock in nanoseconds.
pub fn now() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// Timing of the calls of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// Calls follow each other without sleeping: caches stay warm.
    Hot,
    /// One call in every period, asleep in between: caches, clock frequency and branch predictors
    /// are in the state of a robot's.
    Every(Duration),
}

/// Timer that wakes up at the deadlines of a pace.
#[derive(Debug)]
pub struct Ticker {
    period: Option<u64>,
    due: u64,
}

impl Ticker {
    /// Starts a timer, whose first deadline is one period from now.
    pub fn start(pace: Pace) -> Self {
        let period = match pace {
            Pace::Hot => None,
            Pace::Every(period) => Some(period.as_nanos() as u64),
        };
        Self { period, due: now() }
    }

    /// Sleeps until the next deadline and returns by how many nanoseconds it was missed. Deadlines
    /// that have already passed are skipped, as in a control loop, which cannot run twice at once.
    pub fn wait(&mut self) -> u64 {
        let Some(period) = self.period else {
            return 0;
        };
        self.due += period;
        let passed = now().saturating_sub(self.due) / period;
        self.due += passed * period;
        sleep_until(self.due);
        now().saturating_sub(self.due)
    }
}

#[cfg(target_os = "linux")]
fn sleep_until(due: u64) {
    let deadline = Timespec {
        tv_sec: (due / 1_000_000_000) as i64,
        tv_nsec: (due % 1_000_000_000) as _,
    };
    // An interrupted sleep continues until the same deadline.
    while rustix::thread::clock_nanosleep_absolute(ClockId::Monotonic, &deadline)
        == Err(rustix::io::Errno::INTR)
    {}
}

#[cfg(not(target_os = "linux"))]
fn sleep_until(due: u64) {
    std::thread::sleep(Duration::from_nanos(due.saturating_sub(now())));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deadlines_are_absolute() {
        let period = Duration::from_millis(2);
        let start = now();
        let mut ticker = Ticker::start(Pace::Every(period));
        for tick in 1..=5 {
            let late = ticker.wait();
            let since = now() - start;
            assert!(
                since >= tick * 2_000_000,
                "tick {tick} came after {since} ns"
            );
            assert!(late < since, "{late} of {since} ns");
        }
        // Work that takes three periods costs three deadlines, not the rhythm.
        std::thread::sleep(3 * period);
        ticker.wait();
        assert_eq!((ticker.due - start) / 1_000_000 % 2, 0);
        assert_eq!(Ticker::start(Pace::Hot).wait(), 0);
    }
}
