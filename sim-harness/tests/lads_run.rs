//! Tests the program `lads-run`: its report, its JSON, its logs and plans, and what an interrupt leaves.

#[cfg(target_os = "linux")]
#[path = "common/interrupt.rs"]
mod interrupt;
#[path = "common/lads_run.rs"]
mod program;
#[path = "common/schema.rs"]
mod schema;

use std::fs;
use std::path::Path;

use program::{kitchen_bundle, lads_run, project_file, refused};
use serde_json::Value;

/// Runs `lads-run`, expects success, and reads the JSON.
fn results(arguments: &[&str], json: &Path) -> (String, Value) {
    let output = lads_run(kitchen_bundle(), arguments)
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

/// Asserts that results have the form that is documented.
fn assert_schema(results: &Value) {
    let text = fs::read_to_string(project_file("sim-harness/proof/results.schema.json")).unwrap();
    let root: Value = serde_json::from_str(&text).unwrap();
    schema::check(results, &root, &root, "results");
}

#[test]
fn every_instruction_runs_and_the_json_has_its_schema() {
    let folder = tempfile::tempdir().unwrap();
    let (table, results) = results(&["--episodes", "1"], &folder.path().join("r.json"));
    assert_schema(&results);

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

#[cfg(target_os = "linux")]
#[test]
fn an_interrupt_overwrites_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("r.json");
    fs::write(&json, "from before").unwrap();
    let mut command = lads_run(
        kitchen_bundle(),
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
        let output = lads_run(kitchen_bundle(), arguments).output().unwrap();
        let errors = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{errors}");
        String::from_utf8(output.stdout).unwrap()
    };
    let json = folder.path().join("r.json");
    let first = ["--instruction", "mkbs", "--episodes", "1"];
    let recorded = [&first[..], &["--log", log, "--monitor"]].concat();
    let (table, results) = results(&recorded, &json);
    assert!(table.contains("executed segments are encoded as the plan in force"));
    assert_schema(&results);
    assert!(out(&["replay", log]).starts_with("EQUAL: 1 episodes"));
    out(&["encode", log, "--json", plans]);
    let commanded = [&first[..], &["--plans", plans, "--monitor"]].concat();
    let (table, again) = self::results(&commanded, &json);
    assert!(table.contains("mkbs"));
    // Plans that are read from a success, its last steps too, succeed.
    let succeeds = |results: &Value| results["instructions"][0]["runs"][0]["success"] == true;
    assert!(succeeds(&results) && succeeds(&again), "{table}");

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
        &["--drop-rate: ", "a drop rate of 2", "from 0 to 1"],
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
    let output = lads_run(kitchen_bundle(), &short)
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
