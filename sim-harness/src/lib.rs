//! MuJoCo environments, scripted experts and datasets, rollouts and recordings.
//!
//! Everything that needs a simulator is here; the runtime crates know nothing of it, and [`lads_proof`] judges the numbers that come of it.
#![forbid(unsafe_code)]

pub mod command;
pub mod demonstrations;
pub mod environments;
pub mod evaluation;
#[cfg(feature = "camera")]
pub mod film;
pub mod frames;
pub mod output;
mod queue;
pub mod random;
pub mod recordings;
#[cfg(feature = "report")]
pub mod report;
pub mod tune;
pub mod verify;
#[cfg(feature = "viewer")]
pub mod viewer;

// Rooms keep the modules in order; their users name the modules.
pub use demonstrations::{collect, dataset, expert, instructions};
pub use environments::{assets, environment, fit, kitchen, lorel, registry};
pub use evaluation::{evaluate, faults, results, rollout, sight, spoken, table};
pub use recordings::{plans, recorder, replay, starts, trace};

/// The examples of the project's README compile as typed.
#[cfg(all(doctest, feature = "language"))]
#[doc = include_str!("../../README.md")]
pub struct Readme;
