//! Tests of the C functions, called from Rust as C calls them, one module a subject.

mod abi;
mod channels;
mod host;
mod overlap;
mod refusals;
mod swap;
mod versions;
