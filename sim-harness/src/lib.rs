//! MuJoCo environments, scripted experts and datasets, rollouts and metrics.
//!
//! Everything that needs a simulator is here; the runtime crates know nothing of it.
#![forbid(unsafe_code)]

pub mod assets;
pub mod collect;
pub mod command;
pub mod dataset;
pub mod environment;
pub mod evaluate;
pub mod expert;
pub mod faults;
#[cfg(feature = "record")]
pub mod film;
pub mod fit;
pub mod instructions;
pub mod kitchen;
pub mod lorel;
pub mod metrics;
pub mod output;
pub mod plans;
pub mod random;
pub mod recorder;
pub mod registry;
pub mod replay;
#[cfg(feature = "report")]
pub mod report;
pub mod results;
pub mod rollout;
pub mod spoken;
pub mod table;
pub mod trace;
pub mod verify;
#[cfg(feature = "viewer")]
pub mod viewer;
