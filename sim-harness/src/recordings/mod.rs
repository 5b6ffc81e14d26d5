//! Recorded episodes: in memory, in files, replayed, and as sequences of plans.

pub mod plans;
pub mod replay;
pub mod starts;

pub use lads_record as recorder;
pub use lads_record::trace;
