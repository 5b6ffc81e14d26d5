//! Episodes that are kept: in memory, in files, replayed, and as sequences of plans.

pub mod plans;
pub mod recorder;
pub mod replay;
pub mod trace;
