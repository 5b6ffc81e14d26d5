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
//! lads_controller_init(&policy, workspace, lads_workspace_bytes(&policy), NULL, &controller);
//! lads_self_test(controller, NULL);                            // arms
//! lads_set_instruction(controller, 3);
//! for (;;) {                                                   // every control period; `action` may be executed, whatever it returns
//!     status = lads_step(controller, observation, n, &tick, action, m, NULL);
//! }
//! ```
//!
//! Rules for every function:
//! - It returns a [`Status`], an `int32_t`. What is refused changes nothing, unless the function says so.
//! - It allocates nothing, never blocks, never unwinds, has no global state, and calls nothing but `memcpy` and `memset`.
//! - Null and misaligned pointers, areas that overlap, and policies and controllers that were never set up are refused.
//! - It cannot check that memory is what a pointer says; that is the caller's part, and each safety section says which.
//! - One controller is used by one thread at a time. Different controllers, even of one policy, are independent.
//!
//! Under an operating system with virtual memory, put image and workspace where pages are large (on Linux: aligned to 2 MiB, with
//! `madvise(MADV_HUGEPAGE)`), and lock them. At a robot's pace the caches are cold, and walks through page tables show.
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

mod handle;
mod layout;
mod memory;
#[cfg(all(feature = "static-library", not(test)))]
mod panic;
mod status;
mod types;

use core::ffi::{c_char, c_void};
use core::ops::Range;

use lads_core::{Contract, Decision, Element, Instruction, Intervention, Policy, Tick};

use crate::handle::Handle;
use crate::memory::{addresses, apart, check, get, give, read, zeroed};

pub use layout::{LADS_STACK_BYTES, LADS_WORKSPACE_ALIGN};
pub use status::Status;
pub use types::*;

/// Version of this interface; it grows when a program compiled for an older header would no longer work.
pub const LADS_ABI_VERSION: u32 = 1;

/// `LADS_ABI_VERSION` of the archive: compare it with the header's.
#[unsafe(no_mangle)]
pub extern "C" fn lads_abi_version() -> u32 {
    LADS_ABI_VERSION
}

/// What `lads_workspace_bytes` says about a policy, for tools written in Rust.
pub fn workspace_bytes(policy: &Policy) -> usize {
    handle::layout(policy).map_or(0, |layout| layout.total)
}

/// Turns a result into the number that C gets.
fn status(result: Result<(), Status>) -> Status {
    result.err().unwrap_or(Status::Ok)
}

/// One line in English for a status; never null. The text is static and ends with a zero.
#[unsafe(no_mangle)]
pub extern "C" fn lads_status_text(status: i32) -> *const c_char {
    let known = Status::ALL
        .iter()
        .find(|(known, _)| *known as i32 == status);
    known.map_or(c"unknown status", |(_, text)| text).as_ptr()
}

/// Opens a program image: checks all of it, its checksum included, and copies nothing. The image is aligned to 4 bytes (64 is
/// better); bytes behind its own length are ignored. After a failure `policy` holds no policy.
///
/// # Safety
/// `image` points to `image_bytes` readable bytes that do not change as long as the policy or a controller of it is used;
/// `policy` may be written, and stays where it is.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_open(
    image: *const u8,
    image_bytes: usize,
    policy: *mut LadsPolicy,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe { handle::open(image, image_bytes, policy) })
}

/// Tells what a policy expects and promises. The texts live as long as the image.
///
/// # Safety
/// `policy` is null or a `lads_policy`, zeroed or opened; `contract` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_contract(
    policy: *const LadsPolicy,
    contract: *mut LadsContract,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe { handle::policy(policy).and_then(|p| give(contract, LadsContract::of(p))) })
}

/// Tells about the element that `find` finds in the contract.
///
/// # Safety
/// As `lads_policy_contract`.
unsafe fn tell(
    policy: *const LadsPolicy,
    element: *mut LadsElement,
    find: impl FnOnce(Contract<'static>) -> Option<Element<'static>>,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe {
        handle::policy(policy).and_then(|policy| {
            let found = find(policy.contract()).ok_or(Status::NoElement)?;
            give(element, LadsElement::new(&found))
        })
    })
}

/// Tells about element `index` of an observation: name, unit, joint, limits.
///
/// # Safety
/// As `lads_policy_contract`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_observation(
    policy: *const LadsPolicy,
    index: usize,
    element: *mut LadsElement,
) -> Status {
    // SAFETY: the caller guarantees both.
    unsafe {
        tell(policy, element, |contract| {
            contract.observations().nth(index)
        })
    }
}

/// Tells about element `index` of an action: name, unit, joint, limits.
///
/// # Safety
/// As `lads_policy_contract`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_action(
    policy: *const LadsPolicy,
    index: usize,
    element: *mut LadsElement,
) -> Status {
    // SAFETY: the caller guarantees both.
    unsafe { tell(policy, element, |contract| contract.actions().nth(index)) }
}

/// Tells about an instruction that the policy knows, by its number.
///
/// # Safety
/// As `lads_policy_contract`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_instruction(
    policy: *const LadsPolicy,
    number: u32,
    instruction: *mut LadsInstruction,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe {
        handle::policy(policy).and_then(|policy| {
            let contract = policy.contract();
            let found = contract.instruction(number as usize);
            let found = found.ok_or(Status::UnknownInstruction)?;
            give(
                instruction,
                LadsInstruction::new(&found, contract.word_dim()),
            )
        })
    })
}

/// Finds the number of an instruction by its id or its text, byte for byte.
///
/// # Safety
/// As `lads_policy_contract`; `name` points to `name_len` bytes, no zero needed; `number` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_find_instruction(
    policy: *const LadsPolicy,
    name: *const c_char,
    name_len: usize,
    number: *mut u32,
) -> Status {
    // SAFETY: the caller guarantees all three.
    status(unsafe {
        handle::policy(policy).and_then(|policy| {
            let name = read(name.cast::<u8>(), name_len)?;
            let mut all = policy.contract().instructions();
            // Byte by byte: comparing slices would call `bcmp`, which not every C library has.
            let is_it = |text: &str| text.bytes().eq(name.iter().copied());
            let found = all.position(|known| is_it(known.id) || is_it(known.text));
            let found = found.ok_or(Status::UnknownInstruction)?;
            give(number, found as u32)
        })
    })
}

/// Bytes of workspace for one controller of a policy; 0 when the policy was not opened.
///
/// # Safety
/// `policy` is null or a `lads_policy`, zeroed or opened.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_workspace_bytes(policy: *const LadsPolicy) -> usize {
    // SAFETY: the caller guarantees it.
    unsafe { handle::policy(policy) }.map_or(0, workspace_bytes)
}

/// Sets up a controller with its guard in `workspace`, aligned to `LADS_WORKSPACE_ALIGN`, which need not be initialised.
/// `options` may be null; so may `controller`, the handle for the other functions, which is the address of the workspace. It is
/// not armed unless `LADS_ARM_WITHOUT_SELF_TEST` is set. To end it, stop using it: nothing has to be undone.
///
/// # Safety
/// `policy` is null or a `lads_policy`, zeroed or opened; `workspace` points to `workspace_bytes` writable bytes that nobody
/// else uses or moves as long as the controller is used; lists in the options are as long as an action; `controller` is null or
/// may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_controller_init(
    policy: *const LadsPolicy,
    workspace: *mut c_void,
    workspace_bytes: usize,
    options: *const LadsOptions,
    controller: *mut *mut LadsController,
) -> Status {
    if !controller.is_aligned() {
        return Status::Misaligned;
    }
    // SAFETY: the caller guarantees all of it.
    status(unsafe {
        handle::set_up(policy, workspace, workspace_bytes, options).and_then(|made| {
            if controller.is_null() {
                return Ok(());
            }
            give(controller, made)
        })
    })
}

/// Replays the recorded episode, compares plans and actions, and arms the controller if it passes, disarms it if not. Afterwards
/// there is no instruction. `result`, which may be null, gets what a test that passed has measured.
///
/// # Safety
/// `controller` is null or a workspace, zeroed or set up by `lads_controller_init`, and no other call uses it now;
/// `result` is null or may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_self_test(
    controller: *mut LadsController,
    result: *mut LadsSelfTest,
) -> Status {
    if !result.is_aligned() {
        return Status::Misaligned;
    }
    // SAFETY: the caller guarantees both.
    status(unsafe {
        handle::handle(controller).and_then(|handle| {
            let passed = handle.guarded.self_test()?;
            if result.is_null() {
                return Ok(());
            }
            give(result, passed.into())
        })
    })
}

/// Follows a known instruction, by its number, from the next step on: a new episode. `LADS_STATUS_INSTRUCT_FAILED`, which a sound image
/// never causes, leaves the controller without an instruction.
///
/// # Safety
/// As `lads_self_test`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_instruction(
    controller: *mut LadsController,
    number: u32,
) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.and_then(|handle| {
        handle.guarded.set_instruction(Instruction::Id(number))?;
        Ok(())
    }))
}

/// Follows an instruction given as word embeddings, `len = n * word_dim` elements, as `lads_set_instruction` does.
///
/// # Safety
/// As `lads_self_test`; `words` points to `len` readable elements outside the workspace.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_words(
    controller: *mut LadsController,
    words: *const f32,
    len: usize,
) -> Status {
    // SAFETY: the caller guarantees the controller and the words.
    status(unsafe {
        handle::handle(controller).and_then(|handle| {
            if !apart(&handle.addresses(), &addresses(words, len)) {
                return Err(Status::Overlap);
            }
            let words = read(words, len)?;
            handle.guarded.set_instruction(Instruction::Words(words))?;
            Ok(())
        })
    })
}

/// Picks plans by argmax (`temperature` not above 0) or at random with the softmax of the logits over the temperature.
///
/// # Safety
/// As `lads_self_test`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_decision(
    controller: *mut LadsController,
    temperature: f32,
    seed: u64,
) -> Status {
    let rule = if temperature > 0.0 {
        Decision::Sample { temperature, seed }
    } else {
        Decision::Argmax
    };
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.set_decision(rule)))
}

/// One control period: writes an action that is finite and inside limits and rates, whatever the observation is. `LADS_STATUS_OK` says
/// that it is the policy's; any other status why it is the fallback's. A null `observation` says that there is none. `tick` may
/// be null, then nothing is stale or late; so may `report`.
///
/// Only when the call itself is wrong, nothing happens and nothing is written: `controller` not set up, `action` of another
/// length than the contract's, null or overlapping the workspace, `tick` or `report` misaligned.
///
/// # Safety
/// As `lads_self_test`; `observation` and `action` point to as many elements as they say; `tick` and `report` are null or may
/// be read and written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_step(
    controller: *mut LadsController,
    observation: *const f32,
    observation_len: usize,
    tick: *const LadsTick,
    action: *mut f32,
    action_len: usize,
    report: *mut LadsReport,
) -> Status {
    // SAFETY: the caller guarantees the controller.
    let handle = match unsafe { handle::handle(controller) } {
        Ok(handle) => handle,
        Err(status) => return status,
    };
    let output = addresses(action, action_len);
    if !apart(&handle.addresses(), &output) {
        return Status::Overlap;
    }
    if !tick.is_aligned() || !report.is_aligned() {
        return Status::Misaligned;
    }
    if let Err(status) = check(action, action_len) {
        return status;
    }
    if action_len != handle.guarded.controller().policy().contract().action_len() {
        return Status::ActionLength;
    }
    // SAFETY: the caller guarantees all three.
    let (input, tick, action) = unsafe {
        (
            input(handle, &output, observation, observation_len),
            get(tick).ok(),
            zeroed(action, action_len).unwrap_or_default(),
        )
    };
    let tick = tick.map(|&LadsTick { timestamp, missed }| Tick { timestamp, missed });
    let made = match input {
        Ok(observation) => handle.guarded.step(observation, tick, action),
        Err(_) => handle.guarded.step_blind(action),
    };
    let Ok(made) = made else {
        return Status::ActionLength;
    };
    let why = match (made.intervention, input) {
        (None, _) => Status::Ok,
        (Some(Intervention::NoObservation), Err(wrong)) => wrong,
        (Some(intervention), _) => intervention.into(),
    };
    if !report.is_null() {
        // SAFETY: not null and aligned; the caller guarantees that it may be written.
        unsafe { report.write(LadsReport::new(why, &made)) };
    }
    why
}

/// The observation of a step, or why there is none.
///
/// # Safety
/// As [`lads_step`].
unsafe fn input<'a>(
    handle: &Handle,
    output: &Range<usize>,
    observation: *const f32,
    len: usize,
) -> Result<&'a [f32], Status> {
    if observation.is_null() {
        return Err(Status::NoObservation);
    }
    let used = addresses(observation, len);
    if !apart(&used, output) || !apart(&used, &handle.addresses()) {
        return Err(Status::Overlap);
    }
    // SAFETY: the caller guarantees the observation.
    unsafe { read(observation, len) }
}

/// Tells what was really executed since the last step, where that is not the action that `lads_step` wrote; the next step
/// continues from there.
///
/// # Safety
/// As `lads_self_test`; `action` points to `action_len` readable elements outside the workspace.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_executed(
    controller: *mut LadsController,
    action: *const f32,
    action_len: usize,
) -> Status {
    // SAFETY: the caller guarantees the controller and the action.
    status(unsafe {
        handle::handle(controller).and_then(|handle| {
            if !apart(&handle.addresses(), &addresses(action, action_len)) {
                return Err(Status::Overlap);
            }
            handle.guarded.executed(read(action, action_len)?)?;
            Ok(())
        })
    })
}

/// Starts a new episode with the same instruction. A stop stays a stop.
///
/// # Safety
/// As `lads_self_test`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_reset(controller: *mut LadsController) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.reset()))
}

/// Brings code, weights and KV cache into the processor's caches, so that the next step is as fast as the ones after it: for right
/// before the first step, or after a pause. Costs about two control steps and changes nothing.
///
/// # Safety
/// As `lads_self_test`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_warm(controller: *mut LadsController) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.warm()))
}

/// Stops as `LADS_FALLBACK_STOP` does, from the next step on.
///
/// # Safety
/// As `lads_self_test`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_stop(controller: *mut LadsController) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.stop()))
}

/// Ends a stop. The episode goes on where it was; `lads_reset` starts a new one.
///
/// # Safety
/// As `lads_self_test`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_resume(controller: *mut LadsController) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.resume()))
}

/// Tells what the guard has done since the controller was set up.
///
/// # Safety
/// As `lads_self_test`; `counters` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_counters(
    controller: *mut LadsController,
    counters: *mut LadsCounters,
) -> Status {
    // SAFETY: the caller guarantees both.
    status(unsafe {
        handle::handle(controller)
            .and_then(|handle| give(counters, handle.guarded.counters().into()))
    })
}
