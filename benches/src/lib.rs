//! Measures a policy: hot, at a robot's pace, and beside what its users would pick instead.
//!
//! ```text
//! Contender (lads, a general runtime, a Python worker)
//!     │ block by block, in turns                      turns
//!     ▼
//! Sample (kind of call, lateness, duration)           contender, clock, realtime, load
//!     │
//!     ▼
//! Summary, Ratio (per round, then the median)         stats
//! ```
//!
//! What can fail is a [`BenchError`], one line; a contender that computes something else than the others is never timed.
#![forbid(unsafe_code)]

use std::path::{Path, PathBuf};

pub mod clock;
pub mod contender;
pub mod error;
pub mod lads;
pub mod load;
pub mod paced;
#[cfg(feature = "peers")]
pub mod peers;
pub mod realtime;
pub mod stats;
pub mod suite;
pub mod sweep;
pub mod turns;

pub use error::BenchError;

/// The bundle to measure: the kitchen policy that ships.
pub fn bundle() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/kitchen.onnx")
}
