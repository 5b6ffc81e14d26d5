//! The `lads` command.
#![forbid(unsafe_code)]
fn main() {}
