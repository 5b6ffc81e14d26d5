//! What programs on a host share: opening policies, the memory of a controller, the files that they read and write.
//!
//! - [`open()`] reads a policy from either of its forms, a bundle (ONNX), which it compiles, or a compiled image. An [`Opened`] is a
//!   policy that was checked; [`Opened::load`] gives it memory, and [`Loaded::controller`] puts it to work.
//! - [`Memory`] and [`Aligned`] are memory in large pages, where the operating system has them.
//! - [`instruction`] finds a known instruction by what a person wrote; [`refused()`] says which value a controller did not take.
//! - [`schedule`] says which programs run at which step, and what that costs; [`stored()`] in which formats weights and caches lie.
//! - [`output`] is the one place where a command writes a file, [`input`] the one where it reads a whole one that a person named.
//!
//! Needs `std` and may allocate; what it opens may be hostile, so every error is a value that names the thing and the remedy. The
//! feature `compile`, on by default, brings the compiler; without it, only images are opened.
//!
//! ```no_run
//! # fn run() -> Result<(), Box<dyn std::error::Error>> {
//! let mut policy = lads_host::open("kitchen.onnx".as_ref())?.load()?;
//! let instruction = policy.opened().instruction("open the microwave")?;
//! let mut controller = policy.controller();
//! controller.self_test()?;
//! controller.set_instruction(lads_core::Instruction::Id(instruction))?;
//! # Ok(())
//! # }
//! ```
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
