//! The C boundary of the runtime: open a program image, build a controller in memory that the caller owns, step it.
//!
//! ```c
//! struct lads_policy_info info;
//! lads_policy_open(image, image_bytes, &info);                 // 0, or lads_status_text(status)
//! void  *memory = aligned_alloc(LADS_CONTROLLER_ALIGN, lads_controller_bytes());   // or static arrays
//! float *arena  = malloc(info.arena_len * sizeof(float));
//! float *state  = malloc(info.state_len * sizeof(float));
//! lads_controller_init(memory, lads_controller_bytes(), &(struct lads_areas){ image, image_bytes, arena, info.arena_len, state, info.state_len });
//! lads_self_test(memory, NULL);
//! lads_set_instruction(memory, 3);
//! for (;;) lads_step(memory, observation, info.observation_len, action, info.action_len, &report);
//! ```
//!
//! Rules for every function:
//! - It returns a [`Status`], an `int32_t`; anything but 0 means that nothing has changed (what [`lads_set_instruction`] and
//!   [`lads_self_test`] say differently apart).
//! - It allocates nothing, never blocks, never unwinds. Null and misaligned pointers are refused.
//! - It cannot check that a pointer is that of the memory it claims to be; that is the caller's part, and each function's
//!   safety section says which.
//! - One controller is used by one thread at a time; different controllers, even of one image, are independent.
//!
//! As a static library for a C program (`lads_panic` comes from that program, see `panic.rs`):
//! `cargo rustc -p lads-ffi --release --features static-library --crate-type staticlib -- -C panic=abort`
#![no_std]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic
    )
)]

mod memory;
#[cfg(all(feature = "static-library", not(test)))]
mod panic;
mod status;

use core::ffi::{c_char, c_void};
use core::ptr;

use lads_core::{Controller, Decision, Instruction, Policy, Workspace};

pub use status::Status;

/// Alignment of the memory for a controller, in bytes.
pub const LADS_CONTROLLER_ALIGN: usize = 16;

const _: () = assert!(align_of::<Handle>() <= LADS_CONTROLLER_ALIGN);

/// What lies in the memory of a controller. It borrows the image, the arena and the state for as long as it is used, which C
/// promises and Rust calls `'static`.
type Handle = Controller<'static, 'static>;

/// Sizes of a policy and of the memory that it needs.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
pub struct PolicyInfo {
    /// Elements of scratch memory (`float`).
    pub arena_len: usize,
    /// Elements of memory that survives a step (`float`).
    pub state_len: usize,
    /// Elements of an observation.
    pub observation_len: usize,
    /// Elements of an action.
    pub action_len: usize,
    /// Control steps from one decision to the next.
    pub horizon: usize,
    /// Entries of the codebook.
    pub codebook_len: usize,
    /// The most words of an instruction.
    pub words_len: usize,
    /// Elements of a word embedding.
    pub word_dim: usize,
    /// Instructions that the policy knows by number.
    pub instruction_count: usize,
    /// Control steps that a context holds.
    pub context_steps: usize,
    /// Time from one control step to the next, in seconds.
    pub control_period_s: f32,
}

/// The memory that a controller uses as long as it exists.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Areas {
    /// Program image, aligned to 4 bytes (64 is better).
    pub image: *const u8,
    /// Bytes of the image.
    pub image_bytes: usize,
    /// [`PolicyInfo::arena_len`] elements.
    pub arena: *mut f32,
    /// Elements of the arena.
    pub arena_len: usize,
    /// [`PolicyInfo::state_len`] elements.
    pub state: *mut f32,
    /// Elements of the state.
    pub state_len: usize,
}

/// What happened in a control step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
pub struct Report {
    /// Control steps since the context began.
    pub timestep: u32,
    /// The plan in force: an index into the codebook.
    pub plan: u32,
    /// 1 when this step decided the plan, else 0.
    pub decided: u32,
    /// The largest logit of the last decision minus the second largest.
    pub margin: f32,
}

/// Turns a result into the number that C gets.
fn status(result: Result<(), Status>) -> Status {
    result.err().unwrap_or(Status::Ok)
}

/// One line in English for a status; never null. The text is static.
#[unsafe(no_mangle)]
pub extern "C" fn lads_status_text(status: i32) -> *const c_char {
    let known = Status::ALL.iter().find(|&&known| known as i32 == status);
    known
        .map_or(c"unknown status", |known| known.text())
        .as_ptr()
}

/// Bytes of memory for a controller, aligned to [`LADS_CONTROLLER_ALIGN`].
#[unsafe(no_mangle)]
pub extern "C" fn lads_controller_bytes() -> usize {
    size_of::<Handle>()
}

/// Checks an image, its checksum included, and tells the sizes of its policy.
///
/// # Safety
/// `image` points to `image_bytes` readable bytes; `info` to a `PolicyInfo` that may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_policy_open(
    image: *const u8,
    image_bytes: usize,
    info: *mut PolicyInfo,
) -> Status {
    // SAFETY: the caller guarantees the image.
    let policy = match unsafe { open(image, image_bytes) } {
        Ok(policy) if policy.checksum_matches() => policy,
        Ok(_) => return Status::ImageChecksum,
        Err(status) => return status,
    };
    let contract = policy.contract();
    let sizes = PolicyInfo {
        arena_len: policy.arena_len(),
        state_len: policy.state_len(),
        observation_len: contract.observation_len(),
        action_len: contract.action_len(),
        horizon: contract.horizon(),
        codebook_len: contract.codebook_len(),
        words_len: contract.words_len(),
        word_dim: contract.word_dim(),
        instruction_count: contract.instruction_count(),
        context_steps: contract.context_steps(),
        control_period_s: contract.control_period_s(),
    };
    // SAFETY: the caller guarantees that `info` may be written.
    status(unsafe { give(info, sizes) })
}

/// Builds a controller in `memory`, which then is the handle that the other functions take. The arena and the state need not be
/// initialised. Nothing has to be undone: to end the controller, stop using it.
///
/// # Safety
/// `memory` points to `memory_bytes` writable bytes and `areas` to areas that are what they say. From now on, as long as the
/// controller is used, the image does not change and nobody else uses the memory, the arena or the state.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_controller_init(
    memory: *mut c_void,
    memory_bytes: usize,
    areas: *const Areas,
) -> Status {
    // SAFETY: the caller guarantees all of it.
    status(unsafe { init(memory, memory_bytes, areas) })
}

/// Follows a known instruction, by its number, from the next step on: a new episode. [`Status::InstructFailed`], which a sound
/// image never causes, leaves the controller without an instruction.
///
/// # Safety
/// `controller` was set up by [`lads_controller_init`], and no other call uses it now.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_instruction(controller: *mut c_void, id: u32) -> Status {
    // SAFETY: the caller guarantees the controller.
    let handle = unsafe { handle(controller) };
    status(handle.and_then(|handle| {
        handle
            .set_instruction(Instruction::Id(id))
            .map_err(Status::from)
    }))
}

/// Follows an instruction given as word embeddings, `len = n * word_dim` elements.
///
/// # Safety
/// As [`lads_set_instruction`]; `words` points to `len` readable elements.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_words(
    controller: *mut c_void,
    words: *const f32,
    len: usize,
) -> Status {
    // SAFETY: the caller guarantees the controller and the words.
    let given = unsafe { (handle(controller), memory::read(words, len)) };
    status(match given {
        (Ok(handle), Ok(words)) => handle
            .set_instruction(Instruction::Words(words))
            .map_err(Status::from),
        (Err(status), _) | (_, Err(status)) => Err(status),
    })
}

/// Picks plans by argmax (`temperature` 0) or at random with the softmax of the logits over the temperature.
///
/// # Safety
/// As [`lads_set_instruction`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_set_decision(
    controller: *mut c_void,
    temperature: f32,
    seed: u64,
) -> Status {
    let rule = if temperature > 0.0 {
        Decision::Sample { temperature, seed }
    } else {
        Decision::Argmax
    };
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle(controller) }.map(|handle| handle.set_decision(rule)))
}

/// One control step: writes the action for an observation. `report` may be null.
///
/// # Safety
/// As [`lads_set_instruction`]; `observation` and `action` point to as many elements as they say, `action` to initialised ones
/// that may be written; they do not overlap each other, the arena or the state.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_step(
    controller: *mut c_void,
    observation: *const f32,
    observation_len: usize,
    action: *mut f32,
    action_len: usize,
    report: *mut Report,
) -> Status {
    let areas = [
        memory::addresses(observation, observation_len),
        memory::addresses(action, action_len),
    ];
    if !memory::disjoint(&areas) {
        return Status::Overlap;
    }
    // SAFETY: the caller guarantees the controller and both arrays.
    let given = unsafe {
        (
            handle(controller),
            memory::read(observation, observation_len),
            memory::write(action, action_len),
        )
    };
    let (handle, observation, action) = match given {
        (Ok(handle), Ok(observation), Ok(action)) => (handle, observation, action),
        (Err(status), ..) | (_, Err(status), _) | (.., Err(status)) => return status,
    };
    if !report.is_null() && !report.is_aligned() {
        return Status::Misaligned;
    }
    let made = match handle.step(observation, action) {
        Ok(made) => made,
        Err(error) => return error.into(),
    };
    if !report.is_null() {
        let made = Report {
            timestep: made.timestep,
            plan: made.plan.0,
            decided: u32::from(made.decided),
            margin: made.margin,
        };
        // SAFETY: not null and aligned; the caller guarantees that it may be written.
        unsafe { report.write(made) };
    }
    Status::Ok
}

/// Tells what was really executed since the last step, where that is not the action that [`lads_step`] wrote.
///
/// # Safety
/// As [`lads_set_instruction`]; `action` points to `action_len` readable elements.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_executed(
    controller: *mut c_void,
    action: *const f32,
    action_len: usize,
) -> Status {
    // SAFETY: the caller guarantees the controller and the action.
    let given = unsafe { (handle(controller), memory::read(action, action_len)) };
    status(match given {
        (Ok(handle), Ok(action)) => handle.executed(action).map_err(Status::from),
        (Err(status), _) | (_, Err(status)) => Err(status),
    })
}

/// Starts a new episode with the same instruction.
///
/// # Safety
/// As [`lads_set_instruction`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_reset(controller: *mut c_void) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle(controller) }.map(Handle::reset))
}

/// Replays the recorded episode and compares. Whatever the outcome, the controller is afterwards without an instruction.
/// `largest_error`, which may be null, gets the largest difference of an action element if the test passes.
///
/// # Safety
/// As [`lads_set_instruction`]; `largest_error` is null or may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_self_test(
    controller: *mut c_void,
    largest_error: *mut f32,
) -> Status {
    // SAFETY: the caller guarantees the controller.
    let handle = match unsafe { handle(controller) } {
        Ok(handle) => handle,
        Err(status) => return status,
    };
    let passed = match handle.self_test() {
        Ok(passed) => passed,
        Err(error) => return error.into(),
    };
    if largest_error.is_null() {
        return Status::Ok;
    }
    // SAFETY: the caller guarantees that a pointer that is not null may be written.
    status(unsafe { give(largest_error, passed.largest_error) })
}

/// # Safety
/// As [`lads_policy_open`], for as long as the policy is used.
unsafe fn open(image: *const u8, image_bytes: usize) -> Result<Policy<'static>, Status> {
    if image.is_null() {
        return Err(Status::Null);
    }
    // SAFETY: the caller guarantees the image.
    Ok(Policy::new_checked(unsafe {
        memory::read(image, image_bytes)
    }?)?)
}

/// # Safety
/// As [`lads_controller_init`].
unsafe fn init(
    memory: *mut c_void,
    memory_bytes: usize,
    areas: *const Areas,
) -> Result<(), Status> {
    if memory.is_null() {
        return Err(Status::Null);
    }
    if !memory.addr().is_multiple_of(LADS_CONTROLLER_ALIGN) {
        return Err(Status::Misaligned);
    }
    if memory_bytes < size_of::<Handle>() {
        return Err(Status::ControllerTooSmall);
    }
    // SAFETY: the caller guarantees the areas.
    let [areas] = unsafe { memory::read(areas, 1) }? else {
        return Err(Status::Null);
    };
    let used = [
        memory::addresses(memory.cast::<u8>(), size_of::<Handle>()),
        memory::addresses(areas.image, areas.image_bytes),
        memory::addresses(areas.arena, areas.arena_len),
        memory::addresses(areas.state, areas.state_len),
    ];
    if !memory::disjoint(&used) {
        return Err(Status::Overlap);
    }
    // SAFETY: the caller guarantees that the image stays as it is while the controller is used.
    let policy = unsafe { open(areas.image, areas.image_bytes) }?;
    if areas.arena_len < policy.arena_len() || areas.state_len < policy.state_len() {
        return Err(Status::WorkspaceTooSmall);
    }
    // SAFETY: the caller guarantees both; they do not overlap, as checked above.
    let (arena, state) = unsafe {
        (
            memory::zeroed(areas.arena, areas.arena_len)?,
            memory::zeroed(areas.state, areas.state_len)?,
        )
    };
    let workspace = Workspace::new(&policy, arena, state).map_err(|_| Status::WorkspaceTooSmall)?;
    let controller = Controller::new(policy, workspace);
    // SAFETY: not null, aligned and large enough, as checked above; the caller guarantees that it may be written.
    unsafe { memory.cast::<Handle>().write(controller) };
    Ok(())
}

/// The controller behind a pointer.
///
/// # Safety
/// `controller` is null or was set up by [`lads_controller_init`], and nobody else uses it during `'c`.
unsafe fn handle<'c>(controller: *mut c_void) -> Result<&'c mut Handle, Status> {
    if !controller.addr().is_multiple_of(LADS_CONTROLLER_ALIGN) {
        return Err(Status::Misaligned);
    }
    // SAFETY: aligned, and null becomes `None`; the rest is the caller's guarantee.
    unsafe { controller.cast::<Handle>().as_mut() }.ok_or(Status::Null)
}

/// Writes a result of the call.
///
/// # Safety
/// If the pointer is not null, a `T` may be written there.
unsafe fn give<T>(to: *mut T, value: T) -> Result<(), Status> {
    if to.is_null() {
        return Err(Status::Null);
    }
    if !to.is_aligned() {
        return Err(Status::Misaligned);
    }
    // SAFETY: not null and aligned; the caller guarantees that it may be written.
    unsafe { ptr::write(to, value) };
    Ok(())
}
