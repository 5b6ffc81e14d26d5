//! Tests that a control step makes no system call: `strace` sees none between two marks. Skipped where `strace` is missing or may not
//! trace.
//!
//! The test runs its own binary once more under `strace`; there the one test of this file takes its steps between two marks, which
//! are system calls that nobody else makes: looking for files of a certain name. Waiting for a lock would be a system call too.
#![cfg(target_os = "linux")]

use std::path::Path;
use std::process::Command;

use lads_core::{Instruction, Policy};
use lads_host::Memory;
use lads_tests::{compiled, project_path};

const CHILD: &str = "LADS_STEPS_UNDER_STRACE";
const BEGIN: &str = "/lads-steps-begin";
const END: &str = "/lads-steps-end";

fn mark(name: &str) {
    assert!(!Path::new(name).exists());
}

/// Runs steps of every kind, and a new instruction, between two marks.
fn steps() {
    let image = compiled(&project_path("models/kitchen.onnx"));
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    let mut memory = Memory::of(&policy).expect("there is memory");
    let mut controller = memory.controller(&policy).unwrap();
    let mut action = vec![0.0; policy.contract().action_len()];
    let golden = policy.golden().unwrap();
    mark(BEGIN);
    controller.set_instruction(Instruction::Id(0)).unwrap();
    controller.warm();
    for step in golden.steps() {
        controller.step(step.observation(), &mut action).unwrap();
    }
    mark(END);
}

#[test]
fn a_step_makes_no_system_call() {
    if std::env::var_os(CHILD).is_some() {
        return steps();
    }
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    let traced = Command::new("strace")
        .arg("-f")
        .arg("-o")
        .arg(&log)
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", "a_step_makes_no_system_call"])
        .env(CHILD, "1")
        .output();
    let Ok(output) = traced else {
        println!("skipped: strace is not installed");
        return;
    };
    let log = std::fs::read_to_string(&log).unwrap_or_default();
    if !log.contains(BEGIN) && String::from_utf8_lossy(&output.stderr).contains("strace:") {
        println!("skipped: strace may not trace here");
        return;
    }
    assert!(output.status.success(), "{output:?}");
    // Every line begins with the thread.
    let begin = log.lines().find(|line| line.contains(BEGIN)).unwrap();
    let thread = begin.split_whitespace().next().unwrap();
    let mut own = log
        .lines()
        .filter(|line| line.split_whitespace().next() == Some(thread))
        .skip_while(|line| !line.contains(BEGIN))
        .skip(1);
    let next = own.next().unwrap();
    assert!(next.contains(END), "between the marks: {next}");
}
