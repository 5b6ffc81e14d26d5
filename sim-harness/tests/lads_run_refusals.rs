//! Tests that `lads-run` refuses what cannot run, in one line, before the first episode, and overwrites nothing.

#[path = "common/lads_run.rs"]
mod program;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use program::{assert_refused, kitchen_bundle, lads_run, project_file, refused};

/// Path of the small bundle of the compiler's tests, which is for another environment.
fn tiny_bundle() -> PathBuf {
    project_file("runtime/compiler/tests/data/tiny.onnx")
}

/// Copies a bundle, with one text of its metadata replaced by another of the same length.
fn altered(bundle: &Path, folder: &Path, from: &str, to: &str) -> PathBuf {
    assert_eq!(from.len(), to.len());
    let mut bytes = fs::read(bundle).unwrap();
    let place = bytes
        .windows(from.len())
        .position(|window| window == from.as_bytes())
        .unwrap();
    bytes[place..place + to.len()].copy_from_slice(to.as_bytes());
    let path = folder.join("altered.onnx");
    fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn bad_arguments_are_refused() {
    let model = kitchen_bundle();
    refused(
        &model,
        &["--episodes", "0"],
        &["--episodes 0", "at least 1"],
    );
    refused(&model, &["--threads", "0"], &["--threads 0", "at least 1"]);
    refused(
        &model,
        &["--episodes", "many"],
        &["many", "--episodes", "--help"],
    );
    refused(&model, &["--noise", "v7"], &["v7", "none, v0 or v1"]);
    let known = "move kettle to top left burner and activate bottom burner and turn on light switch and open sliding cabinet";
    let unknown = known.replace("bottom", "botom");
    refused(
        &model,
        &["--instruction", &unknown],
        &[&unknown, "the nearest", known],
    );
}

/// Tests that options of earlier releases, which are subcommands now, are refused in one line that names the subcommand.
#[test]
fn options_that_have_become_jobs_are_named() {
    for (arguments, now) in [
        (&["--verify"][..], "lads-run verify"),
        (&["--verify", "r.json"], "lads-run verify"),
        (&["--replay", "f.mcap"], "lads-run replay LOG"),
        (&["--encode", "f.mcap"], "lads-run encode LOG"),
        (&["--sweep"], "lads-run sweep"),
        (&["--viewer"], "lads-run view "),
        (&["--record", "a.gif"], "lads-run record OUT"),
        (&["--record-episode", "1"], "--episode NUMBER"),
    ] {
        refused(&kitchen_bundle(), arguments, &[arguments[0], now]);
    }
}

#[test]
fn sentences_that_nobody_can_hear_are_refused() {
    let model = kitchen_bundle();
    let said = |sentence: &str, rest: &[&str], parts: &[&str]| {
        let arguments = [&["--instruction", sentence], rest].concat();
        refused(&model, &arguments, parts);
    };
    for empty in ["", " \n\t"] {
        said(empty, &[], &["--instruction", "empty sentence"]);
    }
    let hint = if cfg!(feature = "language") {
        "lads_exporter"
    } else {
        "make say"
    };
    said("dance", &[], &["dance", "the nearest", hint]);
    refused(&model, &["--encode-language"], &["--encode-language", hint]);
    said("mkbs", &["--sub-tasks", "kettle"], &["--sub-tasks", "mkbs"]);
    refused(&model, &["--sub-tasks", "kettle"], &["--sub-tasks"]);
    said(
        "dance",
        &["--plans", "p.json"],
        &["--plans", "bundle's table"],
    );
    for job in ["verify", "sweep"] {
        let arguments = [job, "--instruction", "dance"];
        refused(&model, &arguments, &[job, "bundle's table"]);
    }
}

#[test]
fn bad_bundles_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    refused(&path("none.onnx"), &[], &["none.onnx", "name a bundle"]);
    fs::write(path("text.onnx"), "no model at all\n").unwrap();
    refused(&path("text.onnx"), &[], &["text.onnx", "ONNX"]);
    let bytes = fs::read(tiny_bundle()).unwrap();
    fs::write(path("half.onnx"), &bytes[..bytes.len() / 2]).unwrap();
    refused(&path("half.onnx"), &[], &["half.onnx", "truncated"]);
    let plain = altered(
        &tiny_bundle(),
        folder.path(),
        "lads.contract",
        "some.contract",
    );
    refused(
        &plain,
        &[],
        &["altered.onnx", "lads.contract", "lads import"],
    );
    let newer = altered(
        &tiny_bundle(),
        folder.path(),
        r#"{"version": 2, "family""#,
        r#"{"version": 7, "family""#,
    );
    refused(&newer, &[], &["altered.onnx", "version 7", "version 2"]);
}

#[test]
fn a_bundle_that_asks_for_gigabytes_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let greedy = altered(
        &kitchen_bundle(),
        folder.path(),
        r#""context": {"words": 24, "steps": 280, "beyond""#,
        r#""context":{"words":24,"steps": 1048570,"beyond""#,
    );
    refused(
        &greedy,
        &[],
        &[
            "altered.onnx",
            "workspace of",
            "at most 1073741824",
            "shorter context",
        ],
    );
}

#[test]
fn contracts_of_another_environment_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    refused(&tiny_bundle(), &[], &["tiny-bench", "franka-kitchen"]);
    let cases = [
        (
            r#""control_period_s": 0.08"#,
            r#""control_period_s": 0.07"#,
            "control_period_s",
        ),
        (
            r#"{"id": "franka-kitchen", "version": "1"}"#,
            r#"{"id": "franka-kitchen", "version": "3"}"#,
            "environment.version",
        ),
    ];
    for (from, to, field) in cases {
        let model = altered(&kitchen_bundle(), folder.path(), from, to);
        refused(&model, &[], &["altered.onnx", field]);
    }
}

#[test]
fn missing_assets_are_refused() {
    let mut command = lads_run(kitchen_bundle(), &[]);
    command.env("LADS_VENDOR", "/nonexistent");
    assert_refused(&command.output().unwrap(), &["/nonexistent", "make setup"]);
}

#[test]
fn places_that_cannot_be_written_are_refused_before_any_episode() {
    let folder = tempfile::tempdir().unwrap();
    let inside = folder.path().join("no/such/folder/r.json");
    for place in [inside.as_path(), folder.path()] {
        let place = place.to_str().unwrap();
        refused(
            &kitchen_bundle(),
            &["--json", place],
            &["--json", place, "writable folder"],
        );
    }
}

#[test]
fn a_failure_overwrites_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("r.json");
    fs::write(&json, "from before").unwrap();
    let place = json.to_str().unwrap();
    refused(&tiny_bundle(), &["--json", place], &["tiny-bench"]);
    refused(
        &kitchen_bundle(),
        &["--json", place, "--instruction", "dance"],
        &["dance"],
    );
    assert_eq!(fs::read_to_string(&json).unwrap(), "from before");
    assert_eq!(
        fs::read_dir(folder.path()).unwrap().count(),
        1,
        "no temporary file stays"
    );
}

#[test]
fn outputs_are_never_what_is_read_nor_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let said = |name: &str| path(name).to_str().unwrap().to_owned();
    let model = path("kitchen.onnx");
    fs::copy(kitchen_bundle(), &model).unwrap();
    std::os::unix::fs::symlink("kitchen.onnx", path("link.json")).unwrap();
    let before = fs::read(&model).unwrap();
    let reads = "--model reads";
    refused(
        &model,
        &["--json", &said("kitchen.onnx")],
        &["--json", reads],
    );
    refused(
        &model,
        &["--json", &said("link.json")],
        &["link.json", reads],
    );
    refused(&model, &["--log", &said("kitchen.onnx")], &["--log", reads]);
    let [one, two] = [said("one.json"), said("./one.json")];
    refused(
        &model,
        &["--json", &one, "--log", &two],
        &["--log", "--json writes the same file"],
    );
    let plans = said("plans.json");
    fs::write(&plans, "{}").unwrap();
    refused(
        &model,
        &["--plans", &plans, "--json", &plans],
        &["--json", "--plans reads"],
    );
    let reference = project_file("models/kitchen.reference.json");
    fs::copy(reference, path("kitchen.reference.json")).unwrap();
    refused(
        &model,
        &["verify", "--certificate", &said("kitchen.reference.json")],
        &["--certificate", "--reference reads"],
    );
    refused(
        &model,
        &["verify", "--certificate", &one, "--certificate", &two],
        &["--certificate writes the same file"],
    );
    assert_eq!(fs::read(&model).unwrap(), before);
    assert!(!Path::new(&one).exists());
}

#[test]
fn another_mujoco_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let [source, library] = ["other.c", "other.so"].map(|name| folder.path().join(name));
    let other = "const char *mj_versionString(void) { return \"3.3.7\"; }\nint mj_version(void) { return 337; }\n";
    fs::write(&source, other).unwrap();
    let mut cc = Command::new("cc");
    cc.args(["-shared", "-fPIC", "-o"])
        .arg(&library)
        .arg(&source);
    assert!(cc.status().unwrap().success());
    for model in ["models/kitchen.onnx", "models/lorel.onnx"] {
        let mut command = lads_run(project_file(model), &["--episodes", "1"]);
        let output = command.env("LD_PRELOAD", &library).output().unwrap();
        assert_refused(&output, &["MuJoCo 3.3.7", "LD_PRELOAD", "make setup"]);
    }
}

#[test]
fn what_has_no_end_is_not_waited_for() {
    for arguments in [
        &["--image"][..],
        &["--plans"],
        &["replay"],
        &["encode"],
        &["verify", "--reference"],
    ] {
        refused(
            &kitchen_bundle(),
            &[arguments, &["/dev/zero"]].concat(),
            &["/dev/zero", "not a regular file"],
        );
    }
    refused(
        Path::new("/dev/zero"),
        &[],
        &["/dev/zero", "not a regular file"],
    );
}
