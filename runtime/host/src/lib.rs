//! What commands on a host share; std, no controller needs it.
//!
//! [`output`] is the one place where a command writes a file, [`input`] the one where it reads a whole one that a person named.
#![forbid(unsafe_code)]

pub mod input;
pub mod output;
