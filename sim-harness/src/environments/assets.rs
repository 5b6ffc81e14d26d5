//! Locates the simulator's files: `vendor/` in the project's root, which `make setup` fills.

use std::path::{Path, PathBuf};

use thiserror::Error;

/// Environment variable that overrides the folder that `make setup` fills, for installations elsewhere.
pub const VENDOR_VARIABLE: &str = "LADS_VENDOR";

/// Version of MuJoCo that the harness was built for: another one has other layouts in memory.
pub const MUJOCO: &str = "3.17.0";

/// Another version of MuJoCo was loaded than the harness was built for.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "MuJoCo {got} was loaded, this program needs {MUJOCO}: take it out of LD_LIBRARY_PATH and LD_PRELOAD, and run \"make setup\""
)]
pub struct OtherMujoco {
    /// Version of the loaded MuJoCo.
    pub got: &'static str,
}

/// Checks the version of the loaded MuJoCo; its other functions may be called only after that.
pub fn check_mujoco() -> Result<(), OtherMujoco> {
    match mujoco_rs::mujoco_version() {
        MUJOCO => Ok(()),
        got => Err(OtherMujoco { got }),
    }
}

/// Remedy for a scene that MuJoCo refuses, chosen by the reason that it gives.
pub fn remedy(reason: &str) -> &'static str {
    let reason = reason.to_lowercase();
    if reason.contains("memory") || reason.contains("alloc") {
        "free memory, or raise the limit of this shell (ulimit -v)"
    } else {
        "run \"make setup\" to restore the assets"
    }
}

/// A file of the simulator is missing.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("the simulator's assets are missing ({}): run \"make setup\"", .path.display())]
pub struct MissingAssets {
    /// Path of the missing file.
    pub path: PathBuf,
}

/// Returns the vendor folder: `LADS_VENDOR` if set, else the one in the project that this program was built in.
pub fn vendor_dir() -> PathBuf {
    let project = || {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .parent()
            .unwrap_or(Path::new("."))
            .join("vendor")
    };
    std::env::var_os(VENDOR_VARIABLE).map_or_else(project, PathBuf::from)
}

/// Returns the path of a file below the vendor folder, if it exists.
pub fn asset(vendor: &Path, file: &str) -> Result<PathBuf, MissingAssets> {
    let path = vendor.join(file);
    if path.is_file() {
        Ok(path)
    } else {
        Err(MissingAssets { path })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mujoco_of_the_setup_is_the_right_one() {
        assert_eq!(check_mujoco(), Ok(()));
        let other = OtherMujoco { got: "3.3.7" }.to_string();
        assert!(other.contains("3.3.7") && other.contains(MUJOCO), "{other}");
    }

    #[test]
    fn memory_is_not_mended_by_other_assets() {
        assert!(remedy("could not allocate memory").contains("ulimit"));
        assert!(remedy("Error opening file 'x.stl'").contains("make setup"));
    }
}
