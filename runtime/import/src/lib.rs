//! Makes a policy bundle of any ONNX policy file: its graphs, a description of the robot, golden
//! steps.
//!
//! ```text
//! policy.onnx ─► model ─┐
//! what lies beside ─► said ─┼─► resolve ─► plan ─► build ─► bundle ─► compared with a double-precision evaluation
//! robot.toml ─► robot ──┘
//! ```
//!
//! The bundle includes the processing that is otherwise written by hand: raw sensor values in,
//! motor commands out. Nothing is guessed: everything that neither the files nor the person state,
//! and every contradiction, is reported at once ([`ImportError::Problems`]), and [`template`]
//! prints the form to fill in. Files may be hostile; nothing private of them (paths, robot
//! descriptions) enters the bundle, and nothing in them is executed.
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

/// Names of files that are looked for beside a policy.
const NEIGHBOURS: [&str; 4] = [
    "deploy.yaml",
    "params/deploy.yaml",
    "../params/deploy.yaml",
    "manifest.json",
];

/// Files and choices of an import.
#[derive(Debug, Clone, Default)]
pub struct Request<'r> {
    /// Files of the policy; of several, one's output is the input of another.
    pub models: Vec<&'r Path>,
    /// Description of the robot by a person, as TOML.
    pub robot: Option<&'r Path>,
    /// Further files that describe the policy, besides those that are found by their names.
    pub beside: Vec<&'r Path>,
    /// Leave out the files that are found by their names beside the policy.
    pub alone: bool,
    /// Name of the output that is the action, if there are several.
    pub output: Option<&'r str>,
    /// Names of inputs and of the outputs that are their next values.
    pub states: Vec<(String, String)>,
    /// Names of outputs and of the inputs that read them in the same step.
    pub wires: Vec<(String, String)>,
    /// A recorded run that gives the golden steps.
    pub golden: Option<&'r Path>,
}

/// A bundle, with notes on how it was made.
#[derive(Debug, Clone)]
pub struct Imported {
    /// The bundle, a complete ONNX file.
    pub bundle: Vec<u8>,
    /// Notes, one line for each fact that was read or found.
    pub notes: Vec<String>,
    /// Files that were read besides those of the request: external data and neighbours of the
    /// policy. An output must be none of them.
    pub read: Vec<PathBuf>,
}

/// Reason why there is no bundle.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// A file is not a policy at all.
    #[error(transparent)]
    File(#[from] BundleError),
    /// The import misses something or contradicts itself.
    #[error("{count} to settle:\n{problems}", count = things(.problems.all().len()))]
    Problems {
        /// All problems, one line for each.
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

/// Facts that are known before anything is resolved.
struct Known {
    models: Vec<Model>,
    robot: Robot,
    notes: Vec<String>,
    problems: Problems,
}

/// Imports a policy and makes its bundle.
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
    let external = models.iter().flat_map(|model| model.external.clone());
    let read = external.chain(neighbours(request)).collect();
    Ok(Imported {
        bundle,
        notes,
        read,
    })
}

/// Makes the form to fill in: everything known, everything missing with its meaning, and the faults
/// of the files.
pub fn template(request: &Request) -> Result<String, ImportError> {
    let mut known = known(request)?;
    let edges = Edges::of(&known.models, &known.robot.axes, &mut known.problems);
    Ok(template::template(&edges, &known.robot, &known.problems))
}

/// Reads all files of a request and collects their facts.
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
    // What a person wrote stands; files beside each other have to agree on the rest.
    let own = robot.clone();
    let mut earlier: Vec<(String, Robot)> = vec![];
    let mut take = |said: Said, source: &str, problems: &mut Problems| {
        for (other, before) in &earlier {
            for field in before.contradictions(&said.robot, &own) {
                problems.add(
                    source,
                    format!("`{field}` is said otherwise by {other}; say in the description which is right"),
                );
            }
        }
        earlier.push((source.to_owned(), said.robot.clone()));
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
        match read_text(&path) {
            Ok(text) => {
                let said = if json {
                    said::manifest(&text, &own.terms, &source, &mut problems)
                } else {
                    said::deploy(&text, &source, &mut problems)
                };
                take(said, &source, &mut problems);
            }
            Err(problem) => problems.add(source, problem),
        }
    }
    for model in &models {
        let said = said::metadata(model.metadata(), &own.terms, &mut problems);
        take(said, "metadata", &mut problems);
    }
    // No problem once a description gives them.
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

/// Returns the files that were named, and those that lie beside the policy.
fn neighbours(request: &Request) -> Vec<PathBuf> {
    let mut all: Vec<PathBuf> = request.beside.iter().map(|&path| path.into()).collect();
    for model in &request.models {
        let folder = model.parent().unwrap_or(Path::new(""));
        let found = NEIGHBOURS.iter().filter(|_| !request.alone);
        let found = found.map(|name| folder.join(name));
        all.extend(found.filter(|path| path.is_file()));
    }
    all.dedup();
    all
}
