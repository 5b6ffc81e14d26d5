//! The memory contract: what the shipped policy takes, as `lads inspect` tells it, stays within its budget file.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// Tolerated growth, in per cent: more needs a decision, and a new number in the file.
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
        let output = Command::new(env!("CARGO_BIN_EXE_lads"))
            .arg("inspect")
            .arg(&path)
            .arg("--json")
            .output()
            .expect("it runs");
        let report: Value = serde_json::from_slice(&output.stdout).expect("it is JSON");
        for (name, most) in budget.as_object().expect("it is an object") {
            let got = report["sizes"][name].as_u64().expect("inspect tells it");
            let most = most.as_u64().expect("it is a number of bytes");
            assert!(
                got * 100 <= most * (100 + GROWTH),
                "{}: {name} is {got}, the budget is {most}",
                path.display()
            );
            held += 1;
        }
    }
    assert!(held >= 3, "no budget was held");
}
