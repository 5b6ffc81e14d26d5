//! `lads import`: any ONNX policy and a description of the robot into a bundle.
//!
//! All that is missing and all that contradicts is told at once, and no file is written then.

use std::path::{Path, PathBuf};

use clap::Args;
use lads_host::output;
use lads_import::{ImportError, Imported};

use crate::print;
use crate::refusal::{Refusal, chain};

/// What to import, and what to write.
#[derive(Debug, Args)]
pub struct Request {
    /// The policy (.onnx); of several files, one's output is the input of another
    #[arg(required = true)]
    models: Vec<PathBuf>,
    /// What is to be said about the robot (.toml): --template prints the form
    #[arg(long, value_name = "FILE")]
    contract: Option<PathBuf>,
    /// A file that says something about the policy (deploy.yaml, JSON), besides those that lie where exporters put them
    #[arg(long, value_name = "FILE")]
    beside: Vec<PathBuf>,
    /// The bundle to write; otherwise the policy's name with .lads.onnx
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// The graph's output that is the action, where there are several
    #[arg(long, value_name = "NAME")]
    action: Option<String>,
    /// An input and the output that is its value in the next control step; zeros when an episode begins
    #[arg(long, value_name = "INPUT=OUTPUT", value_parser = pair)]
    state: Vec<(String, String)>,
    /// An output of one file and the input of another that reads it; with its file and a colon in front where a name alone is not enough
    #[arg(long, value_name = "OUTPUT=INPUT", value_parser = pair)]
    wire: Vec<(String, String)>,
    /// A recorded run (.csv) to be the golden steps, with a column CHANNEL.ELEMENT for all that was observed and action.ELEMENT for all
    /// that was done
    #[arg(long, value_name = "FILE")]
    golden: Option<PathBuf>,
    /// Writes nothing and prints the form to fill in, with all that the files say
    #[arg(long, conflicts_with_all = ["output", "golden"])]
    template: bool,
}

fn pair(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((a, b)) if !a.is_empty() && !b.is_empty() => Ok((a.into(), b.into())),
        _ => Err("it has to be two names with a `=` between them".into()),
    }
}

/// Imports as requested.
pub fn import(request: &Request) -> Result<(), Refusal> {
    let asked = lads_import::Request {
        models: request.models.iter().map(PathBuf::as_path).collect(),
        robot: request.contract.as_deref(),
        beside: request.beside.iter().map(PathBuf::as_path).collect(),
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
    let Imported { bundle, notes } =
        lads_import::import(&asked).map_err(|error| refusal(first, error))?;
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
