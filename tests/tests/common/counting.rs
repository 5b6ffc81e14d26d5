//! A global allocator that counts the calls of one thread, for binaries that prove that something allocates nothing.
//!
//! Included by its path; only the thread that asks is counted, so the test harness cannot disturb it.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    /// Number of allocations, reallocations and deallocations of this thread while counting; `None` while not.
    static CALLS: Cell<Option<usize>> = const { Cell::new(None) };
}

fn count() {
    // A thread that is ending has no counter any more, and nobody who asks.
    let _ = CALLS.try_with(|calls| calls.set(calls.get().map(|so_far| so_far + 1)));
}

struct Counting;

// SAFETY: every call goes to the system's allocator as it came; counting reads and writes a thread-local cell that needs no
// initialisation and has no destructor, so it does not allocate.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        // SAFETY: the caller keeps the contract of `dealloc`; all memory comes from `System`.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract of `alloc_zeroed`.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract of `realloc`; all memory comes from `System`.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Counts the calls of the allocator while `work` runs on this thread.
pub fn calls_during(work: impl FnOnce()) -> usize {
    CALLS.set(Some(0));
    work();
    CALLS.take().unwrap()
}
