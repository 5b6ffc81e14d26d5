//! Makes a policy bundle of any ONNX policy file: graphs, what is said of the robot, golden steps.
//!
//! ```text
//! policy.onnx ─► model ─┐
//! what lies beside ─► said ─┼─► resolve ─► plan ─► build ─► bundle ─► compared with a double-precision evaluation
//! robot.toml ─► robot ──┘
//! ```
//!
//! The bundle does the hand-written part too: raw sensor values in, what the robot's motors get out. Nothing is guessed: what neither the
//! files nor the person say, and what contradicts, is told all at once ([`ImportError::Problems`]), and [`template`] prints the form to
//! fill in. Files may be hostile; nothing private of them (paths, robot descriptions) enters the bundle, and nothing in them is executed.
//!
#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod build;
mod checked;
mod contract;
mod golden;
mod known;
mod model;
mod plan;
mod problem;
mod resolve;
mod robot;
mod said;
mod template;
mod yaml;

use std::path::{Path, PathBuf};

use lads_compiler::onnx::StringStringEntryProto;
use lads_compiler::{BundleError, CompileError, Reference};
use prost::Message as _;

use crate::model::Model;
use crate::resolve::Edges;
use crate::robot::Robot;
use crate::said::{Gain, Said};

pub use problem::{Problem, Problems};

/// Files that are looked for beside a policy.
const NEIGHBOURS: [&str; 4] = [
    "deploy.yaml",
    "params/deploy.yaml",
    "../params/deploy.yaml",
    "manifest.json",
];

/// What to import.
#[derive(Debug, Clone, Default)]
pub struct Request<'r> {
    /// The policy's files; of several, one's output is the input of another.
    pub models: Vec<&'r Path>,
    /// What a person says about the robot, as TOML.
    pub robot: Option<&'r Path>,
    /// Files that say something about the policy, beside those that are found by their names.
    pub beside: Vec<&'r Path>,
    /// The output that is the action, where there are several.
    pub output: Option<&'r str>,
    /// Inputs and the outputs that are their next values.
    pub states: Vec<(String, String)>,
    /// Outputs and the inputs that read them in the same step.
    pub wires: Vec<(String, String)>,
    /// A recorded run, to be the golden steps.
    pub golden: Option<&'r Path>,
}

/// A bundle, and what is worth saying about how it came to be.
#[derive(Debug, Clone)]
pub struct Imported {
    /// The bundle, a complete ONNX file.
    pub bundle: Vec<u8>,
    /// One line for each thing that was read or found out.
    pub notes: Vec<String>,
}

/// Why there is no bundle.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// A file that is no policy at all.
    #[error(transparent)]
    File(#[from] BundleError),
    /// All that is missing and all that contradicts.
    #[error("{count} to settle:\n{problems}", count = things(.problems.all().len()))]
    Problems {
        /// One line for each.
        problems: Problems,
    },
    /// The policy cannot be compiled.
    #[error(transparent)]
    Compile(#[from] CompileError),
}

fn things(count: usize) -> String {
    if count == 1 {
        "1 thing".into()
    } else {
        format!("{count} things")
    }
}

/// What is known before anything is decided.
struct Known {
    models: Vec<Model>,
    robot: Robot,
    notes: Vec<String>,
    problems: Problems,
}

/// Makes a bundle.
pub fn import(request: &Request) -> Result<Imported, ImportError> {
    let Known {
        models,
        robot,
        mut notes,
        mut problems,
    } = known(request)?;
    for model in &models {
        model.operators(&robot.axes, &mut problems)?;
    }
    let edges = Edges::of(&models, &robot.axes, &mut problems);
    let plan = resolve::resolve(&edges, &robot, &request.wires, &mut problems);
    let built = plan
        .as_ref()
        .and_then(|plan| build::build(&models, plan, &mut problems));
    let recording = match (request.golden, &plan) {
        (Some(path), Some(plan)) => golden::recorded(path, plan, &mut problems),
        _ => None,
    };
    if !problems.is_empty() {
        return Err(ImportError::Problems { problems });
    }
    let (Some(plan), Some((mut model, states))) = (plan, built) else {
        return Err(ImportError::Problems { problems });
    };
    let mut say = |key: &str, value: String| {
        model.metadata_props.push(StringStringEntryProto {
            key: key.into(),
            value,
        });
    };
    say("lads.contract", contract::contract(&models, &plan, &states));
    let mut reference = Reference::new(&model.encode_to_vec())?;
    let steps = checked::steps(&mut reference, &plan, recording, &mut problems)?;
    if !problems.is_empty() {
        return Err(ImportError::Problems { problems });
    }
    match steps.episode.golden(&plan, steps.tolerance) {
        Ok(value) => model.metadata_props.push(StringStringEntryProto {
            key: "lads.golden".into(),
            value,
        }),
        Err(problem) => problems.add("golden steps", problem),
    }
    let bundle = model.encode_to_vec();
    let largest = checked::compared(&bundle, &plan, &steps, &mut problems)?;
    if !problems.is_empty() {
        return Err(ImportError::Problems { problems });
    }
    notes.push(format!(
        "{} steps equal a double-precision evaluation of the graph within {largest:.1e} (tolerance {:.1e})",
        steps.episode.len(),
        steps.tolerance
    ));
    Ok(Imported { bundle, notes })
}

/// The form to fill in: all that is known, all that is missing with what it means, and what is wrong with the files.
pub fn template(request: &Request) -> Result<String, ImportError> {
    let mut known = known(request)?;
    let edges = Edges::of(&known.models, &known.robot.axes, &mut known.problems);
    Ok(template::template(&edges, &known.robot, &known.problems))
}

/// Reads all files.
fn known(request: &Request) -> Result<Known, ImportError> {
    let (mut problems, mut notes) = (Problems::default(), vec![]);
    let mut models = vec![];
    for path in &request.models {
        let model = Model::read(path, &mut problems)?;
        if model.metadata().any(|(key, _)| key == "lads.contract") {
            problems.add(
                path.display(),
                "is a policy bundle already; inspect or compile it as it is",
            );
        }
        if models.iter().any(|other: &Model| other.stem == model.stem) {
            problems.add(
                path.display(),
                "has the name of another file; give them different names",
            );
        }
        models.push(model);
    }
    let mut robot = Robot::default();
    if let Some(path) = request.robot {
        match read_text(path).and_then(|text| Robot::parse(&text)) {
            Ok(said) => robot = said,
            Err(problem) => problems.add(path.display(), problem),
        }
    }
    if let Some(output) = request.output {
        robot.action.output = Some(output.into());
    }
    for (input, output) in &request.states {
        robot.states.push(robot::State {
            input: input.clone(),
            output: output.clone(),
            cleared_by: robot::ClearedBy::Episode,
        });
    }
    let mut lost: Vec<(String, Gain)> = vec![];
    let mut take = |said: Said, source: &str, problems: &mut Problems| {
        if !said.used.is_empty() {
            notes.push(format!("{source}: read {}", said.used.join(", ")));
        }
        let named = |(name, gain)| (format!("{source}, `{name}`"), gain);
        lost.extend(said.lost.into_iter().map(named));
        if let Err(problem) = robot.fill(said.robot) {
            problems.add(source, problem);
        }
    };
    for path in neighbours(request) {
        let source = path.display().to_string();
        let json = path.extension().is_some_and(|ending| ending == "json");
        let read = if json { said::manifest } else { said::deploy };
        match read_text(&path) {
            Ok(text) => take(read(&text, &source, &mut problems), &source, &mut problems),
            Err(problem) => problems.add(source, problem),
        }
    }
    for model in &models {
        let said = said::metadata(model.metadata(), &mut problems);
        take(said, "metadata", &mut problems);
    }
    // No problem once somebody has said them.
    for (about, gain) in lost {
        let (field, said) = match gain {
            Gain::Stiffness => ("stiffness", &robot.action.stiffness),
            Gain::Damping => ("damping", &robot.action.damping),
        };
        if said.is_none() {
            problems.add(
                about,
                format!("has been rounded until nothing is left of it (all 1, or a 0): say `action.{field}`"),
            );
        }
    }
    Ok(Known {
        models,
        robot,
        notes,
        problems,
    })
}

fn read_text(path: &Path) -> Result<String, String> {
    lads_host::input::read_to_string(path).map_err(|error| format!("cannot be read: {error}"))
}

/// Files that were named, and those that lie beside the policy.
fn neighbours(request: &Request) -> Vec<PathBuf> {
    let mut all: Vec<PathBuf> = request.beside.iter().map(|&path| path.into()).collect();
    for model in &request.models {
        let folder = model.parent().unwrap_or(Path::new(""));
        let found = NEIGHBOURS.iter().map(|name| folder.join(name));
        all.extend(found.filter(|path| path.is_file()));
    }
    all.dedup();
    all
}
