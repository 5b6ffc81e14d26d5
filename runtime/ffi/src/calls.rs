//! Functions of the C interface.
//!
//! Each function first checks all its pointers: that they are plausible, and that written memory
//! overlaps nothing ([`apart`](crate::memory::apart)).

// In the order in which they are called, which is the header's.
pub mod describe;

pub mod setup;

pub mod instruct;

pub mod step;

pub mod control;

use crate::memory::{Area, apart_from};
use crate::status::Status;
use crate::types::{LadsReport, Refusal};
use crate::versioned;

/// Converts a result to the number that C gets.
fn status(result: Result<(), Status>) -> Status {
    result.err().unwrap_or(Status::Ok)
}

/// Returns the area of a report that may be null, apart from all other areas that the call uses.
///
/// # Safety
/// `report` is null or may be read and written.
unsafe fn report_area(report: *mut LadsReport, others: &[Area]) -> Result<Area, Status> {
    // SAFETY: the caller guarantees it.
    let area = unsafe { versioned::write_area(report) }?;
    apart_from(&area, others)?;
    Ok(area)
}

/// Writes the result of a call into a report that may be null and that [`report_area`] has approved
/// of, and returns its number.
///
/// # Safety
/// The conditions of [`report_area`] hold.
unsafe fn told(result: Result<(), Refusal>, report: *mut LadsReport) -> Status {
    let refusal = result.err().unwrap_or(Status::Ok.into());
    if !report.is_null() {
        // SAFETY: the caller guarantees it. The size was looked at before.
        let _ = unsafe { versioned::write(report, &LadsReport::from(&refusal)) };
    }
    refusal.status
}
