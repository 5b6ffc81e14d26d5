//! `lads import`: turns any ONNX policy and a description of the robot into a bundle.
//!
//! All missing and contradictory fields are reported at once, and then no file is written.

use std::path::{Path, PathBuf};

use clap::Args;
use lads_host::output;
use lads_import::{ImportError, Imported};

use crate::print;
use crate::refusal::{Refusal, chain};

/// Options of `lads import`.
#[derive(Debug, Args)]
pub struct Request {
    /// Policy to import (.onnx); of several files, one's output is the input of another
    #[arg(required = true)]
    models: Vec<PathBuf>,
    /// Description of the robot (.toml): --template prints the form
    #[arg(long, value_name = "FILE")]
    contract: Option<PathBuf>,
    /// Another file that describes the policy (deploy.yaml, JSON), besides those in the places
    /// where exporters put them
    #[arg(long, value_name = "FILE")]
    beside: Vec<PathBuf>,
    /// Leave out the files that lie in those places
    #[arg(long)]
    alone: bool,
    /// Path of the bundle to write; by default the policy's name with .lads.onnx
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Output of the graph that is the action, if there are several
    #[arg(long, value_name = "NAME")]
    action: Option<String>,
    /// Input of the graph, and the output that is its value in the next control step; zeros when an
    /// episode begins
    #[arg(long, value_name = "INPUT=OUTPUT", value_parser = pair)]
    state: Vec<(String, String)>,
    /// Output of one file, and the input of another that reads it; prefixed with the file and a
    /// colon if the name alone is ambiguous
    #[arg(long, value_name = "OUTPUT=INPUT", value_parser = pair)]
    wire: Vec<(String, String)>,
    /// Recorded run (.csv) that gives the golden steps, with a column CHANNEL.ELEMENT for every
    /// observed element and action.ELEMENT for every element of the executed action
    #[arg(long, value_name = "FILE")]
    golden: Option<PathBuf>,
    /// Print the form to fill in, with everything that the files state, and write nothing
    #[arg(long, conflicts_with_all = ["output", "golden"])]
    template: bool,
}

fn pair(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((a, b)) if !a.is_empty() && !b.is_empty() => Ok((a.into(), b.into())),
        _ => Err("it has to be two names with a `=` between them".into()),
    }
}

/// Imports a policy and writes its bundle.
pub fn import(request: &Request) -> Result<(), Refusal> {
    let asked = lads_import::Request {
        models: request.models.iter().map(PathBuf::as_path).collect(),
        robot: request.contract.as_deref(),
        beside: request.beside.iter().map(PathBuf::as_path).collect(),
        alone: request.alone,
        output: request.action.as_deref(),
        states: request.state.clone(),
        wires: request.wire.clone(),
        golden: request.golden.as_deref(),
    };
    let first = request
        .models
        .first()
        .map_or(Path::new(""), PathBuf::as_path);
    if request.template {
        let form = lads_import::template(&asked).map_err(|error| refusal(first, error))?;
        return print(&form);
    }
    let output = match &request.output {
        Some(output) => output.clone(),
        None => first.with_extension("lads.onnx"),
    };
    let inputs: Vec<output::Named> = (asked.models.iter())
        .chain(&asked.beside)
        .map(|&path| ("", path))
        .chain(asked.robot.map(|path| ("--contract", path)))
        .chain(asked.golden.map(|path| ("--golden", path)))
        .collect();
    output::check(&inputs, &[("-o", &output)]).map_err(Refusal::of)?;
    let Imported {
        bundle,
        notes,
        read,
    } = lads_import::import(&asked).map_err(|error| refusal(first, error))?;
    let read: Vec<output::Named> = read.iter().map(|path| ("", path.as_path())).collect();
    output::apart(&read, &[("-o", &output)]).map_err(Refusal::of)?;
    output::write(&output, &bundle).map_err(|error| {
        let remedy = "name a file in an existing, writable folder";
        Refusal::new(output.display(), error, remedy)
    })?;
    for note in notes {
        print(&format!("{note}\n"))?;
    }
    print(&format!("{}: {} bytes\n", output.display(), bundle.len()))
}

fn refusal(model: &Path, error: ImportError) -> Refusal {
    match error {
        ImportError::Problems { problems } => Refusal::list(
            model.display(),
            problems
                .all()
                .iter()
                .map(|problem| format!("{}: {}", problem.about, problem.wrong)),
            format_args!(
                "`lads import {} --template` prints the form to fill in for --contract",
                model.display()
            ),
        ),
        ImportError::File(error) => Refusal::of(chain(&error)),
        error => Refusal::with_remedy_inside(model.display(), chain(&error)),
    }
}
