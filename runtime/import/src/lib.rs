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
#![forbid(unsafe_code)]

mod build;
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
use lads_compiler::{Bundle, BundleError, CompileError, Reference};
use lads_core::{ChannelId, Data};
use prost::Message as _;

use crate::golden::Episode;
use crate::model::Model;
use crate::plan::Plan;
use crate::resolve::Edges;
use crate::robot::Robot;
use crate::said::Said;

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
        for operator in &model.survey.missing.operators {
            problems.add(
                format!("node `{}`", operator.node),
                format!("operator {} {}", operator.operator, operator.problem),
            );
        }
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
    let episode = episode(&mut reference, &plan, recording, &mut problems)?;
    if !problems.is_empty() {
        return Err(ImportError::Problems { problems });
    }
    match episode.golden(&plan, plan.tolerance) {
        Ok(value) => model.metadata_props.push(StringStringEntryProto {
            key: "lads.golden".into(),
            value,
        }),
        Err(problem) => problems.add("golden steps", problem),
    }
    let bundle = model.encode_to_vec();
    let largest = compared(&bundle, &plan, &episode, &mut problems)?;
    if !problems.is_empty() {
        return Err(ImportError::Problems { problems });
    }
    notes.push(format!(
        "{} steps of two episodes equal a double-precision evaluation of the graph within {largest:.1e} (tolerance {:.1e})",
        episode.len(),
        plan.tolerance
    ));
    Ok(Imported { bundle, notes })
}

/// The form to fill in: all that is known, and all that is missing with what it means.
pub fn template(request: &Request) -> Result<String, ImportError> {
    let mut known = known(request)?;
    let edges = Edges::of(&known.models, &known.robot.axes, &mut known.problems);
    Ok(template::template(&edges, &known.robot))
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
    let mut take = |said: Said, source: &str, problems: &mut Problems| {
        if !said.used.is_empty() {
            notes.push(format!("{source}: read {}", said.used.join(", ")));
        }
        if let Err(problem) = robot.fill(said.robot) {
            problems.add(source, problem);
        }
    };
    for path in neighbours(request) {
        let source = path.display().to_string();
        let text = match read_text(&path) {
            Ok(text) => text,
            Err(problem) => {
                problems.add(source, problem);
                continue;
            }
        };
        let json = path.extension().is_some_and(|ending| ending == "json");
        let said = if json {
            said::manifest(&text, &source, &mut problems)
        } else {
            said::deploy(&text, &source, &mut problems)
        };
        take(said, &source, &mut problems);
    }
    for model in &models {
        // What is wrong there does not matter where a person says better.
        let mut own = Problems::default();
        let said = said::metadata(model.metadata(), &mut own);
        take(said, "metadata", &mut problems);
        for problem in own.all() {
            problems.add(&problem.about, &problem.wrong);
        }
    }
    // Gains that were lost in a file are no problem once somebody has said them.
    let problems = problems.without(|problem| {
        let said = |field: &str, value: &Option<robot::Each>| {
            value.is_some() && problem.wrong.contains(&format!("say `action.{field}`"))
        };
        said("stiffness", &robot.action.stiffness) || said("damping", &robot.action.damping)
    });
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

/// The golden steps: recorded ones, which have to be what the graph does, or made-up ones.
fn episode(
    reference: &mut Reference,
    plan: &Plan,
    recording: Option<Episode>,
    problems: &mut Problems,
) -> Result<Episode, CompileError> {
    let Some(recording) = recording else {
        let mut episode = golden::made_up(plan);
        episode.actions = golden::computed(reference, &episode)?;
        for (step, action) in episode.actions.iter().enumerate() {
            if let Some(i) = action.iter().position(|value| !value.is_finite()) {
                problems.add(
                    format!("action `{}`", plan.action.elements[i].name),
                    format!("is no number in step {step} of observations inside their limits"),
                );
                break;
            }
        }
        return Ok(episode);
    };
    let wanted = golden::computed(reference, &recording)?;
    differences(&wanted, &recording.actions, plan, "the recording", problems);
    Ok(recording)
}

/// The largest difference; the first one beyond the tolerance is a problem.
fn differences(
    graph: &[Vec<f64>],
    other: &[Vec<f64>],
    plan: &Plan,
    what: &str,
    problems: &mut Problems,
) -> f64 {
    let mut largest = 0.0_f64;
    for (step, (a, b)) in graph.iter().zip(other).enumerate() {
        for (i, (a, b)) in a.iter().zip(b).enumerate() {
            let difference = (a - b).abs();
            let close = difference <= plan.tolerance;
            if !close && problems.is_empty() {
                problems.add(
                    format!("action `{}`", plan.action.elements[i].name),
                    format!(
                        "is {b} in step {step} of {what}, the graph gives {a}: more than the tolerance {:e} apart (`action.tolerance`)",
                        plan.tolerance
                    ),
                );
            }
            largest = largest.max(difference);
        }
    }
    largest
}

/// Runs the compiled policy over the episode and returns how far its actions are from the graph's.
fn compared(
    bundle: &[u8],
    plan: &Plan,
    episode: &Episode,
    problems: &mut Problems,
) -> Result<f64, ImportError> {
    let unloaded = |error: &dyn std::fmt::Display| CompileError::Entry {
        entry: "policy/act".into(),
        problem: error.to_string().into(),
    };
    let image = lads_compiler::compile(&Bundle::from_bytes(bundle)?)?;
    let opened = lads_host::from_bytes(image.as_bytes()).map_err(|error| unloaded(&error))?;
    let mut loaded = opened.load().map_err(|error| unloaded(&error))?;
    let mut controller = loaded.controller();
    let mut actions = vec![];
    for step in 0..episode.len() {
        if episode.begins[step] {
            controller.reset();
        }
        let values: Vec<Vec<f32>> = episode
            .observed(step)
            .iter()
            .map(|row| row.iter().map(|&value| value as f32).collect())
            .collect();
        let given: Vec<(ChannelId, Data)> = controller
            .policy()
            .contract()
            .observations()
            .map(|channel| channel.id())
            .zip(values.iter().map(|row| Data::F32(row)))
            .collect();
        let mut action = vec![0.0; plan.action.elements.len()];
        controller
            .step_with(&given, &mut action)
            .map_err(|error| unloaded(&error))?;
        actions.push(action.into_iter().map(f64::from).collect());
    }
    let what = "the compiled policy";
    Ok(differences(
        &episode.actions,
        &actions,
        plan,
        what,
        problems,
    ))
}
