//! The work of a control step does not depend on what is observed: under `callgrind`, the same number of instructions for a hundred
//! random observations at the same context. Skipped where `valgrind` is missing.
//!
//! The test runs its own binary once more under `callgrind`, which counts what [`one_control_step`] executes and writes one file
//! for each call. Valgrind knows no AVX-512, so what is counted are the AVX2 kernels, or on older processors the portable ones.
#![cfg(target_os = "linux")]

use std::collections::BTreeSet;
use std::hint::black_box;
use std::process::Command;

use lads_compiler::Memory;
use lads_core::{Controller, Instruction, Policy, StepReport};
use lads_tests::{compiled, project_path};

const CHILD: &str = "LADS_STEPS_UNDER_CALLGRIND";

/// Observations of which the steps are counted.
const OBSERVATIONS: usize = 100;

/// What is counted; a name that the tool can be told.
#[inline(never)]
#[unsafe(no_mangle)]
#[expect(
    clippy::no_mangle_with_rust_abi,
    reason = "no other program calls it; the tool looks for the name"
)]
fn one_control_step(
    controller: &mut Controller<'_, '_>,
    observation: &[f32],
    action: &mut [f32],
) -> StepReport {
    controller.step(black_box(observation), action).unwrap()
}

/// The second step of an episode, which does not decide, with observations from all over the contract's limits.
fn steps() {
    let image = compiled(&project_path("models/kitchen.onnx"));
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    let mut memory = Memory::of(&policy).expect("there is memory");
    let mut controller = memory.controller(&policy).unwrap();
    let mut action = vec![0.0; policy.contract().action_len()];
    let (first, _, _) = policy.golden().unwrap().steps().next().unwrap();
    controller.set_instruction(Instruction::Id(0)).unwrap();
    let mut state = 1_u64;
    let mut random = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1_u64 << 24) as f32
    };
    for _ in 0..OBSERVATIONS {
        controller.reset();
        controller.step(first, &mut action).unwrap();
        // Limits may be as wide as all numbers; a machine's are not.
        let observation: Vec<f32> = (policy.contract().observations())
            .map(|element| {
                let (min, max) = (element.limits.min.max(-10.0), element.limits.max.min(10.0));
                min + (max - min) * random()
            })
            .collect();
        let report = one_control_step(&mut controller, &observation, &mut action);
        assert!(!report.decided);
    }
}

#[test]
fn a_step_executes_the_same_number_of_instructions_whatever_it_observes() {
    if std::env::var_os(CHILD).is_some() {
        return steps();
    }
    let folder = tempfile::tempdir().unwrap();
    let counted = Command::new("valgrind")
        .args(["--tool=callgrind", "--toggle-collect=one_control_step"])
        .arg("--dump-after=one_control_step")
        .arg(format!(
            "--callgrind-out-file={}/counts",
            folder.path().display()
        ))
        .arg(std::env::current_exe().unwrap())
        .args([
            "--exact",
            "a_step_executes_the_same_number_of_instructions_whatever_it_observes",
        ])
        .env(CHILD, "1")
        .output();
    let Ok(output) = counted else {
        println!("skipped: valgrind is not installed");
        return;
    };
    assert!(output.status.success(), "{output:?}");
    // One file per call, and a last one when the program ends, in which nothing was counted.
    let counts: Vec<u64> = std::fs::read_dir(folder.path())
        .unwrap()
        .filter_map(|entry| {
            let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
            let line = text
                .lines()
                .find_map(|line| line.strip_prefix("totals: "))?;
            line.trim().parse().ok()
        })
        .filter(|&count| count > 0)
        .collect();
    assert_eq!(counts.len(), OBSERVATIONS);
    let different: BTreeSet<u64> = counts.into_iter().collect();
    println!("instructions of a step: {different:?}");
    assert_eq!(different.len(), 1, "{different:?}");
}
