//! Tests the program `lads-run`: its report, its JSON, and everything that it refuses.

#[cfg(target_os = "linux")]
#[path = "common/interrupt.rs"]
mod interrupt;
#[path = "common/schema.rs"]
mod schema;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

/// Returns a file of the project, by its path from the root.
fn project_file(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Path of the small bundle of the compiler's tests, which is for another environment.
fn tiny_bundle() -> PathBuf {
    project_file("runtime/compiler/tests/data/tiny.onnx")
}

/// Path of the kitchen bundle that ships.
fn kitchen_bundle() -> PathBuf {
    project_file("models/kitchen.onnx")
}

fn lads_run(model: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads-run"));
    // Another job than the main one comes first.
    let (job, rest) = match arguments {
        [job, rest @ ..] if !job.starts_with('-') => (Some(job), rest),
        _ => (None, arguments),
    };
    command.args(job).arg("--model").arg(model).args(rest);
    // Whatever the user's own cache has.
    command.env("LADS_CACHE", "/nonexistent");
    command
}

/// Runs `lads-run`, expects success, and reads the JSON.
fn results(arguments: &[&str], json: &Path) -> (String, Value) {
    let output = lads_run(&kitchen_bundle(), arguments)
        .arg("--json")
        .arg(json)
        .output()
        .unwrap();
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{errors}");
    let results = serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
    (String::from_utf8(output.stdout).unwrap(), results)
}

/// Removes the fields that are measured times.
fn timeless(mut results: Value) -> Value {
    let fields = results.as_object_mut().unwrap();
    assert!(fields.remove("latency_us").is_some() && fields.remove("time").is_some());
    results
}

/// Asserts exit code 2, nothing on stdout, and one line on stderr with all `parts`.
fn assert_refused(output: &Output, parts: &[&str]) {
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(output.stdout.is_empty());
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(
        errors.starts_with("error: ") && !errors.contains("panicked"),
        "{errors}"
    );
    for part in parts {
        assert!(errors.contains(part), "'{part}' is not in: {errors}");
    }
}

fn refused(model: &Path, arguments: &[&str], parts: &[&str]) {
    assert_refused(&lads_run(model, arguments).output().unwrap(), parts);
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
fn every_instruction_runs_and_the_json_has_its_schema() {
    let folder = tempfile::tempdir().unwrap();
    let (table, results) = results(&["--episodes", "1"], &folder.path().join("r.json"));
    let text = fs::read_to_string(project_file("sim-harness/proof/results.schema.json")).unwrap();
    let root: Value = serde_json::from_str(&text).unwrap();
    schema::check(&results, &root, &root, "results");

    let count = |split: &str| results["splits"][split]["episodes"].as_u64().unwrap();
    assert_eq!((count("seen"), count("unseen")), (22, 3));
    let instructions = results["instructions"].as_array().unwrap();
    assert_eq!(instructions.len(), 25);
    for instruction in instructions {
        let id = instruction["id"].as_str().unwrap();
        assert!(
            table.lines().any(|line| line.starts_with(id)),
            "{id} has a row"
        );
        assert_eq!(instruction["completions"].as_array().unwrap().len(), 4);
        assert_eq!(instruction["runs"].as_array().unwrap().len(), 1);
    }
    for word in [
        "K-rate 4",
        "full success",
        "ordinary step",
        "decision step",
        "instruct",
        "inside MuJoCo",
    ] {
        assert!(table.contains(word), "{word} is not in the report");
    }
}

#[test]
fn the_number_of_threads_does_not_show() {
    let folder = tempfile::tempdir().unwrap();
    let run = |threads: &str, rest: &[&str]| {
        let arguments = [
            &[
                "--instruction",
                "kbls",
                "--episodes",
                "3",
                "--seed",
                "5",
                "--threads",
                threads,
            ],
            rest,
        ]
        .concat();
        let (_, results) = results(&arguments, &folder.path().join(format!("{threads}.json")));
        timeless(results)
    };
    let sampled = run("1", &["--sample"]);
    assert_eq!(run("3", &["--sample"]), sampled);
    assert_eq!(sampled["decision"]["rule"], "sample");
    // With neither noise nor sampling all episodes are one.
    let same = run("2", &["--noise", "none"]);
    let runs = same["instructions"][0]["runs"].as_array().unwrap();
    for field in ["steps", "plans", "completions"] {
        assert!(
            runs.iter().all(|run| run[field] == runs[0][field]),
            "{field}"
        );
    }
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
    let mut command = lads_run(&kitchen_bundle(), &[]);
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

#[cfg(target_os = "linux")]
#[test]
fn an_interrupt_overwrites_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("r.json");
    fs::write(&json, "from before").unwrap();
    let mut command = lads_run(
        &kitchen_bundle(),
        &["--episodes", "1000", "--json", json.to_str().unwrap()],
    );
    let ended = interrupt::when(&mut command, &interrupt::runs_episodes);
    let (code, errors) = ended.expect("25,000 episodes take minutes");
    assert_eq!(code, Some(130), "{errors}");
    assert!(
        errors.contains("interrupted") && !errors.contains("panicked"),
        "{errors}"
    );
    assert_eq!(fs::read_to_string(&json).unwrap(), "from before");
    assert_eq!(
        fs::read_dir(folder.path()).unwrap().count(),
        1,
        "no temporary file stays"
    );
}

#[test]
fn a_log_replays_and_its_plans_run() {
    let folder = tempfile::tempdir().unwrap();
    let (log, plans) = (folder.path().join("f.mcap"), folder.path().join("p.json"));
    let (log, plans) = (log.to_str().unwrap(), plans.to_str().unwrap());
    let out = |arguments: &[&str]| {
        let output = lads_run(&kitchen_bundle(), arguments).output().unwrap();
        let errors = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{errors}");
        String::from_utf8(output.stdout).unwrap()
    };
    let json = folder.path().join("r.json");
    let first = ["--instruction", "mkbs", "--episodes", "1"];
    let recorded = [&first[..], &["--log", log, "--monitor"]].concat();
    let (table, results) = results(&recorded, &json);
    assert!(table.contains("executed segments are encoded as the plan in force"));
    let text = fs::read_to_string(project_file("sim-harness/proof/results.schema.json")).unwrap();
    let root: Value = serde_json::from_str(&text).unwrap();
    schema::check(&results, &root, &root, "results");
    assert!(out(&["replay", log]).starts_with("EQUAL: 1 episodes"));
    out(&["encode", log, "--json", plans]);
    let table = out(&[&first[..], &["--plans", plans, "--monitor"]].concat());
    assert!(table.contains("mkbs"));

    let mut cut = fs::read(log).unwrap();
    cut.truncate(cut.len() - 9);
    fs::write(log, cut).unwrap();
    refused(
        &kitchen_bundle(),
        &["replay", log],
        &["replay", "not a complete MCAP file"],
    );
    refused(&kitchen_bundle(), &["--plans", log], &["--plans", "f.mcap"]);
    refused(&kitchen_bundle(), &["replay", "no.mcap"], &["no.mcap"]);
    refused(
        &kitchen_bundle(),
        &["--log", "/no/such/folder/f.mcap"],
        &["--log", "folder"],
    );
    refused(
        &kitchen_bundle(),
        &["--drop-rate", "2"],
        &["--drop-rate 2", "from 0 to 1"],
    );
}

#[test]
fn a_sweep_runs_every_level_of_every_fault() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = ["sweep", "--episodes", "1", "--instruction", "kbls"];
    let (table, sweep) = results(&arguments, &folder.path().join("s.json"));
    let levels = sweep["levels"].as_array().unwrap();
    assert_eq!(levels.len(), 20);
    let of = |fault: &str| -> Vec<&Value> {
        levels
            .iter()
            .filter(|level| level["fault"] == fault)
            .collect()
    };
    let rate = |level: &Value| level["splits"]["seen"]["n_rate"].as_f64().unwrap();
    for fault in ["delay-steps", "drop-rate", "noise-scale", "action-lag"] {
        assert!(table.contains(fault), "{table}");
        let levels = of(fault);
        assert_eq!(levels.len(), 5);
        // The first level of each is none of it.
        assert_eq!(levels[0]["splits"], of("delay-steps")[0]["splits"]);
        assert!(
            levels
                .iter()
                .all(|level| (0.0..=4.0).contains(&rate(level)))
        );
        assert!(
            levels
                .iter()
                .all(|level| level["refused_episodes"] == 0 && level["episodes"] == 1)
        );
    }
    // The last levels of these are more than this policy bears.
    for fault in ["delay-steps", "noise-scale", "action-lag"] {
        let rates: Vec<_> = of(fault).into_iter().map(rate).collect();
        assert!(rates[4] < rates[0], "{fault}: {rates:?}");
    }
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
fn results_go_into_devices_and_through_links() {
    use std::os::unix::fs::{FileTypeExt as _, symlink};

    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::create_dir(path("there")).unwrap();
    symlink("there/r.json", path("link.json")).unwrap();
    let short = [
        "--instruction",
        "kbls",
        "--episodes",
        "1",
        "--noise",
        "none",
    ];
    let (_, read) = results(&short, &path("link.json"));
    assert!(read["instructions"].is_array() && path("there/r.json").is_file());
    assert!(
        fs::symlink_metadata(path("link.json"))
            .unwrap()
            .is_symlink()
    );
    let output = lads_run(&kitchen_bundle(), &short)
        .args(["--json", "/dev/null", "--log", "/dev/null"])
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    assert!(
        fs::metadata("/dev/null")
            .unwrap()
            .file_type()
            .is_char_device()
    );
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
        let mut command = lads_run(&project_file(model), &["--episodes", "1"]);
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
