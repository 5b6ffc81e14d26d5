//! Sets a controller up, tests it, and replaces a running one by another.

use core::ffi::c_void;

use super::{report_area, status, told};
use crate::handle::{self, Setup};
use crate::memory::{Area, apart, apart_from};
use crate::status::Status;
use crate::types::{LadsController, LadsOptions, LadsPolicy, LadsReport, LadsSelfTest, Refusal};
use crate::versioned;

/// Returns the number of bytes of workspace for one controller of a policy; 0 if the policy was not
/// opened.
///
/// # Safety
/// `policy` is null or a `lads_policy`, zeroed or opened.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_workspace_bytes(policy: *const LadsPolicy) -> usize {
    // SAFETY: the caller guarantees it.
    unsafe { handle::policy(policy) }.map_or(0, crate::workspace_bytes)
}

/// Sets up a controller with its guard in `workspace`, aligned to `LADS_WORKSPACE_ALIGN`, which
/// need not be initialised. `options` may be null; so may `controller`, the handle for the other
/// functions, which is the address of the workspace; so may `report`, which names the element of
/// the action whose limits, rate or safe action were refused. The controller is not armed unless
/// `LADS_ARM_WITHOUT_SELF_TEST` is set. A refusal leaves the workspace untouched: a controller that
/// runs there continues. To end a controller, stop using it: nothing has to be undone.
///
/// # Safety
/// `policy` is null or a `lads_policy`, zeroed or opened; `workspace` points to `workspace_bytes` writable bytes that nobody
/// else uses or moves as long as the controller is used; lists in the options are as long as an action; `controller` is null or
/// may be written; `report` is null or may be read and written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_controller_init(
    policy: *const LadsPolicy,
    workspace: *mut c_void,
    workspace_bytes: usize,
    options: *const LadsOptions,
    controller: *mut *mut LadsController,
    report: *mut LadsReport,
) -> Status {
    if !controller.is_aligned() {
        return Status::Misaligned;
    }
    let made = Area::written(controller, 1);
    let used = [
        made,
        Area::written(workspace.cast::<u8>(), workspace_bytes),
        Area::read(policy, 1),
    ];
    // SAFETY: the caller guarantees all of it.
    let reported = match unsafe { report_area(report, &used) } {
        Ok(area) => area,
        Err(status) => return status,
    };
    let setup = Setup {
        policy,
        workspace,
        workspace_bytes,
        options,
    };
    // SAFETY: as above.
    let result = unsafe { handle::set_up(setup, &[made, reported]) }.map(|handle| {
        if !controller.is_null() {
            // SAFETY: not null and aligned; the caller guarantees that it may be written.
            unsafe { controller.write(handle) };
        }
    });
    if result.is_err_and(|refusal| refusal.status == Status::Overlap) {
        // What the report lies over is not to be written.
        return Status::Overlap;
    }
    // SAFETY: as above.
    unsafe { told(result, report) }
}

/// Replays the recorded episode, compares indices and actions, and arms the controller if it
/// passes, disarms it if not. Afterwards there is no instruction. `result`, which may be null, gets
/// the test's measurements, or the place of its failure.
///
/// # Safety
/// `controller` is null or a workspace, zeroed or set up by `lads_controller_init`, and no other call uses it now;
/// `result` is null or may be read and written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_self_test(
    controller: *mut LadsController,
    result: *mut LadsSelfTest,
) -> Status {
    // SAFETY: the caller guarantees both.
    let handle = match unsafe { handle::handle(controller) } {
        Ok(handle) => handle,
        Err(status) => return status,
    };
    // SAFETY: as above.
    let area = unsafe { versioned::write_area(result) };
    if let Err(status) = area.and_then(|area| apart_from(&area, &handle.areas())) {
        return status;
    }
    let outcome = handle.guarded.self_test();
    if !result.is_null() {
        let measured = match outcome {
            Ok(passed) => passed.into(),
            Err(failed) => LadsSelfTest::from(failed),
        };
        // SAFETY: as above. The size was looked at before.
        let _ = unsafe { versioned::write(result, &measured) };
    }
    outcome.map_or_else(Status::from, |_| Status::Ok)
}

/// Replaces the running policy by another one, between two steps. `next` is a controller that was
/// set up in a workspace of its own, tested and given its instruction, which another thread may
/// have done while `controller` ran.
///
/// Afterwards `next` is the one to step: it continues with the limits, rates, fallback, counters
/// and clock of `controller`, whose options stay in force, and its first action is no further from
/// the last executed one than the rate allows. It is armed if both were. `controller` is ended, and
/// its workspace is yours again, for the policy after that.
///
/// If the swap is refused, neither controller changes. The reasons are another control period
/// (`LADS_STATUS_SWAP_CONTROL_PERIOD`), a channel that differs, which the report names
/// (`LADS_STATUS_SWAP_CHANNELS`), no instruction where `controller` has one
/// (`LADS_STATUS_SWAP_INSTRUCTION`). `report` may be null.
///
/// # Safety
/// The conditions of `lads_self_test` hold for both controllers; `report` is null or may be read and written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_swap(
    controller: *mut LadsController,
    next: *mut LadsController,
    report: *mut LadsReport,
) -> Status {
    if controller == next && !controller.is_null() {
        return Status::Overlap;
    }
    // SAFETY: the caller guarantees both, and they are not the same.
    let handles = unsafe {
        handle::handle(controller)
            .and_then(|running| handle::handle(next).map(|next| (running, next)))
    };
    let (running, next) = match handles {
        Ok(handles) => handles,
        Err(status) => return status,
    };
    let ([old, old_image], [new, new_image]) = (running.areas(), next.areas());
    // SAFETY: as above.
    if let Err(status) = unsafe { report_area(report, &[old, old_image, new, new_image]) } {
        return status;
    }
    if let Err(status) = apart(&[old, new]) {
        return status;
    }
    let result = next.guarded.take_over(&running.guarded);
    if result.is_ok() {
        running.end();
    }
    // SAFETY: as above.
    unsafe { told(result.map_err(Refusal::from), report) }
}

/// Starts a new episode with the same instruction; timestamps may start anew. A stop stays a stop.
///
/// # Safety
/// The conditions of `lads_self_test` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_reset(controller: *mut LadsController) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.reset()))
}

/// Brings code, weights and KV caches into the processor's caches, so that the next step is as fast
/// as the ones after it; call it right before the first step, or after a pause. It costs two to
/// three control steps and changes nothing.
///
/// # Safety
/// The conditions of `lads_self_test` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_warm(controller: *mut LadsController) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.warm()))
}
