//! Runs a program and interrupts it while it works.

use std::fs;
use std::io::Read as _;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Starts the program, sends SIGINT once when `ready`, which gets the process's id, returns true, and returns its exit code and its stderr;
/// `None` if it ended before.
pub fn when(command: &mut Command, ready: &dyn Fn(u32) -> bool) -> Option<(Option<i32>, String)> {
    let mut child = command
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let start = Instant::now();
    while !ready(child.id()) {
        if let Some(status) = child.try_wait().unwrap() {
            let mut errors = String::new();
            child
                .stderr
                .take()
                .unwrap()
                .read_to_string(&mut errors)
                .unwrap();
            return (!status.success()).then_some((status.code(), errors));
        }
        assert!(
            start.elapsed() < Duration::from_mins(2),
            "it never became ready"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    let interrupt = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status()
        .unwrap();
    assert!(interrupt.success());
    let output = child.wait_with_output().unwrap();
    Some((
        output.status.code(),
        String::from_utf8(output.stderr).unwrap(),
    ))
}

/// Whether the process has a handler for SIGINT, by the mask of caught signals that Linux shows.
#[allow(
    dead_code,
    reason = "not every test that includes this file waits for it"
)]
pub fn is_handled(process: u32) -> bool {
    const SIGINT: u64 = 1 << 1;
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask & SIGINT != 0)
}

/// Whether `lads-run` runs episodes in closed loop: it has threads beside its first and the one that waits for an interrupt.
#[allow(
    dead_code,
    reason = "not every test that includes this file waits for it"
)]
pub fn runs_episodes(process: u32) -> bool {
    fs::read_dir(format!("/proc/{process}/task")).is_ok_and(|threads| threads.count() > 2)
}
