//! Combines the graphs and their description to a complete [`Plan`], or lists everything that is
//! missing or contradictory.

mod action;
mod elements;
mod sources;
mod terms;
mod widths;

use std::collections::{BTreeMap, HashSet};

use crate::model::{Edge, Model};
use crate::plan::{Feed, Plan, State};
use crate::problem::Problems;
use crate::robot::{Robot, Term};

pub(crate) use elements::Joints;

/// The inputs and outputs of all files.
pub(crate) struct Edges {
    pub inputs: Vec<Edge>,
    pub outputs: Vec<Edge>,
    stems: Vec<String>,
    /// Names of inputs that are there and of which something is still to be said.
    unsettled: Vec<String>,
}

impl Edges {
    pub fn of(models: &[Model], axes: &BTreeMap<String, usize>, problems: &mut Problems) -> Self {
        let (mut inputs, mut outputs, mut unsettled) = (vec![], vec![], vec![]);
        for (file, model) in models.iter().enumerate() {
            let (read, given) = model.edges(file, axes, problems);
            let graph = model.graph();
            let weights = graph.initializer.iter().map(|tensor| &tensor.name);
            let settled = read.iter().map(|edge| &edge.name);
            let known: HashSet<&String> = weights.chain(settled).collect();
            let names = graph.input.iter().map(|value| &value.name);
            unsettled.extend(names.filter(|&name| !known.contains(name)).cloned());
            inputs.extend(read);
            outputs.extend(given);
        }
        let stems = models.iter().map(|model| model.stem.clone()).collect();
        Self {
            inputs,
            outputs,
            stems,
            unsettled,
        }
    }

    /// Finds a value by the name that a person gives it: its name, or `FILE:NAME`, or
    /// `FILE:NUMBER`.
    pub fn find<'e>(&self, among: &'e [Edge], said: &str) -> Result<&'e Edge, String> {
        let known = || {
            let names: Vec<String> = among.iter().map(|edge| self.name(edge)).collect();
            names.join(", ")
        };
        let split = said
            .split_once(':')
            .and_then(|(stem, name)| Some((self.stems.iter().position(|s| s == stem)?, name)));
        let matches: Vec<&Edge> = match split {
            Some((file, name)) => {
                let of_file: Vec<&Edge> = among.iter().filter(|edge| edge.file == file).collect();
                let by_name: Vec<&Edge> = (of_file.iter().copied())
                    .filter(|edge| edge.name == name)
                    .collect();
                let by_number = name.parse::<usize>().ok().and_then(|n| of_file.get(n));
                if by_name.is_empty() {
                    by_number.into_iter().copied().collect()
                } else {
                    by_name
                }
            }
            None => among.iter().filter(|edge| edge.name == said).collect(),
        };
        match matches[..] {
            [edge] => Ok(edge),
            [] if self.unsettled.iter().any(|name| name == said) => Err(format!(
                "\"{said}\" is not an input yet; settle its shape first"
            )),
            [] => Err(format!(
                "\"{said}\" is not one of them; there are {}",
                known()
            )),
            _ => Err(format!(
                "\"{said}\" is in several files; say one of {}",
                known()
            )),
        }
    }

    /// Returns the name of a value for messages: with its file if there are several.
    pub fn name(&self, edge: &Edge) -> String {
        match (self.stems.len(), self.stems.get(edge.file)) {
            (0 | 1, _) | (_, None) => edge.name.clone(),
            (_, Some(stem)) => format!("{stem}:{}", edge.name),
        }
    }
}

/// Makes the plan; `None` if there are problems, which are then added.
pub(crate) fn resolve(
    edges: &Edges,
    robot: &Robot,
    wires: &[(String, String)],
    problems: &mut Problems,
) -> Option<Plan> {
    let before = problems.all().len();
    let joints = Joints::of(robot, problems);
    let action = action::resolve(edges, robot, &joints, problems);
    let states = states(edges, robot, problems);
    let (mut feeds, open) = otherwise_fed(edges, robot, wires, &states, problems);
    let mut channels = vec![];
    let action_width = action.as_ref().map(|action| action.scale.len());
    let mut context = terms::Context {
        edges,
        robot,
        joints: &joints,
        action_width,
        channels: &mut channels,
        problems,
    };
    let by_input = assigned(&mut context, &open);
    for (input, terms) in open.iter().zip(by_input) {
        if let Some(feed) = terms::feed(&mut context, input, &terms) {
            feeds.push(((*input).clone(), feed));
        }
    }
    sources::check_channels(&channels, problems);
    check_head(robot, problems);
    if problems.all().len() > before {
        return None;
    }
    let action = action?;
    Some(Plan {
        environment: robot
            .environment
            .as_ref()
            .map(|known| (known.id.clone(), known.version.clone()))?,
        period: robot.control_period_s?,
        channels,
        feeds,
        states,
        tolerance: robot.action.tolerance,
        action,
    })
}

/// Returns the inputs that states, constants and wires feed, and those that are left for terms.
fn otherwise_fed<'e>(
    edges: &'e Edges,
    robot: &Robot,
    wires: &[(String, String)],
    states: &[State],
    problems: &mut Problems,
) -> (Vec<(Edge, Feed)>, Vec<&'e Edge>) {
    let mut feeds: Vec<(Edge, Feed)> = vec![];
    let mut open: Vec<&Edge> = vec![];
    for input in &edges.inputs {
        let state = states.iter().position(|state| state.input == *input);
        let constant = robot
            .constants
            .iter()
            .find(|constant| edges.find(&edges.inputs, &constant.input) == Ok(input));
        let wire = wires
            .iter()
            .find(|(_, to)| edges.find(&edges.inputs, to) == Ok(input));
        match (state, constant, wire) {
            (Some(state), None, None) => feeds.push((input.clone(), Feed::State(state))),
            (None, Some(constant), None) => {
                feeds.push((input.clone(), Feed::Constant(constant.value)));
            }
            (None, None, Some((from, _))) => match edges.find(&edges.outputs, from) {
                Ok(output) if output.len() == input.len() => {
                    feeds.push((input.clone(), Feed::Wire(output.clone())));
                }
                Ok(output) => problems.add(
                    format!("wire {from}"),
                    format!(
                        "gives {:?} and the input `{}` reads {:?}; feed it by terms, one of them `from = \"output:{from}\"`",
                        output.dims,
                        edges.name(input),
                        input.dims
                    ),
                ),
                Err(problem) => problems.add(format!("wire {from}"), problem),
            },
            (None, None, None) => open.push(input),
            _ => problems.add(
                format!("input `{}`", edges.name(input)),
                "is fed in several ways: as a state, by a constant or by a wire; give one",
            ),
        }
    }
    for (from, to) in wires {
        if let Err(problem) = edges.find(&edges.inputs, to) {
            problems.add(format!("wire {from}={to}"), problem);
        }
    }
    for constant in &robot.constants {
        if let Err(problem) = edges.find(&edges.inputs, &constant.input) {
            problems.add(format!("constant.{}", constant.input), problem);
        }
    }
    (feeds, open)
}

/// Checks the control period and the environment of the policy.
fn check_head(robot: &Robot, problems: &mut Problems) {
    match robot.control_period_s {
        None => problems.add(
            "control_period_s",
            "is not given: the time from one control step to the next, in seconds",
        ),
        Some(period) if !(period.is_finite() && period > 0.0) => {
            problems.add(
                "control_period_s",
                format!("is {period}, it must be positive"),
            );
        }
        Some(_) => {}
    }
    if robot.environment.is_none() {
        problems.add(
            "environment",
            "is not given: `{ id = \"my-robot\", version = \"1\" }`, what the policy was made for",
        );
    }
}

fn states(edges: &Edges, robot: &Robot, problems: &mut Problems) -> Vec<State> {
    let mut states = vec![];
    for said in &robot.states {
        let about = format!("state {}={}", said.input, said.output);
        let (input, output) = (
            edges.find(&edges.inputs, &said.input),
            edges.find(&edges.outputs, &said.output),
        );
        match (input, output) {
            (Ok(input), Ok(output)) if input.dims == output.dims => states.push(State {
                input: input.clone(),
                output: output.clone(),
            }),
            (Ok(input), Ok(output)) => problems.add(
                about,
                format!(
                    "the input is {:?} and the output {:?}; a state keeps its shape",
                    input.dims, output.dims
                ),
            ),
            (input, output) => {
                for problem in [input.err(), output.err()].into_iter().flatten() {
                    problems.add(&about, problem);
                }
            }
        }
    }
    states
}

/// Returns the terms of each input that terms feed.
fn assigned<'r>(context: &mut terms::Context<'r, '_>, open: &[&Edge]) -> Vec<Vec<&'r Term>> {
    let robot = context.robot;
    let edges = context.edges;
    let mut by_input: Vec<Vec<&Term>> = vec![vec![]; open.len()];
    for term in &robot.terms {
        let about = format!("term.{}", term.name);
        match (&term.input, open.len()) {
            (Some(said), _) => match edges.find(&edges.inputs, said) {
                Ok(input) => match open.iter().position(|other| *other == input) {
                    Some(place) => by_input[place].push(term),
                    None => context
                        .problems
                        .add(about, format!("input `{said}` is fed otherwise already")),
                },
                Err(problem) => context.problems.add(about, format!("`input`: {problem}")),
            },
            (None, 1) => by_input[0].push(term),
            (None, 0) => context
                .problems
                .add(about, "no input is left that it could be a part of"),
            (None, _) => {
                let names: Vec<String> = open.iter().map(|edge| edges.name(edge)).collect();
                context.problems.add(
                    about,
                    format!(
                        "does not say which `input` it is a part of: {}",
                        names.join(", ")
                    ),
                );
            }
        }
    }
    by_input
}
