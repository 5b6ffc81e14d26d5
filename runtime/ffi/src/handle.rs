//! What lies in the caller's memory: an open policy, and a controller at the start of its workspace.
//!
//! Each begins with a seal that depends on its address, so that memory that was never set up, or was copied elsewhere, is refused
//! instead of used.

use core::ffi::c_void;
use core::ops::Range;
use core::ptr;

use lads_core::{
    Controller, Fallback, GuardConfig, GuardedController, Isa, Limits, Policy, Workspace,
};

use crate::layout::{LADS_WORKSPACE_ALIGN, Layout, at};
use crate::memory::{addresses, apart, check, get, read, read_optional, zeroed};
use crate::status::Status;
use crate::types::{
    LADS_ARM_WITHOUT_SELF_TEST, LADS_FALLBACK_DECAY, LADS_FALLBACK_HOLD, LADS_FALLBACK_STOP,
    LADS_PORTABLE_INSTRUCTIONS, LadsController, LadsOptions, LadsPolicy,
};

/// A policy in a [`LadsPolicy`]. It borrows the image for as long as it is used, which C promises and Rust calls `'static`.
#[repr(C)]
struct Opened {
    seal: usize,
    policy: Policy<'static>,
}

/// A controller at the start of its workspace.
#[repr(C)]
pub struct Handle {
    seal: usize,
    workspace_bytes: usize,
    pub guarded: GuardedController<'static, 'static>,
}

const _: () = assert!(size_of::<Opened>() <= size_of::<LadsPolicy>());
const _: () = assert!(align_of::<Opened>() <= align_of::<LadsPolicy>());
const _: () = assert!(align_of::<Handle>() <= LADS_WORKSPACE_ALIGN);

/// `lads-core` in ASCII, as far as it fits, combined with an address.
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
    to: *mut LadsPolicy,
) -> Result<(), Status> {
    check(to, 1)?;
    let to = to.cast::<Opened>();
    // SAFETY: not null and aligned (`Opened` asks for no more than `LadsPolicy`, see above); the caller guarantees the memory.
    unsafe { (&raw mut (*to).seal).write(0) };
    if image.is_null() {
        return Err(Status::Null);
    }
    // SAFETY: the caller guarantees the image.
    let policy = Policy::new_checked(unsafe { read(image, image_bytes) }?)?;
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

/// The policy in the caller's memory.
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

/// How the workspace of a policy is divided.
pub fn layout(policy: &Policy) -> Result<Layout, Status> {
    Layout::of(policy, size_of::<Handle>()).ok_or(Status::TooLong)
}

/// Sets a controller up in a workspace.
///
/// # Safety
/// `workspace` points to `bytes` writable bytes that nobody else uses as long as the controller is used; `options` is null or
/// points to options whose lists have as many elements as an action; [`policy`]'s condition holds for `policy`.
pub unsafe fn set_up(
    policy_at: *const LadsPolicy,
    workspace: *mut c_void,
    bytes: usize,
    options: *const LadsOptions,
) -> Result<*mut LadsController, Status> {
    // SAFETY: the caller guarantees the policy.
    let policy = unsafe { policy(policy_at) }?;
    if workspace.is_null() {
        return Err(Status::Null);
    }
    if !workspace.addr().is_multiple_of(LADS_WORKSPACE_ALIGN) {
        return Err(Status::Misaligned);
    }
    check(workspace.cast::<u8>(), bytes)?;
    let layout = layout(policy)?;
    if bytes < layout.total {
        return Err(Status::WorkspaceTooSmall);
    }
    let used = addresses(workspace.cast::<u8>(), layout.total);
    let image = addresses(policy.image().as_ptr(), policy.image_bytes());
    if !apart(&used, &image) || !apart(&used, &addresses(policy_at, 1)) {
        return Err(Status::Overlap);
    }
    let default = LadsOptions::default();
    let options = if options.is_null() {
        &default
    } else {
        // SAFETY: the caller guarantees the options.
        unsafe { get(options) }?
    };
    // SAFETY: the caller guarantees the lists.
    let config = unsafe { config(options, policy) }?;
    let isa = if options.flags & LADS_PORTABLE_INSTRUCTIONS == 0 {
        Isa::detect()
    } else {
        Isa::portable()
    };
    let handle = workspace.cast::<Handle>();
    // SAFETY: aligned and large enough, as checked above; the caller guarantees the memory. The parts do not overlap, by the
    // layout.
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
    let mut guarded = GuardedController::new(controller, &config, guard)?;
    if options.flags & LADS_ARM_WITHOUT_SELF_TEST != 0 {
        guarded.arm_untested();
    }
    let made = Handle {
        seal: seal(handle.addr()),
        workspace_bytes: layout.total,
        guarded,
    };
    // SAFETY: as above; the arena and the others lie behind the handle.
    unsafe { handle.write(made) };
    Ok(handle.cast())
}

/// # Safety
/// The lists of the options are null or have as many elements as an action.
unsafe fn config<'a>(options: &LadsOptions, policy: &Policy) -> Result<GuardConfig<'a>, Status> {
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
    let len = policy.contract().action_len();
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
        stop_after: options.stop_after,
        limits,
    })
}

/// The controller behind a pointer.
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
    /// The addresses of the whole workspace.
    pub fn addresses(&self) -> Range<usize> {
        addresses(ptr::from_ref(self).cast::<u8>(), self.workspace_bytes)
    }
}
