//! Resolves the policy's output: which output is the action, the meaning of its numbers, and their
//! limits.

use super::Edges;
use super::elements::{Joints, bounds, limits, spread};
use crate::model::Edge;
use crate::plan::{Action, Element};
use crate::problem::Problems;
use crate::robot::Robot;

/// Resolves the action, if its description is complete.
pub(crate) fn resolve(
    edges: &Edges,
    robot: &Robot,
    joints: &Joints,
    problems: &mut Problems,
) -> Option<Action> {
    let said = &robot.action;
    let edge = output(edges, robot, problems)?;
    let width = edge.len();
    let of_joints = said.joints.as_ref().or(if said.elements.is_some() {
        None
    } else {
        Some(&joints.policy)
    });
    let of_joints = of_joints.filter(|names| !names.is_empty());
    let names = said.elements.as_ref().or(of_joints);
    match names {
        None => problems.add(
            "joints",
            format!("are not said: the names of the {width} joints in the order of the output `{}` (or `action.elements`, if it moves no joints)", edges.name(edge)),
        ),
        Some(names) if names.len() != width => problems.add(
            if said.elements.is_some() { "action.elements" } else { "joints" },
            format!("has {} names, the output `{}` has {width} elements", names.len(), edges.name(edge)),
        ),
        Some(_) => {}
    }
    if said.unit.is_none() {
        problems.add(
            "action.unit",
            "is not given: the unit of the robot's command, for example \"rad\"",
        );
    }
    let limits = limits(
        [said.min.as_ref(), said.max.as_ref()],
        width,
        "action",
        said.unit.as_deref(),
        problems,
    );
    for (field, missing, what) in [
        (
            "action.scale",
            said.scale.is_none(),
            "the factor of the policy's number; 1 for none",
        ),
        (
            "action.offset",
            said.offset.is_none(),
            "the number that is added after scaling, for example the default posture; 0 for none",
        ),
    ] {
        if missing {
            problems.add(field, format!("is not given: {what}"));
        }
    }
    let scale = spread(said.scale.as_ref(), width, "action.scale", problems);
    let offset = spread(said.offset.as_ref(), width, "action.offset", problems);
    let clip = bounds(said.clip.as_ref(), width, "action.clip", problems);
    let stiffness = spread(said.stiffness.as_ref(), width, "action.stiffness", problems);
    let damping = spread(said.damping.as_ref(), width, "action.damping", problems);
    if let Some(tolerance) = said.tolerance
        && !(tolerance.is_finite() && tolerance > 0.0)
    {
        problems.add(
            "action.tolerance",
            format!("is {tolerance}, it must be positive"),
        );
    }
    let names = names.filter(|names| names.len() == width)?;
    let order = match of_joints {
        Some(names) => joints.by_robot(names),
        None => (0..width).collect(),
    };
    let (limits, unit) = (limits?, said.unit.as_ref()?);
    let elements = order.iter().map(|&i| Element {
        name: names[i].clone(),
        unit: unit.clone(),
        min: limits.0[i],
        max: limits.1[i],
        joint: of_joints.map(|names| names[i].clone()),
        interface: said.interface.clone(),
        stiffness: stiffness.as_ref().map(|values| values[i]),
        damping: damping.as_ref().map(|values| values[i]),
    });
    Some(Action {
        edge: edge.clone(),
        clip,
        scale: scale?,
        offset: offset?,
        elements: elements.collect(),
        order,
        reference: said.reference.clone().unwrap_or_default(),
    })
}

/// Returns the output that is the action.
fn output<'e>(edges: &'e Edges, robot: &Robot, problems: &mut Problems) -> Option<&'e Edge> {
    match (&robot.action.output, &edges.outputs[..]) {
        (Some(name), outputs) => edges
            .find(outputs, name)
            .map_err(|problem| problems.add("action.output", problem))
            .ok(),
        (None, [edge]) => Some(edge),
        (None, outputs) => {
            let names: Vec<String> = outputs.iter().map(|edge| edges.name(edge)).collect();
            problems.add(
                "action.output",
                format!("is not given: which of {} is the action", names.join(", ")),
            );
            None
        }
    }
}
