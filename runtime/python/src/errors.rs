//! Raises exceptions: classes of `lads/errors.py`, with the texts of the command.

use std::fmt::Display;

use lads_core::{Contract, InstructionError as CoreInstructionError, StepError as CoreStepError};
use lads_host::Problem;
use pyo3::prelude::*;

pyo3::import_exception!(lads.errors, BusyError);
pyo3::import_exception!(lads.errors, ClosedError);
pyo3::import_exception!(lads.errors, CompileError);
pyo3::import_exception!(lads.errors, ForkError);
pyo3::import_exception!(lads.errors, ImportOnnxError);
pyo3::import_exception!(lads.errors, InputError);
pyo3::import_exception!(lads.errors, InstructionError);
pyo3::import_exception!(lads.errors, OpenError);
pyo3::import_exception!(lads.errors, ProofError);
pyo3::import_exception!(lads.errors, RecordError);
pyo3::import_exception!(lads.errors, SelfTestError);
pyo3::import_exception!(lads.errors, StepError);
pyo3::import_exception!(lads.errors, WorkspaceError);

/// Makes the exception for a file that is not a policy.
pub fn opening(error: &lads_host::OpenError) -> PyErr {
    let text = lads_cli::chain(error);
    match error.problem {
        Problem::Compile(_) => CompileError::new_err(text),
        _ => OpenError::new_err(text),
    }
}

/// Makes the exception for values that a channel does not take.
pub fn input(wrong: impl Display) -> PyErr {
    InputError::new_err(format!(
        "{wrong}; give values inside the contract's limits, which policy.contract lists"
    ))
}

/// Makes the exception for a refused control step.
pub fn step(error: &CoreStepError, contract: &Contract<'_>) -> PyErr {
    match error {
        CoreStepError::Input(error) => input(lads_host::refused(error, contract)),
        CoreStepError::NoInstruction => InstructionError::new_err(
            "no instruction has been set; call controller.instruct(...), or give policy.controller(instruction=...)",
        ),
        other => StepError::new_err(other.to_string()),
    }
}

/// Makes the exception for a refused instruction.
pub fn instruction(error: &CoreInstructionError) -> PyErr {
    let remedy = match error {
        CoreInstructionError::NotTaken => "give none",
        CoreInstructionError::Run(_) => "export the bundle again",
        _ => "give finite word embeddings [words, dim], as policy.contract.language says",
    };
    InstructionError::new_err(format!("{error}; {remedy}"))
}
