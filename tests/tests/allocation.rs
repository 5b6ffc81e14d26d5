//! After construction a controller allocates nothing: counted by the global allocator over 1,000 control steps of every bundle.
//!
//! The only test of its binary, and only this thread's allocations count, so the test harness cannot disturb it.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::hint::black_box;

use lads_compiler::Memory;
use lads_core::{Controller, Decision, Instruction, Policy};
use lads_tests::{bundles, compiled};

thread_local! {
    /// Allocations, reallocations and deallocations of this thread while counting; `None` while not.
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

/// Calls of the allocator while `work` runs on this thread.
fn calls_during(work: impl FnOnce()) -> usize {
    CALLS.set(Some(0));
    work();
    CALLS.take().unwrap()
}

/// 1,000 steps on the recorded observations, over and over: two instructions, one reset, both decision rules.
fn work(controller: &mut Controller<'_, '_>, action: &mut [f32]) {
    let golden = controller.policy().golden().unwrap();
    let mut steps = |controller: &mut Controller<'_, '_>, count| {
        for (observation, _, _) in std::iter::repeat_with(|| golden.steps())
            .flatten()
            .take(count)
        {
            controller.step(observation, action).unwrap();
        }
    };
    controller.set_instruction(Instruction::Id(0)).unwrap();
    steps(controller, 400);
    controller.reset();
    steps(controller, 100);
    controller.set_decision(Decision::Sample {
        temperature: 1.0,
        seed: 1,
    });
    controller.set_instruction(Instruction::Id(1)).unwrap();
    steps(controller, 500);
}

#[test]
fn a_controller_allocates_nothing() {
    assert!(
        calls_during(|| drop(black_box(vec![1]))) >= 2,
        "the counter counts"
    );
    for path in bundles() {
        let image = compiled(&path);
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        let mut memory = Memory::of(&policy).expect("there is memory");
        let mut controller = memory.controller(&policy).unwrap();
        let mut action = vec![0.0; policy.contract().action_len()];
        let calls = calls_during(|| work(&mut controller, &mut action));
        assert_eq!(calls, 0, "{}", path.display());
        // Opening an image allocates nothing either.
        let calls =
            calls_during(|| assert!(black_box(Policy::new_checked(image.as_bytes())).is_ok()));
        assert_eq!(calls, 0, "{}", path.display());
    }
}
