//! The functions of the interface.
//!
//! Each checks all its pointers before it does anything: that they are what they can be, and that what is written overlaps nothing
//! ([`apart`](crate::memory::apart)).

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

/// Turns a result into the number that C gets.
fn status(result: Result<(), Status>) -> Status {
    result.err().unwrap_or(Status::Ok)
}

/// The area of a report that may be null, apart from what else the call uses.
///
/// # Safety
/// `report` is null or may be read and written.
unsafe fn report_area(report: *mut LadsReport, others: &[Area]) -> Result<Area, Status> {
    // SAFETY: the caller guarantees it.
    let area = unsafe { versioned::write_area(report) }?;
    apart_from(&area, others)?;
    Ok(area)
}

/// Writes what came of a call into a report that may be null and that [`report_area`] has approved of, and returns its number.
///
/// # Safety
/// As [`report_area`].
unsafe fn told(result: Result<(), Refusal>, report: *mut LadsReport) -> Status {
    let refusal = result.err().unwrap_or(Status::Ok.into());
    if !report.is_null() {
        // SAFETY: the caller guarantees it. The size was looked at before.
        let _ = unsafe { versioned::write(report, &LadsReport::from(&refusal)) };
    }
    refusal.status
}
