//! Code shared by suites that need more than one crate; the suites are in `tests/`.
#![forbid(unsafe_code)]

pub mod documents;
pub mod episode;
pub mod hostile;
mod wire;

use std::path::{Path, PathBuf};

use lads_compiler::{Bundle, Image, compile};

/// Returns a file or folder of the project, by its path from the root.
pub fn project_path(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
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
