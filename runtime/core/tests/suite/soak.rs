//! Runs a million guarded steps with random instructions, resets and faults: every output is
//! finite, and no memory is taken.
//!
//! `cargo test --release -p lads-core --test suite -- --ignored`

use crate::support::assemble::parts;
use crate::support::{Memory, Model, Random, Spec};
use lads_core::{Fallback, GuardConfig, GuardedController, Instruction, Tick};

const STEPS: u64 = 1_000_000;

/// Returns the number of pages that the process holds, if the system tells.
fn resident() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/statm").ok()?;
    text.split(' ').nth(1)?.parse().ok()
}

#[test]
#[ignore = "takes a minute even when optimised"]
fn a_million_steps() {
    let image = parts(&Model::random(Spec::TINY, 11))
        .with_golden(12)
        .image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut guard = vec![0.0; GuardedController::memory_len(&policy)];
    let config = GuardConfig {
        fallback: Fallback::Hold,
        ..GuardConfig::default()
    };
    let mut guarded = GuardedController::new(memory.controller(&policy), &config, &mut guard)
        .expect("the configuration is sound");
    guarded.self_test().expect("the policy is sound");
    let mut random = Random(5);
    let (mut observation, mut action) = ([0.0; 3], [0.0; 2]);
    let mut before = None;
    for timestamp in 0..STEPS {
        let chance = random.next().abs();
        if chance < 0.002 {
            let number = u32::from(chance < 0.001);
            guarded
                .set_instruction(Instruction::Id(number))
                .expect("both are known");
        } else if chance < 0.004 {
            guarded.reset();
        }
        observation.fill_with(|| random.next() * 3.0);
        if chance > 0.99 {
            observation[0] = f32::NAN;
        }
        let tick = Tick {
            timestamp,
            missed: 0,
        };
        guarded
            .step(&observation, Some(tick), &mut action)
            .expect("the action has two elements");
        assert!(action.iter().all(|x| x.is_finite()), "{action:?}");
        if timestamp == STEPS / 100 {
            before = resident();
        }
    }
    let counters = guarded.counters();
    println!(
        "{counters:?}, resident pages {before:?} to {:?}",
        resident()
    );
    assert_eq!(counters.periods, STEPS);
    assert!(counters.policy > STEPS / 2 && counters.not_finite > 1000);
    // A few pages are the test harness's own.
    assert!(resident() <= before.map(|pages| pages + 64));
}
