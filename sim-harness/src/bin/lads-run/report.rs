//! `--report`.

use std::path::Path;

use lads_core::Policy;
use lads_sim::results::Results;
use lads_sim::trace::Trace;

use crate::end::End;
#[cfg(feature = "report")]
use crate::end::{check_writable, unwritable};

/// Whether a report could be written, before any work.
#[cfg(feature = "report")]
pub fn check(path: Option<&Path>) -> Result<(), End> {
    check_writable("--report", path)
}

/// Refuses: this program was built without reports.
#[cfg(not(feature = "report"))]
pub fn check(path: Option<&Path>) -> Result<(), End> {
    match path {
        None => Ok(()),
        Some(_) => Err(crate::end::refused(
            "--report: this lads-run was built without reports; build it with \"cargo build --release -p lads-sim --features report\"",
        )),
    }
}

/// Writes the page.
#[cfg(feature = "report")]
pub fn write(
    results: &Results,
    traces: &[Trace],
    policy: &Policy<'_>,
    sub_tasks: &[&'static str],
    path: &Path,
) -> Result<(), End> {
    let report = lads_sim::report::Report {
        results,
        traces,
        contract: policy.contract(),
        sub_tasks,
    };
    let html = report.html();
    let html = html.map_err(|error| unwritable("--report", path, &error))?;
    lads_sim::output::write(html.as_bytes(), path)
        .map_err(|error| unwritable("--report", path, &error))
}

/// Never reached: [`check`] refuses.
#[cfg(not(feature = "report"))]
pub fn write(
    _: &Results,
    _: &[Trace],
    _: &Policy<'_>,
    _: &[&'static str],
    path: &Path,
) -> Result<(), End> {
    check(Some(path))
}
