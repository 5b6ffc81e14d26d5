//! Tests of `lads import`: its output, its refusals, and that a refusal leaves nothing behind.

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use common::{answer, lads, refused};

fn biped(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/examples/biped");
    folder.join(name).to_string_lossy().into_owned()
}

fn scratch() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out.onnx");
    (folder, output)
}

#[test]
fn an_imported_policy_goes_through_every_door() {
    let (folder, output) = scratch();
    let (policy, robot) = (biped("walk.onnx"), biped("robot.toml"));
    let out = output.to_str().unwrap();
    let said = answer(&["import", &policy, "--contract", &robot, "-o", out], "");
    assert!(
        said.contains("equal a double-precision evaluation"),
        "{said}"
    );
    assert!(answer(&["self-test", out], "").contains("passed"));
    let report = answer(&["inspect", out], "");
    assert!(report.contains("plain policy for biped 1") && report.contains("joint_pos.left_knee"));
    let rows = answer(&["inspect", out, "--observations"], "");
    let actions = answer(&["act", "--model", out], &rows);
    assert_eq!(actions.lines().count(), rows.lines().count());
    let image = folder.path().join("walk.lads");
    let image = image.to_str().unwrap();
    answer(&["compile", out, "-o", image], "");
    assert_eq!(answer(&["act", "--model", image], &rows), actions);
    let source = folder.path().join("walk.c");
    answer(&["compile", out, "--emit-c", source.to_str().unwrap()], "");
    answer(&["bench", "--model", out, "--seconds", "0.2"], "");
}

#[test]
fn what_is_missing_is_listed_with_a_line_each_and_nothing_is_written() {
    let (_folder, output) = scratch();
    let policy = biped("walk.onnx");
    let made = lads(&["import", &policy, "-o", output.to_str().unwrap()], "");
    let told = String::from_utf8_lossy(&made.stderr).into_owned();
    assert_eq!(made.status.code(), Some(2), "{told}");
    assert!(made.stdout.is_empty() && !output.exists());
    assert!(
        told.starts_with("error: ") && told.contains("--template"),
        "{told}"
    );
    for field in ["control_period_s", "joints", "action.scale", "input `obs`"] {
        let lines = told
            .lines()
            .filter(|line| line.trim_start().starts_with(field));
        assert_eq!(lines.count(), 1, "{field}: {told}");
    }
    let form = answer(&["import", &policy, "--template"], "");
    assert!(
        form.contains("`obs` [1, 51]") && form.contains("# control_period_s"),
        "{form}"
    );
}

#[test]
fn wrong_arguments_and_files_are_refused_in_one_line() {
    let (folder, output) = scratch();
    let (policy, robot) = (biped("walk.onnx"), biped("robot.toml"));
    let out = output.to_str().unwrap();
    refused(&["import"], "", &["MODELS"]);
    refused(&["import", "none.onnx"], "", &["none.onnx"]);
    refused(&["import", &robot, "-o", out], "", &["robot.toml"]);
    refused(
        &["import", &policy, "--state", "h", "-o", out],
        "",
        &["`=`"],
    );
    let copy = folder.path().join("walk.onnx");
    fs::copy(&policy, &copy).unwrap();
    let copy = copy.to_str().unwrap();
    refused(
        &["import", copy, "--contract", &robot, "-o", copy],
        "",
        &["-o", copy],
    );
    assert!(!output.exists());
}
