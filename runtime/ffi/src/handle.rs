//! Objects in the caller's memory: an open policy, and a controller at the start of its workspace.
//!
//! Each object begins with a seal that depends on its address, so that memory that was never set
//! up, or was copied elsewhere, is refused instead of used.

use core::ffi::c_void;
use core::ptr;

use lads_core::{
    Controller, Fallback, GuardConfig, GuardedController, Isa, Limits, Policy, Workspace,
};

use crate::layout::{LADS_WORKSPACE_ALIGN, Layout, at};
use crate::memory::{Area, apart, check, read, read_optional, zeroed};
use crate::status::Status;
use crate::types::{
    LADS_ARM_WITHOUT_SELF_TEST, LADS_FALLBACK_DECAY, LADS_FALLBACK_HOLD, LADS_FALLBACK_STOP,
    LADS_PORTABLE_INSTRUCTIONS, LadsController, LadsOptions, LadsPolicy, Refusal,
};
use crate::versioned;

/// An open policy inside a [`LadsPolicy`]. It borrows the image for as long as it is used, which C
/// promises and Rust calls `'static`.
#[repr(C)]
struct Opened {
    seal: usize,
    policy: Policy<'static>,
}

/// A controller with its guard, at the start of its workspace.
#[repr(C)]
pub struct Handle {
    seal: usize,
    workspace_bytes: usize,
    pub guarded: GuardedController<'static, 'static>,
}

const _: () = assert!(size_of::<Opened>() <= size_of::<LadsPolicy>());
const _: () = assert!(align_of::<Opened>() <= align_of::<LadsPolicy>());
const _: () = assert!(align_of::<Handle>() <= LADS_WORKSPACE_ALIGN);

/// Returns the seal of an address: `lads-core` in ASCII, as far as it fits, combined with the
/// address.
fn seal(address: usize) -> usize {
    (u64::from_le_bytes(*b"lads-cor") as usize) ^ address
}

/// Opens an image into the caller's memory. On failure the memory holds no policy.
///
/// # Safety
/// `image` points to `image_bytes` bytes that do not change as long as the policy is used; `to` may be written.
pub unsafe fn open(
    image: *const u8,
    image_bytes: usize,
    work_limit: u64,
    to: *mut LadsPolicy,
) -> Result<(), Status> {
    check(to, 1)?;
    apart(&[Area::read(image, image_bytes), Area::written(to, 1)])?;
    let to = to.cast::<Opened>();
    // SAFETY: not null and aligned (`Opened` asks for no more than `LadsPolicy`, see above); the caller guarantees the memory.
    unsafe { (&raw mut (*to).seal).write(0) };
    if image.is_null() {
        return Err(Status::Null);
    }
    // SAFETY: the caller guarantees the image.
    let policy = Policy::new_within(unsafe { read(image, image_bytes) }?, work_limit)?;
    if !policy.checksum_matches() {
        return Err(Status::ImageChecksum);
    }
    let opened = Opened {
        seal: seal(to.addr()),
        policy,
    };
    // SAFETY: as above.
    unsafe { to.write(opened) };
    Ok(())
}

/// Returns the policy in the caller's memory.
///
/// # Safety
/// If the pointer is not null, a `LadsPolicy` is there, and if [`open`] succeeded its image is still the same.
pub unsafe fn policy<'a>(from: *const LadsPolicy) -> Result<&'a Policy<'static>, Status> {
    check(from, 1)?;
    let from = from.cast::<Opened>();
    // SAFETY: not null and aligned; the caller guarantees the memory.
    if unsafe { (&raw const (*from).seal).read() } != seal(from.addr()) {
        return Err(Status::NotSetUp);
    }
    // SAFETY: the seal says that `open` has written it.
    Ok(unsafe { &(*from).policy })
}

/// Returns the areas of an open policy: itself, and its image.
pub fn areas_of(policy_at: *const LadsPolicy, policy: &Policy) -> [Area; 2] {
    let image = policy.image();
    [
        Area::read(policy_at, 1),
        Area::read(image.as_ptr(), image.len()),
    ]
}

/// Returns the layout of a policy's workspace.
pub fn layout(policy: &Policy) -> Result<Layout, Status> {
    Layout::of(policy, size_of::<Handle>()).ok_or(Status::TooLong)
}

/// Place and parameters of a controller to be set up.
#[derive(Clone, Copy)]
pub struct Setup {
    pub policy: *const LadsPolicy,
    pub workspace: *mut c_void,
    pub workspace_bytes: usize,
    pub options: *const LadsOptions,
}

/// Checked parameters of a controller to be set up.
struct Checked<'o> {
    policy: &'static Policy<'static>,
    layout: Layout,
    config: GuardConfig<'o>,
    flags: u32,
}

/// Sets a controller up in a workspace. The workspace is untouched until everything has been
/// checked; `others` are the other areas that the call writes.
///
/// # Safety
/// `workspace` points to `workspace_bytes` writable bytes that nobody else uses as long as the controller is used; `options` is null
/// or points to options whose lists have as many elements as an action; [`policy`]'s condition holds for `policy`.
pub unsafe fn set_up(setup: Setup, others: &[Area; 2]) -> Result<*mut LadsController, Refusal> {
    // SAFETY: the caller guarantees all of it.
    let Checked {
        policy,
        layout,
        config,
        flags,
    } = unsafe { checked(setup, others) }?;
    let action = policy.contract().action().id().0;
    config
        .check(policy.contract())
        .map_err(|error| Refusal::of_guard(error, action))?;
    let isa = if flags & LADS_PORTABLE_INSTRUCTIONS == 0 {
        Isa::detect()
    } else {
        Isa::portable()
    };
    let workspace = setup.workspace;
    let handle = workspace.cast::<Handle>();
    // SAFETY: aligned and large enough, as was checked; the caller guarantees the memory. The parts do not overlap, by the layout.
    let (arena, state, guard) = unsafe {
        (&raw mut (*handle).seal).write(0);
        (
            zeroed(at(workspace, layout.arena), policy.arena_len())?,
            zeroed(at(workspace, layout.state), policy.state_len())?,
            zeroed(
                at(workspace, layout.guard),
                GuardedController::memory_len(policy),
            )?,
        )
    };
    let parts = Workspace::new(policy, arena, state).map_err(|_| Status::WorkspaceTooSmall)?;
    let controller = Controller::with_isa(*policy, parts, isa);
    let mut guarded = GuardedController::new(controller, &config, guard)
        .map_err(|error| Refusal::of_guard(error, action))?;
    if flags & LADS_ARM_WITHOUT_SELF_TEST != 0 {
        guarded.arm_untested();
    }
    let made = Handle {
        seal: seal(handle.addr()),
        workspace_bytes: layout.total,
        guarded,
    };
    // SAFETY: as above; the arena and the other parts follow the handle.
    unsafe { handle.write(made) };
    Ok(handle.cast())
}

/// Checks pointers, sizes, options and areas.
///
/// # Safety
/// The conditions of [`set_up`] hold.
unsafe fn checked<'o>(setup: Setup, others: &[Area; 2]) -> Result<Checked<'o>, Status> {
    let Setup {
        policy: policy_at,
        workspace,
        workspace_bytes,
        options: options_at,
    } = setup;
    // SAFETY: the caller guarantees the policy.
    let policy = unsafe { policy(policy_at) }?;
    if workspace.is_null() {
        return Err(Status::Null);
    }
    if !workspace.addr().is_multiple_of(LADS_WORKSPACE_ALIGN) {
        return Err(Status::Misaligned);
    }
    check(workspace.cast::<u8>(), workspace_bytes)?;
    let layout = layout(policy)?;
    if workspace_bytes < layout.total {
        return Err(Status::WorkspaceTooSmall);
    }
    let mut options = LadsOptions::default();
    // SAFETY: the caller guarantees the options.
    let options_area = unsafe { versioned::read_area(options_at) }?;
    if !options_at.is_null() {
        // SAFETY: as above.
        options = unsafe { versioned::read(options_at) }?;
    }
    let len = policy.contract().action_len();
    let [policy_area, image] = areas_of(policy_at, policy);
    let [first, second] = *others;
    apart(&[
        Area::written(workspace.cast::<u8>(), layout.total),
        first,
        second,
        policy_area,
        image,
        options_area,
        Area::read(options.min, len),
        Area::read(options.max, len),
        Area::read(options.max_rate, len),
        Area::read(options.safe_action, len),
    ])?;
    Ok(Checked {
        policy,
        layout,
        // SAFETY: the caller guarantees the lists.
        config: unsafe { config(&options, len) }?,
        flags: options.flags,
    })
}

/// Converts options to the guard's configuration.
///
/// # Safety
/// The lists of the options are null or have `len` elements.
unsafe fn config<'o>(options: &LadsOptions, len: usize) -> Result<GuardConfig<'o>, Status> {
    if options.flags & !(LADS_ARM_WITHOUT_SELF_TEST | LADS_PORTABLE_INSTRUCTIONS) != 0 {
        return Err(Status::UnknownOption);
    }
    let fallback = match options.fallback {
        LADS_FALLBACK_STOP => Fallback::Stop,
        LADS_FALLBACK_HOLD => Fallback::Hold,
        LADS_FALLBACK_DECAY => Fallback::Decay {
            time_constant_s: options.decay_s,
        },
        _ => return Err(Status::UnknownOption),
    };
    // SAFETY: the caller guarantees the lists.
    let limits = unsafe {
        Limits {
            min: read_optional(options.min, len)?,
            max: read_optional(options.max, len)?,
            max_rate: read_optional(options.max_rate, len)?,
            safe_action: read_optional(options.safe_action, len)?,
        }
    };
    Ok(GuardConfig {
        fallback,
        late_after: options.late_after,
        coast: options.coast,
        max_jump: options.max_jump,
        stop_after: options.stop_after,
        limits,
    })
}

/// Returns the controller behind a pointer.
///
/// # Safety
/// The pointer is null or that of a workspace of at least [`LADS_WORKSPACE_ALIGN`] bytes, which nobody else uses during `'c`.
pub unsafe fn handle<'c>(controller: *mut LadsController) -> Result<&'c mut Handle, Status> {
    if controller.is_null() {
        return Err(Status::Null);
    }
    if !controller.addr().is_multiple_of(LADS_WORKSPACE_ALIGN) {
        return Err(Status::Misaligned);
    }
    let handle = controller.cast::<Handle>();
    // SAFETY: not null and aligned; the caller guarantees the memory.
    if unsafe { (&raw const (*handle).seal).read() } != seal(handle.addr()) {
        return Err(Status::NotSetUp);
    }
    // SAFETY: the seal says that `set_up` has written it; the caller guarantees that nobody else uses it.
    Ok(unsafe { &mut *handle })
}

impl Handle {
    /// Returns the areas that a controller uses: its workspace and the image.
    pub fn areas(&self) -> [Area; 2] {
        let image = self.guarded.controller().policy().image();
        let workspace = ptr::from_ref(self).cast_mut().cast::<u8>();
        [
            Area::written(workspace, self.workspace_bytes),
            Area::read(image.as_ptr(), image.len()),
        ]
    }

    /// Ends the controller: from now on its pointer is refused, and its workspace is the caller's again.
    pub fn end(&mut self) {
        self.seal = 0;
    }
}
