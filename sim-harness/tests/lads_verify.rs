//! Tests `lads-run verify`: the certificate of the shipped policy, its form, its exit codes, and every reference that is refused.

#[cfg(target_os = "linux")]
#[path = "common/interrupt.rs"]
mod interrupt;
#[path = "common/schema.rs"]
mod schema;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use lads_compiler::{Bundle, CacheFormat, Options, Storage, WeightFormat};
use serde_json::Value;

/// Returns a file of the project, by its path from the root.
fn project_file(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads-run"));
    command
        .args(["verify", "--model"])
        .arg(project_file("models/kitchen.onnx"))
        .args(arguments);
    command
}

fn verify(arguments: &[&str]) -> Output {
    command(arguments).output().unwrap()
}

fn certificate(arguments: &[&str], folder: &Path) -> (Option<i32>, Value) {
    let file = folder.join("certificate.json");
    let output = verify(&[arguments, &["--certificate", file.to_str().unwrap()]].concat());
    let text = fs::read_to_string(&file)
        .unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&output.stderr)));
    (output.status.code(), serde_json::from_str(&text).unwrap())
}

#[test]
fn few_episodes_agree_on_every_instruction_set_and_are_too_few() {
    let folder = tempfile::tempdir().unwrap();
    let schema =
        fs::read_to_string(project_file("sim-harness/proof/certificate.schema.json")).unwrap();
    let schema: Value = serde_json::from_str(&schema).unwrap();
    let few = ["--episodes", "4", "--instruction", "kbls"];
    let mut certificates = Vec::new();
    for isa in lads_core::Isa::all() {
        let arguments = [&few[..], &["--isa", isa.name()]].concat();
        let (code, mut found) = certificate(&arguments, folder.path());
        schema::check(&found, &schema, &schema, "certificate");
        assert_eq!((code, &found["verdict"]), (Some(3), &"INCONCLUSIVE".into()));
        assert!(found["more_episodes_per_instruction"].as_u64() > Some(0));
        assert_eq!(found["policy"]["differing_episodes"], 0);
        assert!(found["policy"]["largest_action_difference"].as_f64() < Some(1e-4));
        // The image that ships has fewer bits: with 32 the logits are PyTorch's, and what is off is rounding that changes no decision.
        assert!(found["exact"]["largest_logit_difference"].as_f64() < Some(1e-4));
        assert_eq!(found["exact"]["logit_tolerance"], 1e-2);
        assert_eq!(found["policy"]["logit_tolerance"], Value::Null);
        assert_eq!(found["exact"]["differing_episodes"], 0);
        let rounding = &found["rounding"];
        assert_eq!(rounding["loss"], Value::Null);
        assert_eq!(rounding["decisions"], found["policy"]["compared_decisions"]);
        let moved = &found["policy"]["largest_logit_difference"];
        assert!(moved.as_f64() > Some(1e-4) && moved.as_f64() < Some(0.05));
        assert!(found["policy"]["compared_decisions"].as_u64() > Some(5));
        assert!(found["policy"]["compared_segments"].as_u64() > Some(5));
        assert!(
            found["contract"]["fields"]
                .as_array()
                .unwrap()
                .contains(&"family".into())
        );
        assert_eq!(found["contract"]["differing"], Value::Array(Vec::new()));
        assert!(found["environment"]["largest_state_difference"].as_f64() <= Some(1e-6));
        assert_eq!(found["rollouts"]["identical_completions"], 1.0);
        assert!(found["rollouts"]["largest_action_difference"].as_f64() < Some(1e-4));
        assert_eq!(found["setting"]["isa"], isa.name());
        found["setting"]["isa"].take();
        certificates.push(found);
    }
    // The bits of the policy do not depend on the instruction set.
    assert!(certificates.windows(2).all(|pair| pair[0] == pair[1]));
}

/// Tests that a given image is verified, here one with fewer bits where they only help to choose the plan.
#[test]
fn a_given_image_is_what_is_verified() {
    let folder = tempfile::tempdir().unwrap();
    let [image, other, broken] = ["image.lads", "other.lads", "broken.lads"].map(|name| {
        let path = folder.path().join(name);
        path.to_str().unwrap().to_owned()
    });
    let options = Options {
        storage: Some(
            Storage::of_weights(WeightFormat::F16)
                .with_part("low_level/act", WeightFormat::F32)
                .with_cache(CacheFormat::F16),
        ),
        ..Options::default()
    };
    let compile = |bundle: &str| {
        let bundle = Bundle::open(&project_file(bundle)).unwrap();
        let image = lads_compiler::compile_with(&bundle, &options).unwrap();
        image.as_bytes().to_vec()
    };
    let mut bytes = compile("models/kitchen.onnx");
    fs::write(&image, &bytes).unwrap();
    let few = ["--episodes", "1", "--instruction", "kbls"];
    let (code, found) = certificate(&[&few[..], &["--image", &image]].concat(), folder.path());
    assert_eq!((code, &found["verdict"]), (Some(3), &"INCONCLUSIVE".into()));
    assert_eq!(found["policy"]["differing_episodes"], 0);
    assert_eq!(found["rounding"]["loss"], Value::Null);
    assert_eq!(found["rollouts"]["identical_completions"], 1.0);
    assert_eq!(
        found["setting"]["image_sha256"],
        lads_compiler::sha256(&bytes)
    );
    assert_eq!(
        found["setting"]["image_stored"],
        "f16 and f32 weights, f16 cache"
    );
    // The low level's bits are those of the exact policy.
    let (_, exact) = certificate(&few, folder.path());
    assert_eq!(
        found["policy"]["largest_action_difference"],
        exact["policy"]["largest_action_difference"]
    );
    assert_ne!(
        found["setting"]["image_sha256"],
        exact["setting"]["image_sha256"]
    );

    fs::write(&other, compile("models/lorel.onnx")).unwrap();
    refused(
        &["--image", &other],
        &[
            "other.lads",
            "another bundle",
            "kitchen.onnx",
            "lads compile",
        ],
    );
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&broken, &bytes).unwrap();
    refused(
        &["--image", &broken],
        &["broken.lads", "checksum", "compile it again"],
    );
    fs::write(&broken, &bytes[..5000]).unwrap();
    refused(
        &["--image", &broken],
        &["broken.lads", "bytes", "compile it again"],
    );
    refused(
        &["--image", "/nowhere/x.lads"],
        &[
            "/nowhere/x.lads",
            "name a bundle (.onnx) or a compiled image",
        ],
    );
}

#[test]
fn the_page_is_one_file_that_names_the_verdict() {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("certificate.html");
    let arguments = [
        "--episodes",
        "1",
        "--instruction",
        "mksh",
        "--certificate",
        page.to_str().unwrap(),
    ];
    let output = verify(&arguments);
    assert_eq!(output.status.code(), Some(3));
    let page = fs::read_to_string(page).unwrap();
    assert!(page.contains("INCONCLUSIVE") && page.contains("slide cabinet"));
    for fetched in ["http://", "https://", "src=", "href=", "@import", "url("] {
        assert!(!page.contains(fetched), "{fetched}");
    }
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(
        printed.contains("INCONCLUSIVE") && printed.contains("McNemar"),
        "{printed}"
    );
}

/// Tests that the output says where the reference's weights came from, what that leaves open, and what was not looked at.
#[test]
fn the_source_of_the_reference_is_printed() {
    let of = |reference: &str| {
        let output = verify(&[
            "--reference",
            reference,
            "--episodes",
            "1",
            "--instruction",
            "kbls",
        ]);
        String::from_utf8(output.stdout).unwrap()
    };
    // The shipped reference is the run's checkpoint, so a wrong export would show.
    let shipped = project_file("models/kitchen.reference.json");
    let printed = of(shipped.to_str().unwrap());
    for part in [
        "reference: weights from the run's checkpoint",
        "not covered: ",
        "24 of 25 instructions",
    ] {
        assert!(printed.contains(part), "'{part}' is not in: {printed}");
    }
    assert!(!printed.contains("note: "), "{printed}");
    let folder = tempfile::tempdir().unwrap();
    let source = r#""weights_from": "the run's checkpoint""#;
    let from_bundle = altered(
        folder.path(),
        source,
        r#""weights_from": "the bundle's initializers""#,
    );
    let printed = of(&from_bundle);
    for part in [
        "reference: weights from the bundle's initializers",
        "note: the reference's weights come from the bundle's initializers",
        "not covered: ",
        "export of the weights",
    ] {
        assert!(printed.contains(part), "'{part}' is not in: {printed}");
    }
}

/// Tests a reference of the first version, which records neither contract nor logits: its silence is not agreement.
#[test]
fn a_reference_without_a_contract_decides_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(project_file("models/kitchen.reference.json")).unwrap();
    let mut file: Value = serde_json::from_str(&text).unwrap();
    file["format_version"] = 1.into();
    file.as_object_mut().unwrap().remove("contract");
    let path = folder.path().join("old.json");
    fs::write(&path, file.to_string()).unwrap();
    let few = [
        "--reference",
        path.to_str().unwrap(),
        "--episodes",
        "1",
        "--instruction",
        "kbls",
    ];
    let (code, found) = certificate(&few, folder.path());
    assert_eq!((code, &found["verdict"]), (Some(3), &"INCONCLUSIVE".into()));
    let reasons = found["reasons"].to_string();
    assert!(
        reasons.contains("the contract was not compared") && reasons.contains("--complete"),
        "{reasons}"
    );
}

fn refused(arguments: &[&str], parts: &[&str]) {
    let output = verify(arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(
        output.stdout.is_empty() && errors.lines().count() == 1,
        "{errors}"
    );
    for part in parts {
        assert!(errors.contains(part), "'{part}' is not in: {errors}");
    }
}

/// Copies the reference, with one text of it replaced.
fn altered(folder: &Path, from: &str, to: &str) -> String {
    let text = fs::read_to_string(project_file("models/kitchen.reference.json")).unwrap();
    assert!(text.contains(from), "{from}");
    let path = folder.join("altered.json");
    fs::write(&path, text.replacen(from, to, 1)).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn references_of_something_else_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let certificate = folder.join("c.json");
    let check = |from: &str, to: &str, parts: &[&str]| {
        let path = altered(folder, from, to);
        refused(
            &[
                "--reference",
                &path,
                "--certificate",
                certificate.to_str().unwrap(),
            ],
            parts,
        );
        assert!(!certificate.exists());
    };
    let environment = r#""environment": {"id": "franka-kitchen", "version": "1""#;
    check(
        environment,
        r#""environment": {"id": "franka-kitchen", "version": "2""#,
        &["environment version", "'2'", "'1'"],
    );
    check(
        environment,
        r#""environment": {"id": "other", "version": "1""#,
        &["environment", "'other'"],
    );
    check(
        r#"open sliding cabinet", "split": "seen""#,
        r#"close sliding cabinet", "split": "seen""#,
        &["instruction list", "close sliding"],
    );
    check(
        r#""purpose_sha256": ""#,
        r#""purpose_sha256": "0"#,
        &["contract hash"],
    );
    check(
        r#""format_version": 2"#,
        r#""format_version": 9"#,
        &["lads-reference 9", "make reference"],
    );
    check(
        r#""plans": [19"#,
        r#""plans": [19, 19"#,
        &["not one per decision"],
    );
    check(
        r#""plans": [19"#,
        r#""plans": [18"#,
        &["a plan is not that of the largest logit"],
    );
    check(
        r#""final_state": ["#,
        r#""final_state": [0.5, "#,
        &["final state"],
    );
    refused(
        &["--reference", "no-such-file.json"],
        &["no-such-file.json", "make reference"],
    );
    refused(
        &["--reference", project_file("README.md").to_str().unwrap()],
        &["not a reference"],
    );
    refused(&["--episodes", "21"], &["--episodes 21", "20"]);
    refused(
        &["--episodes", "1", "--certificate", "no/such/folder/c.json"],
        &["--certificate", "no/such/folder"],
    );
}

#[cfg(target_os = "linux")]
#[test]
fn one_interrupt_ends_any_part_of_it_and_leaves_no_certificate() {
    // Before or early in the open loops, and in closed loop; all episodes of the instruction take seconds.
    for ready in [interrupt::is_handled, interrupt::runs_episodes] {
        let folder = tempfile::tempdir().unwrap();
        let certificates = ["c.json", "c.html"].map(|name| folder.path().join(name));
        let mut command = command(&["--instruction", "kbls", "--threads", "1"]);
        for path in &certificates {
            command.arg("--certificate").arg(path);
        }
        let ended = interrupt::when(&mut command, &ready);
        let (code, errors) = ended.expect("it is still at work");
        assert_eq!(code, Some(130), "{errors}");
        assert_eq!(errors, "interrupted: nothing was written\n");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
