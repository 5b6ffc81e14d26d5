//! Code shared by suites that need more than one crate; the suites are in `tests/`.
#![forbid(unsafe_code)]

pub mod documents;
pub mod episode;
pub mod hostile;
mod wire;

use std::path::{Path, PathBuf};
use std::process::Command;

use lads_compiler::{Bundle, Image, compile};

/// Returns a file or folder of the project, by its path from the root.
pub fn project_path(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Builds programs, as `["--bin", "lads"]` or `["--example", "biped"]` name them; returns the folder of the build that this test belongs to.
///
/// With the features of the whole suite: another selection would be a build of its own, of minutes.
///
/// # Panics
///
/// When they do not build.
pub fn built(programs: &[&str]) -> PathBuf {
    let makefile = std::fs::read_to_string(project_path("Makefile")).expect("it can be read");
    let features = makefile
        .lines()
        .find_map(|line| line.strip_prefix("CARGO_FEATURES := "))
        .expect("the Makefile says what tests are built with");
    let test = std::env::current_exe().expect("a test is a file");
    let folder = test.ancestors().nth(2).expect("it lies in deps/");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let built = Command::new(cargo)
        .args(["build", "--quiet", "--workspace", "--features", features])
        // With an example, cargo counts in the dependencies of tests, whose features are those of this build.
        .args(["--example", "controller"])
        .args(programs)
        .args(folder.ends_with("release").then_some("--release"))
        .arg("--target-dir")
        .arg(folder.parent().expect("it is a profile's"))
        .current_dir(project_path("."))
        .status()
        .expect("cargo runs");
    assert!(built.success(), "{programs:?} do not build");
    folder.to_owned()
}

/// Lists the small bundle of the compiler's tests and every bundle that ships.
///
/// # Panics
///
/// When no bundle ships: then nothing would be tested.
pub fn bundles() -> Vec<PathBuf> {
    let folder = project_path("models");
    let entries = std::fs::read_dir(&folder).expect("the project has a folder models");
    let paths = entries.map(|entry| entry.expect("it can be read").path());
    let mut bundles: Vec<_> = paths
        .filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "onnx")
        })
        .collect();
    assert!(!bundles.is_empty(), "{} holds no bundle", folder.display());
    bundles.sort();
    bundles.push(project_path("runtime/compiler/tests/data/tiny.onnx"));
    bundles
}

/// Opens and compiles a bundle.
///
/// # Panics
///
/// When it does not compile.
pub fn compiled(path: &Path) -> Image {
    let bundle = Bundle::open(path).unwrap_or_else(|error| panic!("{error}"));
    compile(&bundle).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Imports the biped's policies for standing and walking and compiles them.
///
/// # Panics
///
/// When they cannot be imported.
pub fn biped() -> [(&'static str, Vec<u8>, Image); 2] {
    let folder = project_path("runtime/host/examples/biped");
    ["stand", "walk"].map(|name| {
        let policy = folder.join(name).with_extension("onnx");
        let robot = folder.join("robot.toml");
        let request = lads_import::Request {
            models: vec![&policy],
            robot: Some(&robot),
            ..lads_import::Request::default()
        };
        let imported = lads_import::import(&request).unwrap_or_else(|error| panic!("{error}"));
        let bundle = Bundle::from_bytes(&imported.bundle).unwrap_or_else(|error| panic!("{error}"));
        let image = compile(&bundle).unwrap_or_else(|error| panic!("{name}: {error}"));
        (name, imported.bundle, image)
    })
}
