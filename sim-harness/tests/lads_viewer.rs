//! Tests `lads-run view`: that a window changes nothing, and what is refused.
//!
//! The tests that open a window need the X server that needs no screen (Xvfb), and EGL; without them they are skipped with a printed line.
#![cfg(feature = "viewer")]

#[path = "common/interrupt.rs"]
mod interrupt;
#[path = "common/lads_run.rs"]
mod program;

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Makes a `lads-run` command without the display of whoever runs the tests.
fn lads_run(model: &str, arguments: &[&str]) -> Command {
    let mut command = program::lads_run(model, arguments);
    command.env_remove("DISPLAY");
    command
}

/// An X server in memory, until it is dropped.
struct Display {
    server: Child,
    name: String,
}

impl Display {
    /// Starts an X server; `None`, after a line, where Xvfb is not installed.
    fn open() -> Option<Self> {
        let server = Command::new("Xvfb")
            .args(["-displayfd", "1", "-screen", "0", "1024x768x24"])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn();
        let Ok(mut server) = server else {
            println!("skipped: no display, because Xvfb is not installed");
            return None;
        };
        // It says its number when it is ready.
        let mut number = String::new();
        let mut says = BufReader::new(server.stdout.take().unwrap());
        says.read_line(&mut number).unwrap();
        let name = format!(":{}", number.trim());
        Some(Self { server, name })
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// Whether this machine lacks what pictures need; prints that it does.
fn lacks_egl(errors: &str) -> bool {
    let lacks = errors.contains("by EGL");
    if lacks {
        println!("skipped: {errors}");
    }
    lacks
}

/// Reads the JSON results without measured times.
fn runs(json: &Path) -> Value {
    let results: Value = serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
    results["instructions"].clone()
}

/// Asserts exit code 2 and one line on stderr with all `parts`.
fn assert_refused(output: &Output, parts: &[&str]) {
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    for part in parts {
        assert!(errors.contains(part), "{part}: {errors}");
    }
}

#[test]
fn an_episode_is_the_same_in_a_window() {
    let Some(display) = Display::open() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let [plain, seen] = ["plain.json", "seen.json"].map(|name| folder.path().join(name));
    for (model, instruction) in [("lorel.onnx", "open drawer"), ("kitchen.onnx", "kbls")] {
        let arguments = ["--instruction", instruction, "--episodes", "1", "--json"];
        let output = lads_run(model, &[&["view"], &arguments[..]].concat())
            .arg(&seen)
            .env("DISPLAY", &display.name)
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        if lacks_egl(&errors) {
            return;
        }
        assert!(output.status.success(), "{errors}");
        let output = lads_run(model, &arguments).arg(&plain).output().unwrap();
        assert!(output.status.success());
        let [plain, seen] = [&plain, &seen].map(|json| runs(json));
        assert_eq!(plain, seen, "{model}");
        assert!(plain[0]["runs"][0]["steps"].as_u64() > Some(0));
    }
}

#[test]
fn an_interrupt_closes_the_window() {
    let Some(display) = Display::open() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let mut command = lads_run("kitchen.onnx", &["view", "--episodes", "9", "--json"]);
    command.arg(folder.path().join("r.json"));
    command.env("DISPLAY", &display.name);
    // In the first of many episodes at real time, however slow the machine is.
    let start = Instant::now();
    let shown = |_| start.elapsed() > Duration::from_secs(4);
    let (code, errors) = interrupt::when(&mut command, &shown).unwrap();
    if lacks_egl(&errors) {
        return;
    }
    assert_eq!(code, Some(130), "{errors}");
    assert!(errors.contains("nothing was written"), "{errors}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn without_a_display_one_line_names_the_remedy() {
    let run = |display: &str| {
        let mut command = lads_run("kitchen.onnx", &["view"]);
        command.env("DISPLAY", display).output().unwrap()
    };
    let none = ["view: no display", "set DISPLAY", "record"];
    let output = lads_run("kitchen.onnx", &["view"]).output().unwrap();
    assert_refused(&output, &none);
    assert_refused(&run(""), &none);
    // Where no machine listens.
    let parts = ["no window can be opened on display /none:0", "set DISPLAY"];
    assert_refused(&run("/none:0"), &parts);
}

#[test]
fn what_contradicts_a_window_is_refused_by_name() {
    for other in [&["--uniform"][..], &["--report", "a.html"]] {
        let output = lads_run("kitchen.onnx", &[&["view"], other].concat()).output();
        assert_refused(&output.unwrap(), &[other[0]]);
    }
    let output = lads_run("kitchen.onnx", &["view", "--threads", "2"]).output();
    assert_refused(&output.unwrap(), &["view --threads 2", "leave"]);
}
