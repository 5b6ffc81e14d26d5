//! Tests `lads-run tune`: what it finds for a shipped policy, what it writes, and what it refuses.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use lads_compiler::{Bundle, CacheFormat, Evidence, Storage, Tuned, WeightFormat};

/// Returns a file of the project, by its path from the root.
fn project_file(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

fn tune(model: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lads-run"))
        .args(["tune", "--model"])
        .arg(model)
        .args(arguments)
        .output()
        .unwrap()
}

fn refused(model: &Path, arguments: &[&str], parts: &[&str]) {
    let output = tune(model, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    for part in parts {
        assert!(errors.contains(part), "'{part}' is not in: {errors}");
    }
}

#[test]
fn every_plan_is_kept_and_the_bundle_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let (model, reference) = (
        folder.path().join("lorel.onnx"),
        project_file("models/lorel.reference.json"),
    );
    let other = folder.path().join("other.onnx");
    fs::copy(project_file("models/lorel.onnx"), &model).unwrap();
    let reference = ["--reference", reference.to_str().unwrap()];
    let elsewhere = ["-o", other.to_str().unwrap(), "--isa", "portable"];
    let mut printed = vec![];
    for arguments in [[&reference[..], &elsewhere].concat(), reference.to_vec()] {
        let output = tune(&model, &arguments);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{errors}");
        let text = String::from_utf8(output.stdout).unwrap();
        // int8 replays the golden episode and decides otherwise elsewhere.
        let wrong = "not int8: 6 decisions fall out otherwise";
        assert!(text.contains(wrong), "{text}");
        printed.push(text.lines().rev().skip(1).collect::<String>());
    }
    assert_eq!(printed[0], printed[1]);
    assert_eq!(fs::read(&model).unwrap(), fs::read(&other).unwrap());
    // A record that nobody can follow is replaced.
    let stray = Storage::default().with_part("low_level/dance", WeightFormat::Int8);
    let stray = Tuned::new(stray, Evidence::default()).written_into(&fs::read(&other).unwrap());
    fs::write(&model, stray.unwrap()).unwrap();
    assert!(lads_host::open(&model).is_err());
    let output = tune(&model, &reference);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    assert_eq!(fs::read(&model).unwrap(), fs::read(&other).unwrap());
    let bundle = Bundle::open(&model).unwrap();
    let tuned = bundle.tuned().unwrap().unwrap();
    let wanted = Storage::default()
        .with_part("high_level/instruct", WeightFormat::Int16)
        .with_part("high_level/start", WeightFormat::Int16)
        .with_part("high_level/step", WeightFormat::Int16)
        .with_part("trajectory_encoder/encode", WeightFormat::Int8)
        .with_part("low_level/act", WeightFormat::F32)
        .with_cache(CacheFormat::F16);
    for entry in wanted.parts.keys() {
        let formats = [&wanted, &tuned.storage].map(|storage| storage.of(entry, ""));
        assert_eq!(formats[0], formats[1], "{entry}");
    }
    let seen = &tuned.evidence;
    assert!(seen.decisions > 600 && seen.episodes == 202 && seen.reference_sha256.len() == 64);
    assert!(seen.segments > 0);
    assert_eq!(seen.largest_action_error, 0.0);
    assert!(seen.smallest_margin > Some(0.0) && seen.clear_share > 0.99);
    // A certificate finds no difference in what the policy answers.
    let verified = Command::new(env!("CARGO_BIN_EXE_lads-run"))
        .args(["verify", "--episodes", "1", "--model"])
        .arg(&model)
        .args(reference)
        .output();
    let verified = String::from_utf8(verified.unwrap().stdout).unwrap();
    assert!(
        verified.contains("0 of 101 replayed episodes differ"),
        "{verified}"
    );
    let exact = lads_compiler::compile_with(&bundle, &lads_compiler::Options::exact()).unwrap();
    let image = lads_compiler::compile(&bundle).unwrap();
    assert!(image.as_bytes().len() * 10 < exact.as_bytes().len() * 6);
}

/// What ships is what `tune` found with the reference beside it, and what compiles it by default is that.
#[test]
fn shipped_bundles_are_tuned_by_their_own_references() {
    for (name, most) in [
        ("kitchen", 2_600_000),
        ("kitchen-small", 350_000),
        ("lorel", 1_500_000),
    ] {
        let bundle = Bundle::open(&project_file(&format!("models/{name}.onnx"))).unwrap();
        let reference = fs::read(project_file(&format!("models/{name}.reference.json"))).unwrap();
        let tuned = bundle.tuned().unwrap().unwrap();
        let seen = &tuned.evidence;
        assert_eq!(seen.reference_sha256, lads_compiler::sha256(&reference));
        assert!(seen.decisions > 600 && seen.segments > 500 && seen.clear_share >= 0.99);
        assert_eq!(seen.largest_action_error, 0.0, "{name}");
        assert_eq!(tuned.storage.of("low_level/act", ""), WeightFormat::F32);
        let image = lads_compiler::compile(&bundle).unwrap();
        let bytes = image.as_bytes().len();
        assert!(bytes <= most, "{name}: {bytes}");
    }
}

#[test]
fn what_cannot_be_tuned_is_refused_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("kitchen.onnx");
    fs::copy(project_file("models/kitchen.onnx"), &model).unwrap();
    let before = fs::read(&model).unwrap();
    refused(&model, &[], &["kitchen.reference.json", "make reference"]);
    let of_another = project_file("models/lorel.reference.json");
    let of_another = of_another.to_str().unwrap();
    refused(
        &model,
        &["--reference", of_another],
        &["lorel.reference.json", "environment"],
    );
    let reference = project_file("models/kitchen.reference.json");
    let reference = reference.to_str().unwrap();
    let nowhere = folder.path().join("none/out.onnx");
    let nowhere = nowhere.to_str().unwrap();
    refused(
        &model,
        &["--reference", reference, "-o", nowhere],
        &["-o", "out.onnx"],
    );
    refused(
        &model,
        &["--reference", reference, "-o", reference],
        &["-o", "--reference"],
    );
    let none = folder.path().join("none.onnx");
    refused(&none, &["--reference", reference], &["none.onnx"]);
    assert_eq!(fs::read(&model).unwrap(), before);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}
