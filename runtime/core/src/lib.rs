//! Runs a compiled policy: program image in, actions out, once every control period.
//!
//! - [`Policy::new_checked`] is a fully checked view on a program image; it copies nothing.
//! - [`Workspace::new`] takes the caller's memory: [`Policy::arena_len`] and [`Policy::state_len`] elements.
//! - [`Controller`] puts both to work: [`set_instruction`](Controller::set_instruction), then
//!   [`step`](Controller::step) for every observation.
//! - [`GuardedController`] wraps a controller in a guard that watches the observations and the
//!   clock and limits the actions; drive real machines only through this one.
//!
//! Invariants: no `std`, no allocation, no unsafe code, no panic. Sizes (contract), weights (image)
//! and mutable state (workspace) are three types. Everything about a model is checked when it is
//! opened; afterwards only what the caller passes can be refused, with one small error enum per
//! operation. The same image and the same calls give the same bits on every target and on every
//! [`Isa`], which a controller chooses once, when it is made; subnormal `f32` numbers are the one
//! exception: x86-64 treats them as zero while a program runs, so that they cost no time, and other
//! targets compute with them.
//!
//! The crate lads-image describes the format for the compiler that writes it.
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

mod contract;
mod controller;
mod decision;
mod errors;
mod golden;
mod guard;
mod inputs;
mod lookup;
mod normal;
mod policy;
mod run;
mod schedule;
mod self_test;
pub mod similarity;
mod workspace;

pub use contract::{
    Beyond, Channel, ChannelId, Contract, ContractError, DType, Decision, Element, Interval,
    KnownInstruction, Noise, QuaternionOrder, Role,
};
pub use controller::{Controller, Instruction, Selected, StepReport};
pub use errors::{EncodeError, FollowError, InputError, InstructionError, RunError, StepError};
pub use golden::{Golden, GoldenStep};
pub use guard::{
    ActionLength, Counters, Fallback, GuardConfig, GuardError, GuardReport, GuardedController,
    Intervention, Limits, SwapError, Tick,
};
pub use inputs::{Data, MAX_OBSERVATIONS};
pub use lads_image::tables::TablesError;
pub use lads_image::{ExecError, ProgramError};
pub use lads_kernels::Isa;
pub use lookup::instructions_called;
pub use policy::{Policy, PolicyError};
pub use schedule::ScheduleError;
pub use self_test::{SelfTest, SelfTestError};
pub use workspace::{Workspace, WorkspaceTooSmall};
