//! Benchmarks of the runtime, and what its users would pick instead, as contenders of lads-pace.
#![forbid(unsafe_code)]

use std::path::{Path, PathBuf};

#[cfg(feature = "peers")]
pub mod peers;
pub mod sweep;

/// The bundle to measure: the kitchen policy that ships.
pub fn bundle() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/kitchen.onnx")
}
