//! The program image's format and its operations: the compiler writes images, `lads-core` runs
//! them.
//!
//! - [`codec`] writes and reads records of 32-bit words, [`place`] says where the values of a program live.
//! - [`op`] is the table of operations, one file each behind [`Operation`]: record, check, run, accesses, work.
//! - [`Program::new_checked`] checks a list of encoded ops once; [`Program::run`] runs them on a [`Machine`].
//! - [`Access`] tells the verifier of memory plans which elements an op touches.
//!
//! Invariants: no `std`, no allocation, no unsafe code, no panic, whatever the words of an image
//! say. A checked program can fail in two ways when it runs: by an index outside its table and by a
//! full KV cache ([`ExecError`]).
//!
#![doc = include_str!("../README.md")]
#![no_std]
#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    deny(
        clippy::arithmetic_side_effects,
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic
    )
)]

#[cfg(test)]
extern crate std;

mod access;
mod chain;
mod check;
pub mod codec;
pub mod format;
mod machine;
pub mod op;
pub mod place;
mod program;
pub mod records;
pub mod tables;

pub use access::{Access, AccessKind};
pub use chain::Chain;
pub use check::{Checker, Fault, Spaces};
pub use lads_kernels::Isa;
pub use machine::{ExecError, Machine};
pub use op::{OP_WORDS, Op, Operation, Slots, Work};
pub use program::{Program, ProgramError};
pub use tables::Tables;
