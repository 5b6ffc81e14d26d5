//! Measures the speed of a policy: hot, at a robot's rate, and compared with the runtimes that its
//! users would choose instead.
//!
//! ```text
//! Contender (lads, or who else runs the policy)
//!     │ block by block, in turns                      turns
//!     ▼
//! Sample (kind of call, lateness, duration)           contender, clock, realtime, load
//!     │
//!     ▼
//! Summary, Ratio (per round, then the median)         stats
//! ```
//!
//! [`paced`] is the protocol of a whole run with its report. What can fail is a [`BenchError`], one
//! line; a contender whose results differ from the others' is never timed.
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

pub mod clock;
pub mod contender;
pub mod error;
pub mod lads;
pub mod load;
pub mod paced;
pub mod realtime;
pub mod stats;
pub mod suite;
pub mod turns;

pub use error::BenchError;
