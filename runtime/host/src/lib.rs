//! Shared parts of programs on a host: opening policies, the memory of a controller, reading and
//! writing files.
//!
//! - [`open()`] reads a policy from either of its forms, a bundle (ONNX), which it compiles, or a
//!   compiled image. An [`Opened`] is a checked policy; [`Opened::load`] gives it memory, and
//!   [`Loaded::controller`] runs it.
//! - [`Memory`] and [`Aligned`] are memory in large pages, where the operating system has them.
//! - [`instruction`] finds a known instruction by what a person wrote; [`refused()`] describes a
//!   value that a controller refused.
//! - [`schedule`] lists which programs run at which step, and their cost; [`stored()`] names the
//!   formats of weights and caches.
//! - [`output`] writes every file of a command, [`input`] reads every whole file that a person
//!   named.
//!
//! The crate needs `std` and may allocate; the files that it opens may be hostile, so every error
//! is a value that names the thing and the remedy. The feature `compile`, on by default, includes
//! the compiler; without it, only images are opened.
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod aligned;
pub mod input;
pub mod instruction;
mod memory;
mod open;
pub mod output;
mod pages;
mod refused;
pub mod schedule;
mod stored;

pub use aligned::Aligned;
pub use memory::{Memory, MemoryError};
pub use open::{Loaded, OpenError, Opened, Problem, from_bytes, open};
#[cfg(feature = "compile")]
pub use open::{from_bytes_with, open_with};
pub use refused::refused;
pub use stored::{is_exact, stored};
