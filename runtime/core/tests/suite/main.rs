//! Tests of the crate, one module a subject; one binary, because each would compile the small policies of `support` anew.

#[path = "../support/mod.rs"]
mod support;

mod contract;
mod controller;
mod entries;
mod guard;
mod guard_bounds;
mod hostile;
mod inputs;
mod lads;
mod schedule;
mod self_test;
mod shapes;
mod soak;
mod swap;
mod undo;
mod warm;
mod workspace;
