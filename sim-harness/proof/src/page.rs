//! Renders the certificate as one HTML page, with nothing that has to be fetched. What can fail: nothing.

use askama::Template;

use super::certificate::Certificate;
use super::statistics::Difference;

/// HTML page of a certificate.
#[derive(Template)]
#[template(path = "certificate.html")]
pub struct Page<'c> {
    certificate: &'c Certificate,
}

impl<'c> Page<'c> {
    /// Makes the page of a certificate.
    pub fn new(certificate: &'c Certificate) -> Self {
        Self { certificate }
    }
}

/// Formats a share as a percentage.
#[expect(
    clippy::trivially_copy_pass_by_ref,
    reason = "templates pass references"
)]
fn percent(share: &f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// Formats an estimate with its interval.
fn difference(difference: &Difference) -> String {
    let Difference {
        estimate, interval, ..
    } = difference;
    format!("{estimate:+.3} ({:+.3} to {:+.3})", interval.0, interval.1)
}

/// Formats a small number.
#[expect(
    clippy::trivially_copy_pass_by_ref,
    reason = "templates pass references"
)]
fn small(number: &f64) -> String {
    format!("{number:.1e}")
}
