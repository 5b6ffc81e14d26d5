//! Simulated environments: their interface, the two implementations, and the check whether a policy fits one.

pub mod assets;
pub mod environment;
pub mod fit;
pub mod kitchen;
pub mod lorel;
pub mod registry;
