//! Simulated environments: what one is, the two there are, and whether a policy fits into one.

pub mod assets;
pub mod environment;
pub mod fit;
pub mod kitchen;
pub mod lorel;
pub mod registry;
