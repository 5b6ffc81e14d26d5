//! Tests that a controller allocates nothing after construction: counted by the global allocator over 1,000 control steps of every bundle.
//!
//! Only this thread's allocations count, so the test harness cannot disturb it.

use std::hint::black_box;

use lads_core::{Controller, Decision, Instruction, Policy};
use lads_host::Memory;
use lads_tests::{bundles, compiled};

#[path = "common/counting.rs"]
mod counting;

use counting::calls_during;

/// Runs 1,000 steps on the recorded observations, over and over: two instructions, one reset, both decision rules.
fn work(controller: &mut Controller<'_, '_>, action: &mut [f32]) {
    let golden = controller.policy().golden().unwrap();
    let mut steps = |controller: &mut Controller<'_, '_>, count| {
        for step in std::iter::repeat_with(|| golden.steps())
            .flatten()
            .take(count)
        {
            controller.step_with(step.observations(), action).unwrap();
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
