//! Calls around the steps: the executed action, stop and resume, and the counters.

use super::{report_area, status, told};
use crate::handle;
use crate::memory::{Area, apart, apart_from, read};
use crate::status::Status;
use crate::types::{LadsController, LadsCounters, LadsReport, Refusal};
use crate::versioned;

/// Tells which action was executed since the last step, if it is not the one that `lads_step`
/// wrote; the next step continues from there. `report`, which may be null, names the element that
/// was refused.
///
/// # Safety
/// The conditions of `lads_self_test` hold; `action` points to `action_len` readable elements; `report` is null or may be read and written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_executed(
    controller: *mut LadsController,
    action: *const f32,
    action_len: usize,
    report: *mut LadsReport,
) -> Status {
    // SAFETY: the caller guarantees all three.
    let handle = match unsafe { handle::handle(controller) } {
        Ok(handle) => handle,
        Err(status) => return status,
    };
    let [workspace, image] = handle.areas();
    let given = Area::read(action, action_len);
    // SAFETY: as above.
    if let Err(status) = unsafe { report_area(report, &[workspace, image, given]) } {
        return status;
    }
    let mut executed = || -> Result<(), Refusal> {
        apart(&[workspace, given])?;
        // SAFETY: as above.
        let action = unsafe { read(action, action_len) }?;
        handle.guarded.executed(action)?;
        Ok(())
    };
    let result = executed();
    // SAFETY: as above.
    unsafe { told(result, report) }
}

/// Stops the controller as `LADS_FALLBACK_STOP` does, from the next step on.
///
/// # Safety
/// The conditions of `lads_self_test` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_stop(controller: *mut LadsController) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.stop()))
}

/// Ends a stop. The episode continues where it was; `lads_reset` starts a new one.
///
/// # Safety
/// The conditions of `lads_self_test` hold.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_resume(controller: *mut LadsController) -> Status {
    // SAFETY: the caller guarantees the controller.
    status(unsafe { handle::handle(controller) }.map(|handle| handle.guarded.resume()))
}

/// Writes the counts of the guard's actions and interventions since the controller was set up.
///
/// # Safety
/// The conditions of `lads_self_test` hold; `counters` may be read and written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lads_counters(
    controller: *mut LadsController,
    counters: *mut LadsCounters,
) -> Status {
    if counters.is_null() {
        return Status::Null;
    }
    // SAFETY: the caller guarantees both.
    status(unsafe {
        handle::handle(controller).and_then(|handle| {
            apart_from(&versioned::write_area(counters)?, &handle.areas())?;
            versioned::write(counters, &handle.guarded.counters().into())
        })
    })
}
