//! Benchmarks of the runtime and of the runtimes that its users would otherwise pick, as contenders of lads-pace.
#![forbid(unsafe_code)]

use std::path::{Path, PathBuf};

#[cfg(feature = "peers")]
pub mod peers;
pub mod sweep;

/// Path of the bundle to measure: the kitchen policy that ships.
pub fn bundle() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/kitchen.onnx")
}
