//! Native half of the Python package `lads`: policies, controllers, batches of controllers, and the
//! statistics of proofs.
//!
//! The public package is `python/lads`; this module, `lads._lads`, gives it classes over lads-host
//! and lads-proof. Invariants: every array is checked (type, shape, layout) and copied while the
//! interpreter is held, so nothing here shares memory with Python; a controller is used by one
//! thread at a time and only in the process that made it; every refusal is an exception of
//! `lads.errors` that names the thing and the remedy, and leaves the controller unchanged. There is
//! no unsafe code outside `PyO3` and `rust-numpy`.
#![deny(unsafe_code)]
// `Controller::reset` is the method of one lifetime, the closure around it that of all.
#![allow(clippy::redundant_closure_for_method_calls)]
// What Python gives is owned by the call.
#![allow(clippy::needless_pass_by_value)]

mod arrays;
mod batch;
mod cell;
mod controller;
mod crew;
mod errors;
mod import;
mod judge;
mod memory;
mod numbers;
mod policy;
mod process;
mod proof;
mod record;
mod report;

use std::ffi::OsString;
use std::path::PathBuf;

use pyo3::prelude::*;

/// Runs the command `lads` with these arguments, the program's name first -> its exit code.
#[pyfunction]
fn command(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
    py.detach(|| lads_cli::command(arguments))
}

/// Writes a text to a file, completely or not at all.
#[pyfunction]
fn write(py: Python<'_>, path: PathBuf, text: &str) -> PyResult<()> {
    py.detach(|| lads_host::output::write(&path, text.as_bytes()))
        .map_err(|error| {
            errors::ProofError::new_err(format!(
                "{}: it cannot be written ({error}); name a file in an existing, writable folder",
                path.display()
            ))
        })
}

/// The native half of the package; import `lads` instead.
#[pymodule]
fn _lads(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<policy::Policy>()?;
    module.add_class::<controller::Controller>()?;
    module.add_class::<batch::Controllers>()?;
    module.add_class::<report::StepReport>()?;
    module.add_class::<report::Selected>()?;
    module.add_function(wrap_pyfunction!(policy::open, module)?)?;
    module.add_function(wrap_pyfunction!(policy::from_image, module)?)?;
    module.add_function(wrap_pyfunction!(import::import_onnx, module)?)?;
    module.add_function(wrap_pyfunction!(import::template, module)?)?;
    module.add_function(wrap_pyfunction!(process::forked, module)?)?;
    module.add_function(wrap_pyfunction!(proof::wilson, module)?)?;
    module.add_function(wrap_pyfunction!(proof::score, module)?)?;
    module.add_function(wrap_pyfunction!(record::check_log, module)?)?;
    module.add_function(wrap_pyfunction!(record::write_log, module)?)?;
    module.add_function(wrap_pyfunction!(judge::judge, module)?)?;
    module.add_function(wrap_pyfunction!(command, module)?)?;
    module.add_function(wrap_pyfunction!(write, module)?)?;
    Ok(())
}
