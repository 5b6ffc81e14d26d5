//! Tests that the memory of the shipped policy, as `lads inspect` reports it, stays within its
//! budget file.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// Tolerated growth in per cent: more needs a decision, and a new number in the file.
const GROWTH: u64 = 3;

#[test]
fn shipped_policies_stay_within_their_budgets() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
    let mut held = 0;
    for entry in fs::read_dir(&models).expect("the project has models") {
        let budget = entry.expect("it can be read").path();
        let name = budget.to_string_lossy();
        let Some(stem) = name.strip_suffix(".memory.json") else {
            continue;
        };
        let path = PathBuf::from(format!("{stem}.onnx"));
        let text = fs::read_to_string(&budget).expect("it can be read");
        let budget: Value = serde_json::from_str(&text).expect("it is JSON");
        let sizes = sizes(&path);
        for (name, most) in budget.as_object().expect("it is an object") {
            let got = sizes[name].as_u64().expect("inspect tells it");
            let most = most.as_u64().expect("it is a number of bytes");
            assert!(
                got * 100 <= most * (100 + GROWTH),
                "{}: {name} is {got}, the budget is {most}",
                path.display()
            );
            held += 1;
        }
    }
    assert!(held >= 6, "{held} budgets were held");
}

#[test]
fn the_small_kitchen_policy_fits_a_microcontroller() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
    let sizes = sizes(&models.join("kitchen-small.onnx"));
    for (name, limit) in [
        ("image_bytes", 512 * 1024),
        ("workspace_bytes", 64 * 1024),
        // Of the widest vectors of x86-64; a Cortex-M takes 5,636 (docs/firmware.md).
        ("stack_bytes", 10 * 1024),
    ] {
        let got = sizes[name].as_u64().expect("inspect tells it");
        assert!(got < limit, "{name} is {got}, the limit is {limit}");
    }
}

/// Returns a policy's sizes in bytes, as `lads inspect` reports them.
fn sizes(path: &Path) -> Value {
    let output = Command::new(env!("CARGO_BIN_EXE_lads"))
        .arg("inspect")
        .arg(path)
        .arg("--json")
        .output()
        .expect("it runs");
    let mut report: Value = serde_json::from_slice(&output.stdout).expect("it is JSON");
    report["sizes"].take()
}
