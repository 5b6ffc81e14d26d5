//! The work of a control step does not depend on what is observed: under `callgrind`, the same number of instructions for a hundred
//! random observations at the same context, of an ordinary step and of one that decides or draws its plan, with 32-bit weights and
//! with integers. Skipped where `valgrind` is missing.
//!
//! The test runs its own binary once more under `callgrind`, which counts what [`one_control_step`] executes and writes one file
//! for each call. Valgrind knows no AVX-512, so what is counted are the AVX2 kernels, or on older processors the portable ones.
#![cfg(target_os = "linux")]

use std::collections::BTreeSet;
use std::hint::black_box;
use std::process::Command;

use lads_compiler::{Bundle, Memory, Options, WeightFormat, compile_with};
use lads_core::{Controller, Decision, Instruction, Policy, StepReport};
use lads_tests::project_path;

/// Names the case to the program under `callgrind`.
const CHILD: &str = "LADS_STEPS_UNDER_CALLGRIND";

/// How plans are drawn, where they are.
const DRAWN: Decision = Decision::Sample {
    temperature: 1.0,
    seed: 5,
};

/// Steps before the one that is counted, of an episode that decides in every tenth.
const CASES: [(WeightFormat, Decision, usize); 5] = [
    (WeightFormat::F32, Decision::Argmax, 1),
    (WeightFormat::F32, Decision::Argmax, 10),
    (WeightFormat::F32, DRAWN, 10),
    (WeightFormat::Int16, Decision::Argmax, 1),
    (WeightFormat::Int16, Decision::Argmax, 10),
];

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

/// A step of an episode, with observations from all over the contract's limits.
fn steps((weights, decision, before): (WeightFormat, Decision, usize)) {
    let bundle = Bundle::open(&project_path("models/kitchen.onnx")).unwrap();
    let options = Options {
        weights,
        tolerance: Some(0.1),
        ..Options::default()
    };
    let image = compile_with(&bundle, options).unwrap();
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    let mut memory = Memory::of(&policy).expect("there is memory");
    let mut controller = memory.controller(&policy).unwrap();
    controller.set_decision(decision);
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
        for _ in 0..before {
            controller.step(first, &mut action).unwrap();
        }
        // Limits may be as wide as all numbers; a machine's are not.
        let observation: Vec<f32> = (policy.contract().observations())
            .map(|element| {
                let (min, max) = (element.limits.min.max(-10.0), element.limits.max.min(10.0));
                min + (max - min) * random()
            })
            .collect();
        let report = one_control_step(&mut controller, &observation, &mut action);
        assert_eq!(report.decided, before % 10 == 0);
    }
}

#[test]
fn a_step_executes_the_same_number_of_instructions_whatever_it_observes() {
    if let Some(case) = std::env::var_os(CHILD) {
        let case: usize = case.to_str().and_then(|case| case.parse().ok()).unwrap();
        return steps(CASES[case]);
    }
    for (number, case) in CASES.iter().enumerate() {
        let Some(different) = counts(number) else {
            println!("skipped: valgrind is not installed");
            return;
        };
        println!("instructions of a step, {case:?}: {different:?}");
        assert_eq!(different.len(), 1, "{case:?}: {different:?}");
    }
}

/// The numbers of instructions that steps of a case took; `None` without `valgrind`.
fn counts(case: usize) -> Option<BTreeSet<u64>> {
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
        .env(CHILD, case.to_string())
        .output();
    let output = counted.ok()?;
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
    Some(counts.into_iter().collect())
}
