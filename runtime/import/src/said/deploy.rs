//! Reads `deploy.yaml` of unitree's tools.
//!
//! What can fail: the text is not YAML, or a field does not fit its name; each is a problem with
//! its name.

use super::{Said, each, named, single};
use crate::problem::Problems;
use crate::robot::{Clip, Each, History, Layout, Order, Start, Term};
use crate::yaml::Value;

/// Reads a `deploy.yaml`: positions, scales and offsets are in the policy's order, gains in the
/// robot's.
pub(crate) fn deploy(text: &str, source: &str, problems: &mut Problems) -> Said {
    let document = match crate::yaml::read(text) {
        Ok(document) => document,
        Err(problem) => {
            problems.add(source, problem);
            return Said::default();
        }
    };
    if !matches!(document, Value::Map(_) | Value::Null) {
        problems.add(source, "holds no fields");
        return Said::default();
    }
    let mut said = Said::default();
    let robot = &mut said.robot;
    let mut used = |name: &str| {
        let value = document.get(name).filter(|value| **value != Value::Null)?;
        said.used.push(name.into());
        Some(value)
    };
    let mut refuse = |name: &str, wanted: &str| {
        problems.add(format!("{source}, `{name}`"), format!("is no {wanted}"));
    };
    let mut numbers = |name: &str, value: Option<&Value>| {
        let value = value.filter(|value| **value != Value::Null)?;
        let found = each(value, None);
        if found.is_none() {
            refuse(name, "number or list of numbers");
        }
        found
    };
    let many = |each: Each| match each {
        Each::One(value) => vec![value],
        Each::Many(values) => values,
    };
    robot.control_period_s = numbers("step_dt", used("step_dt")).and_then(|each| single(&each));
    let posture = used("default_joint_pos");
    robot.default_position = numbers("default_joint_pos", posture).map(many);
    let ids = used("joint_ids_map");
    let ids = numbers("joint_ids_map", ids).map(many);
    let gains = ["stiffness", "damping"].map(|name| numbers(name, used(name)).map(many));
    let map: Option<Vec<usize>> = ids.as_ref().and_then(|ids| {
        let whole = |&id: &f64| (id >= 0.0 && id.fract() == 0.0 && id < 1e6).then_some(id as usize);
        ids.iter().map(whole).collect()
    });
    let actions = used("actions");
    let action = actions.and_then(|actions| actions.get("JointPositionAction"));
    let (scale, offset) = (
        action.and_then(|action| numbers("scale", action.get("scale"))),
        action.and_then(|action| numbers("offset", action.get("offset"))),
    );
    if ids.is_some() && map.is_none() {
        refuse("joint_ids_map", "list of indices");
    }
    let [stiffness, damping] = gains.map(|values| {
        let values = values?;
        let sorted = by_policy(map.as_deref(), &values);
        if sorted.is_none() {
            refuse(
                "stiffness` or `damping",
                "list with a number for each joint of `joint_ids_map`",
            );
        }
        sorted.map(Each::Many)
    });
    (robot.action.stiffness, robot.action.damping) = (stiffness, damping);
    robot.joint_ids_map.clone_from(&map);
    let commands = used("commands").cloned().unwrap_or_default();
    if let Some(action) = action {
        robot.action.scale = scale;
        robot.action.offset = offset;
        robot.action.interface = Some("position".into());
        robot.action.unit = Some("rad".into());
        // The clip of a processed action is what its limits are.
        if let Some((low, high)) = clip("actions, clip", action, &mut refuse) {
            (robot.action.min, robot.action.max) = (Some(low), Some(high));
        }
    }
    let rows = used("observations").map_or(&[][..], Value::pairs);
    robot.terms = rows
        .iter()
        .map(|(name, row)| term(name, row, &commands, &mut refuse))
        .collect();
    let longest = robot.terms.iter().filter_map(|term| term.history).max();
    if longest.is_some_and(|length| length > 1) {
        robot.history = Some(History {
            length: None,
            layout: Some(Layout::Term),
            order: Some(Order::OldestFirst),
            start: Some(Start::First),
        });
    }
    said
}

/// Reads a term of the policy's input.
fn term(name: &str, row: &Value, commands: &Value, refuse: &mut impl FnMut(&str, &str)) -> Term {
    let mut term = named(name.into());
    if let Some(scale) = row.get("scale").filter(|scale| **scale != Value::Null) {
        term.scale = each(scale, None);
        if term.scale.is_none() {
            refuse(&format!("{name}, scale"), "number or list of numbers");
        }
    }
    if let Some((low, high)) = clip(&format!("{name}, clip"), row, refuse) {
        term.clip = Some(Clip::Between([low, high]));
    }
    if let Some(length) = row
        .get("history_length")
        .filter(|length| **length != Value::Null)
    {
        // 0 and 1 both mean no history.
        term.history = length
            .number()
            .filter(|length| length.fract() == 0.0 && (0.0..=1e6).contains(length))
            .map(|length| length.max(1.0) as usize);
        if term.history.is_none() {
            refuse(&format!("{name}, history_length"), "whole number of steps");
        }
    }
    let command = row
        .get("params")
        .and_then(|params| params.get("command_name"))
        .and_then(Value::text);
    if let Some(ranges) = command
        .and_then(|command| commands.get(command))
        .and_then(|command| command.get("ranges"))
    {
        ranged(&mut term, ranges, refuse);
    }
    term
}

/// Returns gains in the policy's order. The given gains are in the order of the robot's joints that
/// the policy moves.
fn by_policy(map: Option<&[usize]>, values: &[f64]) -> Option<Vec<f64>> {
    let Some(map) = map else {
        return Some(values.to_vec());
    };
    let mut sorted = map.to_vec();
    sorted.sort_unstable();
    let place = |id: &usize| sorted.iter().position(|known| known == id);
    let gains = map.iter().map(|id| values.get(place(id)?).copied());
    gains
        .collect::<Option<Vec<f64>>>()
        .filter(|gains| gains.len() == values.len())
}

/// Reads the field `clip` of a row, if it has one.
fn clip(name: &str, row: &Value, refuse: &mut impl FnMut(&str, &str)) -> Option<(Each, Each)> {
    let value = row.get("clip").filter(|value| **value != Value::Null)?;
    let found = bounds(value);
    if found.is_none() {
        refuse(name, "pair of numbers, nor a list of such pairs");
    }
    found
}

/// Reads bounds `[low, high]`, or a list of such pairs.
fn bounds(value: &Value) -> Option<(Each, Each)> {
    if let Some(&[low, high]) = value.numbers().as_deref() {
        return Some((Each::One(low), Each::One(high)));
    }
    let pairs = value.list()?.iter().map(Value::numbers);
    let pairs: Option<Vec<(f64, f64)>> = pairs
        .map(|pair| match pair.as_deref() {
            Some(&[low, high]) => Some((low, high)),
            _ => None,
        })
        .collect();
    let (low, high) = pairs?.into_iter().unzip();
    Some((Each::Many(low), Each::Many(high)))
}

/// Reads names and limits of a command's elements; one without a range is not given to the policy.
fn ranged(term: &mut Term, ranges: &Value, refuse: &mut impl FnMut(&str, &str)) {
    let mut rows: Vec<(&String, [f64; 2])> = vec![];
    for (name, range) in ranges.pairs() {
        match range.numbers().as_deref() {
            Some(&[low, high]) => rows.push((name, [low, high])),
            _ if *range == Value::Null => {}
            _ => refuse(&format!("range of {name}"), "pair of numbers, or null"),
        }
    }
    if rows.is_empty() {
        return;
    }
    term.elements = Some(rows.iter().map(|(name, _)| (*name).clone()).collect());
    term.min = Some(Each::Many(rows.iter().map(|(_, range)| range[0]).collect()));
    term.max = Some(Each::Many(rows.iter().map(|(_, range)| range[1]).collect()));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deploy_files_are_read_in_the_orders_that_they_use() {
        let text = "joint_ids_map: [2, 0]\nstep_dt: 0.02\nstiffness: [10, 20]\ndefault_joint_pos: [0.5, 0.6]\n\
            commands: {base: {ranges: {x: [-1, 1], heading: null}}}\n\
            actions: {JointPositionAction: {scale: [0.25, 0.5], offset: [0.5, 0.6], clip: [[-1, 1], [-2, 2]]}}\n\
            observations:\n  zeta: {scale: [1, 1, 1], clip: null, history_length: 5}\n\
            \x20 alpha: {scale: 2.0, clip: [-3, 3], history_length: 5, params: {command_name: base, slice: !!python/object/apply:builtins.slice [1, 2]}}\n";
        let mut problems = Problems::default();
        let said = deploy(text, "deploy.yaml", &mut problems);
        assert!(problems.is_empty(), "{problems}");
        let robot = said.robot;
        assert_eq!(robot.control_period_s, Some(0.02));
        // The policy's first joint is the robot's last.
        assert_eq!(robot.action.stiffness, Some(Each::Many(vec![20.0, 10.0])));
        assert_eq!(robot.action.max, Some(Each::Many(vec![1.0, 2.0])));
        let names: Vec<&str> = robot.terms.iter().map(|term| term.name.as_str()).collect();
        assert_eq!(
            names,
            ["zeta", "alpha"],
            "the graph reads them in the file's order"
        );
        assert_eq!(robot.terms[1].elements, Some(vec!["x".into()]));
        assert_eq!(robot.history.expect("a history").start, Some(Start::First));
    }

    #[test]
    fn what_is_there_and_cannot_be_read_is_told() {
        for (text, about) in [
            ("step_dt: fast", "step_dt"),
            ("joint_ids_map: [0, -1]", "joint_ids_map"),
            ("joint_ids_map: [1, 0]\nstiffness: [1, 2, 3]", "stiffness"),
            ("actions: {JointPositionAction: {clip: [1]}}", "clip"),
            ("observations: {a: {scale: big}}", "a, scale"),
            (
                "observations: {a: {history_length: many}}",
                "a, history_length",
            ),
            (
                "observations: {a: {history_length: 2.5}}",
                "a, history_length",
            ),
            (
                "commands: {base: {ranges: {x: [1]}}}\nobservations: {a: {params: {command_name: base}}}",
                "range of x",
            ),
        ] {
            let mut problems = Problems::default();
            deploy(text, "deploy.yaml", &mut problems);
            let told = problems.to_string();
            assert!(told.contains(about), "{text}: {told}");
        }
    }
}
