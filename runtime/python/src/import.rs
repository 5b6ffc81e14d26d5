//! Imports any ONNX policy and a description of the robot, by the engine of `lads import`.
//!
//! What can fail: a file that cannot be read, missing or contradictory fields, all reported at once
//! with a line each, or an output that cannot be written; nothing is written then.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use lads_host::output;
use lads_import::{ImportError, Imported, Request};
use pyo3::prelude::*;

use crate::errors::{CompileError, ImportOnnxError, OpenError, opening};
use crate::policy::Policy;

/// Path of a policy's only file, or paths of all its files.
#[derive(FromPyObject)]
pub enum Files {
    /// Path of the only file.
    #[pyo3(transparent)]
    One(PathBuf),
    /// Paths of several files, where one's output is the input of another.
    #[pyo3(transparent)]
    Several(Vec<PathBuf>),
}

impl Files {
    fn paths(self) -> PyResult<Vec<PathBuf>> {
        match self {
            Self::One(path) => Ok(vec![path]),
            Self::Several(paths) if paths.is_empty() => Err(OpenError::new_err(
                "no file was given; give the policy's .onnx, or a list of them",
            )),
            Self::Several(paths) => Ok(paths),
        }
    }
}

/// Imports any ONNX policy: raw sensor values in, motor commands out -> lads.Policy.
///
/// `policy` is a path, or a list of paths where one file's output is another's input; `robot_toml`
/// is the path of a person's description of the robot, in the form that lads.template gives;
/// `output` is the bundle to write, by default none. `beside` are further files that describe the
/// policy, besides those in the places where exporters put them; `action` names the output that is
/// the action; `states` has the output that becomes each recurrent input, `wires` the input that
/// reads each output in the same step; `golden` is a recorded run (.csv). Missing or contradictory
/// fields raise a lads.errors.ImportOnnxError with all `problems`.
#[pyfunction]
#[pyo3(signature = (policy, robot_toml=None, *, output=None, beside=None, action=None, states=None, wires=None, golden=None))]
#[expect(
    clippy::too_many_arguments,
    reason = "Python's keywords, most of them optional"
)]
pub fn import_onnx(
    py: Python<'_>,
    policy: Files,
    robot_toml: Option<PathBuf>,
    output: Option<PathBuf>,
    beside: Option<Vec<PathBuf>>,
    action: Option<String>,
    states: Option<BTreeMap<String, String>>,
    wires: Option<BTreeMap<String, String>>,
    golden: Option<PathBuf>,
) -> PyResult<Policy> {
    let (models, beside) = (policy.paths()?, beside.unwrap_or_default());
    let request = Request {
        models: models.iter().map(PathBuf::as_path).collect(),
        robot: robot_toml.as_deref(),
        beside: beside.iter().map(PathBuf::as_path).collect(),
        output: action.as_deref(),
        states: states.unwrap_or_default().into_iter().collect(),
        wires: wires.unwrap_or_default().into_iter().collect(),
        golden: golden.as_deref(),
        ..Request::default()
    };
    let first = &models[0];
    if let Some(output) = &output {
        free(&request, output)?;
    }
    let imported = py.detach(|| lads_import::import(&request));
    let Imported {
        bundle,
        notes,
        read,
    } = imported.map_err(|error| refused(first, &error))?;
    if let Some(output) = &output {
        let read: Vec<_> = read
            .iter()
            .map(|path| ("the import", path.as_path()))
            .collect();
        output::apart(&read, &[("output", output)])
            .map_err(|error| OpenError::new_err(error.to_string()))?;
    }
    let path = output.clone().unwrap_or_else(|| first.clone());
    let opened = py.detach(|| lads_host::from_bytes(&bundle));
    let opened = opened.map_err(|error| {
        opening(&lads_host::OpenError {
            path: Some(path.clone()),
            ..error
        })
    })?;
    if let Some(output) = output {
        let written = py.detach(|| output::write(&output, &bundle));
        written.map_err(|error| {
            OpenError::new_err(format!(
                "{}: it cannot be written ({error}); name a file in an existing, writable folder",
                output.display()
            ))
        })?;
    }
    Ok(Policy::of(path, opened).with_notes(notes))
}

/// Returns the form that `import_onnx` takes as its `robot_toml`: everything that the files state,
/// and everything missing with its meaning -> TOML.
///
/// `policy`, `robot_toml` (a form that is not yet complete) and `beside` are those of `import_onnx`.
#[pyfunction]
#[pyo3(signature = (policy, robot_toml=None, *, beside=None))]
pub fn template(
    py: Python<'_>,
    policy: Files,
    robot_toml: Option<PathBuf>,
    beside: Option<Vec<PathBuf>>,
) -> PyResult<String> {
    let (models, beside) = (policy.paths()?, beside.unwrap_or_default());
    let request = Request {
        models: models.iter().map(PathBuf::as_path).collect(),
        robot: robot_toml.as_deref(),
        beside: beside.iter().map(PathBuf::as_path).collect(),
        ..Request::default()
    };
    let form = py.detach(|| lads_import::template(&request));
    form.map_err(|error| refused(&models[0], &error))
}

/// Refuses an output that cannot be written or is one of the input files, before any work.
fn free(request: &Request<'_>, output: &Path) -> PyResult<()> {
    let read = request.models.iter().chain(&request.beside);
    let read = read.chain(&request.robot).chain(&request.golden);
    let read: Vec<_> = read.map(|&path| ("the import", path)).collect();
    let checked = output::check(&read, &[("output", output)]);
    checked.map_err(|error| OpenError::new_err(error.to_string()))
}

/// Makes the exception for a failed import.
fn refused(model: &Path, error: &ImportError) -> PyErr {
    let model = model.display();
    let problems = match error {
        ImportError::Problems { problems } => problems,
        // It names the file itself.
        ImportError::File(error) => return OpenError::new_err(lads_cli::chain(error)),
        error => {
            return CompileError::new_err(format!("{model}: {}", lads_cli::chain(error)));
        }
    };
    let all = problems.all().iter();
    let all: Vec<_> = all
        .map(|row| (row.about.clone(), row.wrong.clone()))
        .collect();
    let things = if all.len() == 1 { "thing" } else { "things" };
    let head = format!(
        "{model}: {} {things} to settle; lads.template(policy) gives the form to fill in for robot_toml",
        all.len()
    );
    ImportOnnxError::new_err((format!("{head}\n{problems}").trim_end().to_owned(), all))
}
