//! Resolves the source of a term's raw values: elements of a channel, or values that the runtime
//! makes itself.

use std::collections::HashSet;

use super::elements::limits;
use super::terms::{Context, plain};
use crate::plan::{Channel, Element, Part, Source};
use crate::problem::Problems;
use crate::robot::{self, From, QuaternionOrder};

/// Name of the channel of terms that name none.
const OBSERVATION: &str = "observation";

/// Limit of a unit quaternion's elements, with a margin for the rounding of the program that
/// computes it.
const QUATERNION: f64 = 1.01;

pub(super) fn source(
    context: &mut Context,
    term: &robot::Term,
    width: usize,
    about: &str,
) -> Option<Source> {
    let said = [&term.unit, &term.interface, &term.channel];
    let raw = matches!(term.from, None | Some(From::Sensor | From::Gravity));
    if !raw
        && (said.iter().any(|field| field.is_some()) || term.min.is_some() || term.max.is_some())
    {
        context.problems.add(
            about,
            "is made by the runtime itself, so it has no `unit`, `interface`, `channel`, `min` and `max`",
        );
    }
    match term.from.clone().unwrap_or(From::Sensor) {
        From::Sensor => sensor(context, term, width, about),
        From::Gravity => gravity(context, term, about),
        From::Action => Some(Source::Action),
        From::Step => Some(Source::Step),
        From::First => Some(Source::First),
        From::Phase => phase(context, term, about),
        From::Output(output) => context
            .edges
            .find(&context.edges.outputs, &output)
            .map_err(|problem| context.problems.add(format!("{about}.from"), problem))
            .ok()
            .map(|edge| Source::Output(edge.clone())),
    }
}

fn phase(context: &mut Context, term: &robot::Term, about: &str) -> Option<Source> {
    let Some(phase) = &term.phase else {
        context.problems.add(
            format!("{about}.phase"),
            "is not given: `{ period_s = 0.8, elements = [{ of = \"sin\" }, { of = \"cos\" }] }`",
        );
        return None;
    };
    let period = context.robot.control_period_s?;
    if !(phase.period_s.is_finite() && phase.period_s > period) {
        context.problems.add(
            format!("{about}.phase.period_s"),
            format!(
                "is {}, it must be longer than a control step of {period} s",
                phase.period_s
            ),
        );
        return None;
    }
    let hands = phase.elements.iter().map(|hand| (hand.of, hand.ahead));
    Some(Source::Phase {
        turn: std::f64::consts::TAU * period / phase.period_s,
        hands: hands.collect(),
    })
}

fn sensor(context: &mut Context, term: &robot::Term, width: usize, about: &str) -> Option<Source> {
    let per_joint = term.per_joint == Some(true) || term.joints.is_some();
    let joints = term.joints.as_ref().unwrap_or(&context.joints.policy);
    let joints: Option<Vec<String>> = per_joint.then(|| joints.clone());
    if let Some(joints) = &joints
        && joints.len() != width
    {
        context.problems.add(
            about,
            format!(
                "has {width} elements, one for each joint, and there are {} joints",
                joints.len()
            ),
        );
        return None;
    }
    for joint in joints.iter().flatten() {
        if !context.joints.robot.contains(joint) {
            context.problems.add(
                format!("{about}.joints"),
                format!("names \"{joint}\", which is not one of the robot's joints"),
            );
        }
    }
    let order = match &joints {
        Some(joints) => context.joints.by_robot(joints),
        None => (0..width).collect(),
    };
    let names = match (&term.elements, &joints) {
        (Some(names), _) if names.len() == width => names.clone(),
        (Some(names), _) => {
            context.problems.add(
                format!("{about}.elements"),
                format!("has {} names, there are {width} elements", names.len()),
            );
            return None;
        }
        (None, Some(joints)) => joints.clone(),
        (None, None) if width == 1 => vec![String::new()],
        (None, None) => (0..width).map(|i| i.to_string()).collect(),
    };
    let names: Vec<String> = order
        .iter()
        .map(|&i| element(&term.name, &names[i]))
        .collect();
    let channel = channel(context, term, about)?;
    let first = match shared(context, channel, term, &names, about) {
        Shared::With(first) => first,
        Shared::Differently => return None,
        Shared::No => {
            if term.unit.is_none() {
                context.problems.add(
                    format!("{about}.unit"),
                    "is not given: the unit of the sensor's values, for example \"rad/s\"; \"1\" for none",
                );
            }
            let limits = limits(
                [term.min.as_ref(), term.max.as_ref()],
                width,
                about,
                term.unit.as_deref(),
                context.problems,
            );
            let (limits, unit) = (limits?, term.unit.as_ref()?);
            let elements = order.iter().zip(names).map(|(&i, name)| Element {
                name,
                unit: unit.clone(),
                min: limits.0[i],
                max: limits.1[i],
                joint: joints.as_ref().map(|joints| joints[i].clone()),
                interface: term.interface.clone(),
                stiffness: None,
                damping: None,
            });
            append(&mut context.channels[channel], &term.name, elements)
        }
    };
    let mut columns = vec![first; width];
    for (place, &i) in order.iter().enumerate() {
        columns[i] = first + place;
    }
    Some(Source::Columns { channel, columns })
}

fn gravity(context: &mut Context, term: &robot::Term, about: &str) -> Option<Source> {
    let Some(order) = context.robot.quaternion_order else {
        context.problems.add(
            "quaternion_order",
            "is not given: \"wxyz\" or \"xyzw\", how the orientation is given from which gravity follows",
        );
        return None;
    };
    let parts = match order {
        QuaternionOrder::Wxyz => ["w", "x", "y", "z"],
        QuaternionOrder::Xyzw => ["x", "y", "z", "w"],
    };
    let names = parts.map(|part| element(&term.name, part));
    let channel = channel(context, term, about)?;
    let first = match shared(context, channel, term, &names, about) {
        Shared::With(first) => first,
        Shared::Differently => return None,
        Shared::No => {
            context.channels[channel].quaternion_order = Some(order);
            let elements = names.into_iter().map(|name| Element {
                name,
                unit: "1".into(),
                min: -QUATERNION,
                max: QUATERNION,
                joint: None,
                interface: Some("orientation".into()),
                stiffness: None,
                damping: None,
            });
            append(&mut context.channels[channel], &term.name, elements)
        }
    };
    let at = |part: &str| first + parts.iter().position(|known| *known == part).unwrap_or(0);
    Some(Source::Gravity {
        channel,
        columns: ["w", "x", "y", "z"].map(at),
    })
}

/// Returns the channel that a term belongs to, a new one if need be.
fn channel(context: &mut Context, term: &robot::Term, about: &str) -> Option<usize> {
    let name = term.channel.as_deref().unwrap_or(OBSERVATION);
    let reserved = lads_compiler::family::RESERVED;
    if reserved.contains(&name) || name.contains('.') || name.is_empty() || !plain(name) {
        context.problems.add(
            format!("{about}.channel"),
            format!(
                "\"{name}\" cannot name a channel: letters, digits, `_` and `-` do, except {}",
                reserved.join(", ")
            ),
        );
        return None;
    }
    let known = context.channels.iter().position(|known| known.name == name);
    Some(known.unwrap_or_else(|| {
        context.channels.push(Channel {
            name: name.into(),
            elements: vec![],
            parts: vec![],
            quaternion_order: None,
        });
        context.channels.len() - 1
    }))
}

/// Relation of a term to the elements that another input reads already.
enum Shared {
    No,
    /// Equal elements, which begin at this element of the channel.
    With(usize),
    /// Other elements under the same name: a problem, which is reported.
    Differently,
}

fn shared(
    context: &mut Context,
    channel: usize,
    term: &robot::Term,
    names: &[String],
    about: &str,
) -> Shared {
    let known = &context.channels[channel];
    let Some(part) = known.parts.iter().find(|part| part.term == term.name) else {
        return Shared::No;
    };
    let elements = &known.elements[part.first..part.first + part.len];
    if elements.iter().map(|element| &element.name).eq(names) {
        return Shared::With(part.first);
    }
    let listed: Vec<&str> = elements
        .iter()
        .map(|element| element.name.as_str())
        .collect();
    context.problems.add(
        about,
        format!(
            "reads {} here and {} where the name stands first; give one of them another name",
            names.join(", "),
            listed.join(", ")
        ),
    );
    Shared::Differently
}

/// Appends a term's elements to those of the channel; returns where they begin.
fn append(channel: &mut Channel, term: &str, elements: impl Iterator<Item = Element>) -> usize {
    let first = channel.elements.len();
    channel.elements.extend(elements);
    channel.parts.push(Part {
        term: term.into(),
        first,
        len: channel.elements.len() - first,
    });
    first
}

fn element(term: &str, name: &str) -> String {
    if name.is_empty() {
        term.into()
    } else {
        format!("{term}.{name}")
    }
}

/// Checks for channels that a controller cannot take.
pub(super) fn check_channels(channels: &[Channel], problems: &mut Problems) {
    let most = lads_core::MAX_OBSERVATIONS;
    if channels.len() > most {
        let names: Vec<&str> = channels
            .iter()
            .map(|channel| channel.name.as_str())
            .collect();
        problems.add(
            "channel",
            format!(
                "there are {} channels ({}), a controller takes {most}; put terms together",
                channels.len(),
                names.join(", ")
            ),
        );
    }
    if channels.is_empty() && problems.is_empty() {
        problems.add(
            "term",
            "no term comes from the caller; a policy needs an observation",
        );
    }
    for channel in channels {
        let mut names = HashSet::new();
        for element in &channel.elements {
            if !names.insert(element.name.as_str()) {
                problems.add(
                    format!("channel `{}`", channel.name),
                    format!(
                        "has an element `{}` twice; give the terms or their elements other names",
                        element.name
                    ),
                );
            }
        }
    }
}
