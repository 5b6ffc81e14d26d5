//! The C boundary of the runtime: open a program image, set up a guarded controller in memory of the caller, step it.
//!
//! C programs include `include/lads.h`, which is made from this crate, and link `liblads.a`; `make install PREFIX=...` makes both.
//!
//! ```c
//! static lads_policy policy;                                   // all memory is yours
//! lads_status status = lads_policy_open(image, image_bytes, &policy);
//! if (status != LADS_STATUS_OK) fail(lads_status_text(status));
//! void *workspace = aligned_alloc(LADS_WORKSPACE_ALIGN, lads_workspace_bytes(&policy));
//! lads_controller *controller;
//! lads_options options = {.struct_bytes = sizeof options, .fallback = LADS_FALLBACK_HOLD};
//! lads_controller_init(&policy, workspace, lads_workspace_bytes(&policy), &options, &controller, NULL);
//! lads_self_test(controller, NULL);                            // arms
//! lads_set_instruction(controller, 3);
//! lads_report report = {.struct_bytes = sizeof report};        // which channel and element was refused, what was selected
//! for (;;) {                                                   // every control period; `action` may be executed, see `lads_step`
//!     status = lads_step(controller, observation, n, &tick, action, m, &report);
//! }
//! ```
//!
//! Rules for every function:
//! - It returns a [`Status`], an `int32_t`. A refused call changes nothing, unless the function
//!   states otherwise.
//! - It allocates nothing, never blocks, never unwinds, has no global state, and calls nothing but `memcpy` and `memset`, on aarch64
//!   Linux also `getauxval`, on 32-bit Arm also what `libm` has.
//! - Null and misaligned pointers, policies and controllers that were never set up, and areas that overlap where one of them is written
//!   are refused, the workspace and the image among them.
//! - Options and reports begin with `struct_bytes`, their size as the caller knows it. The library
//!   reads and writes only the fields that both know, so both can be updated independently; options
//!   that it does not know are refused unless they are zero.
//! - It cannot check that a pointer leads to valid memory; that is the caller's duty, which each
//!   safety section states.
//! - One controller is used by one thread at a time. Different controllers, even of one policy, are independent.
//!
//! Under an operating system with virtual memory, put image and workspace where pages are large (on
//! Linux: aligned to 2 MiB, with `madvise(MADV_HUGEPAGE)`), and lock them. At a robot's rate the
//! caches are cold, and page-table walks take noticeable time.
//!
//! The cargo features of this crate are groups of operations of policies, all on by default;
//! `runtime/ffi/archive.sh` explains how to leave out those that a policy does not need.
//!
#![doc = include_str!("../README.md")]
#![no_std]
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

mod calls;
mod handle;
mod layout;
mod memory;
mod status;
mod types;
mod versioned;

use core::ffi::c_char;

use lads_core::Policy;

pub use calls::{control::*, describe::*, instruct::*, setup::*, step::*};
pub use layout::{LADS_STACK_BYTES, LADS_WORKSPACE_ALIGN, stack_bytes};
pub use status::Status;
pub use types::*;

/// Version of this interface; it grows when a program compiled for an older header would no longer work.
pub const LADS_ABI_VERSION: u32 = 2;

/// Returns the `LADS_ABI_VERSION` of the archive: compare it with the header's.
#[unsafe(no_mangle)]
pub extern "C" fn lads_abi_version() -> u32 {
    LADS_ABI_VERSION
}

/// Returns the same number as `lads_workspace_bytes`, for tools written in Rust.
pub fn workspace_bytes(policy: &Policy) -> usize {
    handle::layout(policy).map_or(0, |layout| layout.total)
}

/// Returns one line in English for a status; never null. The text is static and ends with a zero.
#[unsafe(no_mangle)]
pub extern "C" fn lads_status_text(status: i32) -> *const c_char {
    let known = Status::ALL
        .iter()
        .find(|(known, _)| *known as i32 == status);
    known.map_or(c"unknown status", |(_, text)| text).as_ptr()
}
