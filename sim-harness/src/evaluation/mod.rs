//! Policies in environments: one episode, many of them, and what they come to.

pub mod evaluate;
pub mod faults;
pub mod results;
pub mod rollout;
pub mod sight;
pub mod spoken;
pub mod table;
