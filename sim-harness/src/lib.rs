//! MuJoCo environments, scripted experts and datasets, rollouts and metrics.
//!
//! Everything that needs a simulator is here; the runtime crates know nothing of it.
#![forbid(unsafe_code)]

pub mod assets;
pub mod environment;
pub mod kitchen;
pub mod random;
pub mod metrics;
pub mod registry;
