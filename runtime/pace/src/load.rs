//! Makes load beside the control thread, as perception and logging would: threads that sweep memory
//! through the caches and compute in between.

use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

/// Number of elements that one thread sweeps: 64 MiB, more than the last-level cache of most
/// machines.
const SWEPT: usize = 64 * 1024 * 1024 / size_of::<u64>();

/// Threads that make load until this value is dropped.
#[derive(Debug)]
pub struct Load {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<u64>>,
}

impl Load {
    /// Starts `count` threads. Start them before the control thread becomes a real-time one,
    /// because threads inherit its scheduling.
    pub fn start(count: usize) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let threads = (0..count).map(|_| {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || work(&stop))
        });
        let threads = threads.collect();
        Self { stop, threads }
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A load thread cannot panic; nothing is lost if it did.
            let _ = thread.join();
        }
    }
}

/// Reads and writes one cache line after the other, and computes for a while after every 1024
/// lines.
fn work(stop: &AtomicBool) -> u64 {
    let mut swept = vec![1_u64; SWEPT];
    let mut sum = 0_u64;
    while !stop.load(Ordering::Relaxed) {
        for lines in swept.chunks_mut(8 * 1024) {
            for line in lines.chunks_mut(8) {
                if let [first, ..] = line {
                    *first = first.wrapping_add(sum | 1);
                    sum ^= *first;
                }
            }
            for round in 0..1024_u64 {
                sum = black_box(sum).rotate_left(5) ^ round;
            }
            if stop.load(Ordering::Relaxed) {
                break;
            }
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn load_ends_with_its_owner() {
        let load = Load::start(1);
        let stop = Arc::clone(&load.stop);
        drop(load);
        assert!(stop.load(Ordering::Relaxed));
        assert_eq!(Arc::strong_count(&stop), 1, "its thread has ended");
    }
}
