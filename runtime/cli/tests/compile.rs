//! Tests of `lads compile`: the gate of fewer bits, and the files that it writes.

mod common;

use std::fs;
use std::path::Path;

use lads_compiler::{CacheFormat, Evidence, Storage, Tuned, WeightFormat};

use common::{altered, answer, lads, refused, tiny};

#[test]
fn weights_of_fewer_bits_pass_a_gate() {
    let folder = tempfile::tempdir().unwrap();
    let (model, image) = (tiny(), folder.path().join("tiny.lads"));
    let (model, image) = (model.to_str().unwrap(), image.to_str().unwrap());
    let compile = |more: &[&'static str]| [&["compile", model, "-o", image], more].concat();
    // The bundle's tolerance is that of 32-bit sums.
    refused(
        &compile(&["--weights", "bf16"]),
        "",
        &["tiny.onnx", "bf16", "step 0", "tolerance"],
    );
    assert!(!Path::new(image).exists());
    let said = answer(&compile(&["--weights", "bf16", "--tolerance", "0.005"]), "");
    assert!(said.contains("bf16 weights: self-test passed"), "{said}");
    let tested = answer(&["self-test", image], "");
    assert!(tested.contains("tolerance 5e-3"), "{tested}");
    answer(&compile(&["--weights", "int8", "--force"]), "");
    refused(&["self-test", image], "", &["self-test failed"]);
    // What only helps to choose the plan takes fewer bits with no other tolerance, and the self-test says so.
    let smaller = ["--weights", "f16", "--low-level", "f32", "--cache", "f16"];
    let said = answer(&compile(&smaller), "");
    let stored = "f16 weights (low_level/act f32) and an f16 cache: self-test passed";
    assert!(said.contains(stored), "{said}");
    answer(&["self-test", image], "");
    for (flag, value, known) in [
        ("--weights", "f8", "f32, int16, f16, bf16, int8"),
        ("--low-level", "f64", "f32, int16, f16, bf16, int8"),
        ("--cache", "bf16", "f32, f16, int8"),
        ("--tolerance", "0", "positive"),
    ] {
        refused(&compile(&[flag, value]), "", &[value, known]);
    }
}

#[test]
fn a_bundle_is_compiled_as_it_was_tuned_unless_something_else_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (model, image) = (path("tuned.onnx"), path("tuned.lads"));
    let plain = fs::read(tiny()).unwrap();
    let untuned = tiny();
    let untuned = untuned.to_str().unwrap();
    let said = answer(&["compile", untuned, "-o", &image], "");
    assert!(said.contains("lads-run tune"), "{said}");
    let exact = fs::read(&image).unwrap();
    let storage = Storage::of_weights(WeightFormat::F16)
        .with_part("low_level/act", WeightFormat::F32)
        .with_cache(CacheFormat::F16);
    let tuned = Tuned::new(storage, Evidence::default()).written_into(&plain);
    fs::write(&model, tuned.unwrap()).unwrap();
    for (more, stored) in [
        (&[][..], "f16 weights (low_level/act f32) and an f16 cache"),
        (&["--cache", "f32"], "f16 weights (low_level/act f32)"),
        (
            &["--weights", "f16", "--low-level", "f32"],
            "f16 weights (low_level/act f32)",
        ),
        (
            &["--weights", "f32", "--cache", "f16"],
            "f32 weights and an f16 cache",
        ),
    ] {
        let arguments = [&["compile", &model, "-o", &image], more].concat();
        let said = answer(&arguments, "");
        assert!(
            said.contains(&format!("{stored}: self-test passed")),
            "{said}"
        );
    }
    let as_exact = ["compile", &model, "-o", &image, "--weights", "f32"];
    answer(&as_exact, "");
    assert_eq!(fs::read(&image).unwrap().len(), exact.len());
    // Every command that takes a bundle follows.
    let said = answer(&["inspect", &model], "");
    assert!(said.contains("f16"), "{said}");
    // A record for parts that are not there is refused by all of them.
    let stray = Storage::default().with_part("low_level/dance", WeightFormat::Int8);
    let stray = Tuned::new(stray, Evidence::default()).written_into(&plain);
    fs::write(&model, stray.unwrap()).unwrap();
    for arguments in [
        ["self-test", &model].to_vec(),
        ["compile", &model, "-o", &image].to_vec(),
    ] {
        refused(&arguments, "", &["tuned.onnx", "low_level/dance", "tune"]);
    }
}

#[test]
fn a_failed_compile_overwrites_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out.lads");
    fs::write(&output, "from before").unwrap();
    let broken = altered(folder.path(), "lads.contract", "some.contract");
    refused(
        &["compile", &broken, "-o", output.to_str().unwrap()],
        "",
        &["altered.onnx"],
    );
    assert_eq!(fs::read_to_string(&output).unwrap(), "from before");
    let nowhere = folder.path().join("no/folder/out.lads");
    let tiny = tiny();
    for place in [nowhere.as_path(), folder.path()] {
        let place = place.to_str().unwrap();
        refused(
            &["compile", tiny.to_str().unwrap(), "-o", place],
            "",
            &[place, "writable folder"],
        );
    }
}

#[test]
fn outputs_are_never_what_is_read_nor_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    fs::copy(tiny(), path("x.onnx")).unwrap();
    let before = fs::read(tiny()).unwrap();
    let (model, same) = (path("x.onnx"), path("sub/../x.onnx"));
    fs::create_dir(path("sub")).unwrap();
    for output in [&model, &same] {
        for option in ["-o", "--emit-c", "--emit-rust"] {
            refused(
                &["compile", &model, option, output],
                "",
                &[option, "x.onnx", "reads", "another file"],
            );
        }
    }
    let c = path("x.c");
    refused(
        &["compile", &model, "-o", &c, "--emit-c", &c],
        "",
        &["--emit-c", "x.c", "-o writes the same file"],
    );
    refused(
        &["compile", &model, "--emit-c", &c, "--emit-rust", &c],
        "",
        &["--emit-rust", "x.c", "--emit-c writes the same file"],
    );
    assert_eq!(fs::read(&model).unwrap(), before, "it was not touched");
    assert!(!Path::new(&c).exists());
}

#[cfg(unix)]
#[test]
fn devices_and_links_stay_what_they_are() {
    use std::os::unix::fs::{FileTypeExt as _, symlink};

    let (tiny, folder) = (tiny(), tempfile::tempdir().unwrap());
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let model = tiny.to_str().unwrap();
    fs::create_dir(path("there")).unwrap();
    symlink("there/a.lads", path("link.lads")).unwrap();
    symlink("/dev/null", path("null.lads")).unwrap();
    answer(&["compile", model, "-o", &path("link.lads")], "");
    answer(&["compile", model, "-o", &path("null.lads")], "");
    answer(&["compile", model, "-o", "/dev/null"], "");
    assert!(
        fs::metadata("/dev/null")
            .unwrap()
            .file_type()
            .is_char_device()
    );
    for link in ["link.lads", "null.lads"] {
        assert!(
            fs::symlink_metadata(path(link)).unwrap().is_symlink(),
            "{link}"
        );
    }
    answer(&["self-test", &path("there/a.lads")], "");
    // The image, and after it the line about it.
    let output = lads(&["compile", model, "-o", "/dev/stdout"], "");
    let image = fs::read(path("there/a.lads")).unwrap();
    assert!(output.status.success() && output.stdout.starts_with(&image));
}
