//! What the benchmarks share; they are in `benches/`.
#![forbid(unsafe_code)]

use std::path::{Path, PathBuf};

/// The bundle to measure: the kitchen policy that ships.
pub fn bundle() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/kitchen.onnx")
}
