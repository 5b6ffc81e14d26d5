//! Runs a program and interrupts it while it works.

use std::io::Read as _;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Starts the program, sends SIGINT once when `ready` returns true, and returns its exit code and its stderr; `None` if it ended before.
pub fn when(command: &mut Command, ready: &dyn Fn() -> bool) -> Option<(Option<i32>, String)> {
    let mut child = command
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let start = Instant::now();
    while !ready() {
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
