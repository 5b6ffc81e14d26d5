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
    if rows.iter().any(|(_, row)| is_group(row)) {
        // Each is an input of the graph, by its name.
        for (input, row) in rows {
            let (mut terms, history) = group(row.pairs(), &commands, &mut refuse);
            for term in &mut terms {
                term.input = Some(input.clone());
            }
            robot.terms.extend(terms);
            robot.input.entry(input.clone()).or_default().history = history;
        }
    } else {
        (robot.terms, robot.history) = group(rows, &commands, &mut refuse);
    }
    said
}

/// Switches of a group, which stand among its terms.
const TIME_MAJOR: &str = "use_gym_history";
const SCALE_FIRST: &str = "scale_first";

/// Returns whether a row of the observations holds terms, and is none itself.
fn is_group(row: &Value) -> bool {
    let is_term = |(name, value): &(String, Value)| name != "params" && !value.pairs().is_empty();
    row.pairs().iter().any(is_term)
}

/// Reads the terms that one input of the graph is made of, and how their history lies there.
fn group(
    rows: &[(String, Value)],
    commands: &Value,
    refuse: &mut impl FnMut(&str, &str),
) -> (Vec<Term>, Option<History>) {
    let switch = |name: &str| {
        rows.iter()
            .any(|row| *row == (name.to_owned(), Value::Bool(true)))
    };
    let scale_first = switch(SCALE_FIRST);
    let rows_of_terms = rows
        .iter()
        .filter(|(name, _)| ![TIME_MAJOR, SCALE_FIRST].contains(&name.as_str()));
    let mut terms = vec![];
    for (name, row) in rows_of_terms {
        let term = term(name, row, commands, refuse);
        let first = row
            .get(SCALE_FIRST)
            .map_or(scale_first, |own| *own == Value::Bool(true));
        if first && term.clip.is_some() && term.scale.is_some() {
            refuse(
                &format!("{name}, {SCALE_FIRST}"),
                "order that a term has here, which clips first: say the clip in the description, divided by the scale, and take it out here",
            );
        }
        terms.push(term);
    }
    let longest = terms.iter().filter_map(|term| term.history).max();
    let history = longest.filter(|&length| length > 1).map(|_| History {
        length: None,
        layout: Some(if switch(TIME_MAJOR) {
            Layout::Time
        } else {
            Layout::Term
        }),
        order: Some(Order::OldestFirst),
        start: Some(Start::First),
    });
    (terms, history)
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
    if endless(value) {
        return None;
    }
    let found = bounds(value);
    if found.is_none() {
        refuse(name, "pair of numbers, nor a list of such pairs");
    }
    found
}

/// Returns whether a clip, `[low, high]` or a list of such pairs, has no bounds at all.
fn endless(value: &Value) -> bool {
    let is = |side: &Value, infinite: f64, text: &str| {
        side.number() == Some(infinite) || side.text() == Some(text)
    };
    match value.list() {
        Some([low, high]) if low.list().is_none() => {
            is(low, f64::NEG_INFINITY, "-.inf") && is(high, f64::INFINITY, ".inf")
        }
        Some(pairs) => !pairs.is_empty() && pairs.iter().all(endless),
        None => false,
    }
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
    fn switches_groups_and_clips_without_bounds_are_read() {
        let read = |text: &str| {
            let mut problems = Problems::default();
            let said = deploy(text, "deploy.yaml", &mut problems);
            (said.robot, problems.to_string())
        };
        let term = "{scale: 2.0, clip: [-.inf, .inf], history_length: 5}";
        let (robot, problems) = read(&format!(
            "observations:\n  use_gym_history: true\n  a: {term}"
        ));
        assert_eq!(problems, "");
        assert_eq!((robot.terms.len(), &robot.terms[0].clip), (1, &None));
        assert_eq!(robot.history.and_then(|it| it.layout), Some(Layout::Time));
        let (robot, problems) = read(&format!(
            "observations:\n  obs:\n    use_gym_history: false\n    scale_first: false\n    a: {term}\n  map:\n    b: {{params: {{height: 3}}}}"
        ));
        assert_eq!(problems, "");
        let inputs: Vec<_> = robot
            .terms
            .iter()
            .map(|term| term.input.as_deref())
            .collect();
        assert_eq!(inputs, [Some("obs"), Some("map")]);
        let layout = |name: &str| robot.input[name].history.as_ref().and_then(|it| it.layout);
        assert_eq!((layout("obs"), layout("map")), (Some(Layout::Term), None));
        let first = "observations: {scale_first: true, a: {scale: 2.0, clip: [-1, 1]}}";
        let (_, problems) = read(first);
        assert!(problems.contains("a, scale_first"), "{problems}");
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
