//! Where the simulator's files lie: `vendor/` in the project's root, which `make setup` fills.

use std::path::{Path, PathBuf};

use thiserror::Error;

/// Overrides the folder that `make setup` fills, for installations elsewhere.
pub const VENDOR_VARIABLE: &str = "LADS_VENDOR";

/// A file of the simulator is not there.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("the simulator's assets are missing ({}): run \"make setup\"", .path.display())]
pub struct MissingAssets {
    /// What was looked for.
    pub path: PathBuf,
}

/// The vendor folder: `LADS_VENDOR` if set, else the one in the project that this program was built in.
pub fn vendor_dir() -> PathBuf {
    let project = || {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .parent()
            .unwrap_or(Path::new("."))
            .join("vendor")
    };
    std::env::var_os(VENDOR_VARIABLE).map_or_else(project, PathBuf::from)
}

/// The path of a file below the vendor folder, if it exists.
pub fn asset(vendor: &Path, file: &str) -> Result<PathBuf, MissingAssets> {
    let path = vendor.join(file);
    if path.is_file() {
        Ok(path)
    } else {
        Err(MissingAssets { path })
    }
}
