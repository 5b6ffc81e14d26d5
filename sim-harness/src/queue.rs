//! Hands out numbered work to threads; where one of them fails or panics, the others end after what they have in hand.
//!
//! Nothing can fail here.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;

/// Work from a first number to an end, which threads take from the front.
#[derive(Debug)]
pub struct Queue {
    next: AtomicUsize,
    end: usize,
    halted: AtomicBool,
}

impl Queue {
    /// A queue of the numbers of a range.
    pub fn new(numbers: Range<usize>) -> Self {
        Self {
            next: AtomicUsize::new(numbers.start),
            end: numbers.end,
            halted: AtomicBool::new(false),
        }
    }

    /// Takes up to `count` numbers from the front; `None` when nothing is left or the queue was halted.
    pub fn take(&self, count: usize) -> Option<Range<usize>> {
        if self.halted.load(Ordering::Relaxed) {
            return None;
        }
        let first = self.next.fetch_add(count, Ordering::Relaxed);
        (first < self.end).then(|| first..self.end.min(first + count))
    }

    /// Hands out nothing more.
    pub fn halt(&self) {
        self.halted.store(true, Ordering::Relaxed);
    }

    /// Halts the queue if the thread panics before the result is dropped.
    pub fn halts_on_panic(&self) -> impl Drop {
        HaltsOnPanic(self)
    }
}

struct HaltsOnPanic<'q>(&'q Queue);

impl Drop for HaltsOnPanic<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.halt();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_is_taken_once() {
        let queue = Queue::new(3..10);
        let taken: Vec<_> = std::iter::from_fn(|| queue.take(3)).collect();
        assert_eq!(taken, [3..6, 6..9, 9..10]);
        assert_eq!(Queue::new(0..0).take(1), None);
    }

    #[test]
    fn a_panic_halts_the_other_threads() {
        let queue = Queue::new(0..usize::MAX / 2);
        let panicked = thread::scope(|scope| {
            let works = || {
                let _halts = queue.halts_on_panic();
                while queue.take(1).is_some() {
                    thread::yield_now();
                }
            };
            let others = [scope.spawn(works), scope.spawn(works)];
            let fails = scope.spawn(|| {
                let _halts = queue.halts_on_panic();
                std::panic::resume_unwind(Box::new("no message of a panic"));
            });
            // Without the halt this would never end.
            others.map(|other| other.join().is_ok()) == [true; 2] && fails.join().is_err()
        });
        assert!(panicked);
    }
}
