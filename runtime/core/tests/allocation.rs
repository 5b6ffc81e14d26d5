//! Tests that nothing is allocated once a controller exists: a counting global allocator over 1,000
//! steps, two instructions, a reset, an encoding and a self-test.

mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use lads_core::{ChannelId, Data, Instruction};
use support::assemble::{ACTIONS, OBSERVATIONS, parts};
use support::{Memory, Model, Random, Spec, given, observe, shapes};

/// The system's allocator, counting each thread's calls: the test harness has threads of its own.
struct Counting;

thread_local! {
    static CALLS: Cell<usize> = const { Cell::new(0) };
}

fn calls() -> usize {
    CALLS.get()
}

// SAFETY: every call is passed on unchanged to the system's allocator, which keeps the contract.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        CALLS.set(calls() + 1);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        CALLS.set(calls() + 1);
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn a_thousand_steps_allocate_nothing() {
    let model = Model::random(Spec::TINY, 11);
    let image = parts(&model).with_golden(20).image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let observations: Vec<_> = Random(2).vec(3 * 1000, 1.0);
    let words = Random(3).vec(2 * 4, 1.0);
    let mut action = [0.0; 2];

    let before = calls();
    let mut controller = memory.controller(&policy);
    let tested = controller.self_test().is_ok();
    let mut sound = controller.set_instruction(Instruction::Id(0)).is_ok();
    for (step, observation) in observations.chunks(3).enumerate() {
        match step {
            300 => {
                sound &= controller
                    .set_instruction(Instruction::Words(&words))
                    .is_ok();
            }
            600 => controller.reset(),
            _ => {}
        }
        sound &= controller.step(observation, &mut action).is_ok();
        sound &= controller.executed(&action).is_ok();
        sound &= controller.step(&[f32::NAN; 3], &mut action).is_err();
    }
    let demonstration = [
        (ChannelId(OBSERVATIONS), Data::F32(&observations[..9])),
        (ChannelId(ACTIONS), Data::F32(&observations[..6])),
    ];
    sound &= controller.encode(&demonstration).is_ok();
    sound &= controller
        .follow(
            &[(ChannelId(0), Data::F32(&observations[..3]))],
            1,
            &mut action,
        )
        .is_ok();
    controller.warm();
    let made = calls() - before;

    assert!(sound && tested);
    assert_eq!(made, 0, "the allocator was called");
    // The counter counts.
    drop(std::hint::black_box(vec![0_u8; 100]));
    assert!(calls() - before >= 2);
}

#[test]
fn no_shape_of_schedule_allocates() {
    for (name, parts) in shapes::all() {
        let image = parts.with_golden(8).image();
        let before = calls();
        let policy = image.policy();
        assert_eq!(calls() - before, 0, "{name}: opening called the allocator");
        let mut memory = Memory::for_policy(&policy);
        let mut random = Random(4);
        let inputs = observe(&policy, &mut random);
        let given = given(&inputs);
        let mut action = [0.0; 2];
        let before = calls();
        let mut controller = memory.controller(&policy);
        let mut sound = controller.self_test().is_ok();
        let _ = controller.set_instruction(Instruction::Id(0));
        for _ in 0..100 {
            sound &= controller.step_with(&given, &mut action).is_ok();
            controller.warm();
        }
        let made = calls() - before;
        assert!(sound, "{name}");
        assert_eq!(made, 0, "{name}: the allocator was called");
    }
}
