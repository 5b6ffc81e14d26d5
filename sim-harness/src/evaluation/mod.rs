//! Policies in environments: single episodes, evaluations of many, and their results.

pub mod evaluate;
pub mod faults;
pub mod results;
pub mod rollout;
pub mod sight;
pub mod spoken;
pub mod table;
