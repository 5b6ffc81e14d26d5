//! What a policy file and the files beside it say about the robot, in the form in which a person says it.
//!
//! Read are the flat metadata of Isaac Lab and mjlab exports (comma-separated), JSON metadata of the same meaning, `deploy.yaml` of
//! unitree's tools, and JSON manifests with the same names. Only the names listed here are read: paths, robot descriptions and whatever
//! else an author's machine has left in a file go nowhere. What can fail: a value is not what its name says, which is a problem.

use crate::problem::Problems;
use crate::robot::{Clip, Each, History, Layout, Order, Robot, Start, Term};
use crate::yaml::Value;

/// What one source says.
#[derive(Debug, Default)]
pub(crate) struct Said {
    pub robot: Robot,
    /// Names that were understood, for the notes.
    pub used: Vec<String>,
}

/// Names under which exporters put the same thing.
const JOINTS: [&str; 3] = ["joint_names", "dof_names", "joints"];
const STIFFNESS: [&str; 4] = ["joint_stiffness", "stiffness", "kp", "kps"];
const DAMPING: [&str; 4] = ["joint_damping", "damping", "kd", "kds"];
const POSTURE: [&str; 4] = [
    "default_joint_pos",
    "default_dof_pos",
    "default_joint_angles",
    "default_angles",
];
const PERIOD: [&str; 4] = ["step_dt", "control_dt", "policy_dt", "control_period_s"];
const RATE: [&str; 4] = [
    "control_frequency",
    "control_freq",
    "control_hz",
    "policy_hz",
];

/// Metadata of a model file: keys and texts.
pub(crate) fn metadata<'m>(
    pairs: impl Iterator<Item = (&'m str, &'m str)>,
    problems: &mut Problems,
) -> Said {
    let values = pairs.map(|(key, text)| (key.to_owned(), value(text)));
    flat(&Value::Map(values.collect()), "metadata", problems)
}

/// JSON where it is JSON, else a comma-separated list of numbers or of names.
fn value(text: &str) -> Value {
    let text = text.trim();
    if text.starts_with(['[', '{']) {
        if let Ok(json) = serde_json::from_str::<serde_json::Value>(text) {
            return json.into();
        }
        return Value::Text(text.into());
    }
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let numbers: Option<Vec<Value>> = parts
        .iter()
        .map(|part| part.parse::<f64>().ok().map(Value::Number))
        .collect();
    let texts = || parts.iter().map(|&part| Value::Text(part.into())).collect();
    Value::List(numbers.unwrap_or_else(texts))
}

/// A JSON manifest.
pub(crate) fn manifest(text: &str, source: &str, problems: &mut Problems) -> Said {
    match serde_json::from_str::<serde_json::Value>(text) {
        Ok(json) => flat(&json.into(), source, problems),
        Err(error) => {
            problems.add(source, format!("is no JSON: {error}"));
            Said::default()
        }
    }
}

/// Values under the names that exporters use.
fn flat(values: &Value, source: &str, problems: &mut Problems) -> Said {
    let mut said = Said::default();
    let mut find = |names: &[&str]| {
        let name = names.iter().find(|name| values.get(name).is_some())?;
        said.used.push((*name).into());
        Some(((*name).to_owned(), values.get(name)?.clone()))
    };
    let (joints, stiffness, damping) = (find(&JOINTS), find(&STIFFNESS), find(&DAMPING));
    let (posture, scale, terms) = (
        find(&POSTURE),
        find(&["action_scale"]),
        find(&["observation_names"]),
    );
    let (period, rate) = (find(&PERIOD), find(&RATE));

    let mut refuse = |name: &str, wanted: &str| {
        problems.add(format!("{source}, `{name}`"), format!("is no {wanted}"));
    };
    let robot = &mut said.robot;
    if let Some((name, value)) = joints {
        robot.joints = texts(&value);
        if robot.joints.is_none() {
            refuse(&name, "list of names");
        }
    }
    let known = robot.joints.clone();
    let mut numbers = |found: Option<(String, Value)>| {
        let (name, value) = found?;
        let each = each(&value, known.as_deref());
        if each.is_none() {
            refuse(&name, "number, list of numbers, or number for each joint");
        }
        each.map(|each| (name, each))
    };
    let (stiffness, damping) = (numbers(stiffness), numbers(damping));
    robot.action.scale = numbers(scale).map(|(_, each)| each);
    robot.default_position = numbers(posture).map(|(_, each)| match each {
        Each::Many(values) => values,
        Each::One(value) => vec![value],
    });
    robot.control_period_s = numbers(period).and_then(|(_, each)| single(&each));
    let rate = numbers(rate).and_then(|(_, each)| single(&each));
    if robot.control_period_s.is_none() {
        robot.control_period_s = rate.filter(|&rate| rate > 0.0).map(|rate| 1.0 / rate);
    }
    for (found, field, place) in [
        (stiffness, "stiffness", &mut robot.action.stiffness),
        (damping, "damping", &mut robot.action.damping),
    ] {
        let Some((name, each)) = found else { continue };
        if rounded_away(&each) {
            problems.add(
                format!("{source}, `{name}`"),
                format!("has been rounded until nothing is left of it (all 1, or a 0): say `action.{field}`"),
            );
        } else {
            *place = Some(each);
        }
    }
    if let Some((name, value)) = terms {
        match texts(&value) {
            Some(names) => robot.terms = names.into_iter().map(named).collect(),
            None => problems.add(format!("{source}, `{name}`"), "is no list of names"),
        }
    }
    said
}

/// Whether gains were printed with too few decimals.
fn rounded_away(each: &Each) -> bool {
    let values = match each {
        Each::One(value) => std::slice::from_ref(value),
        Each::Many(values) => values,
    };
    values.contains(&0.0) || (values.len() > 1 && values.iter().all(|&value| value == 1.0))
}

fn named(name: String) -> Term {
    Term {
        name,
        ..Term::default()
    }
}

fn texts(value: &Value) -> Option<Vec<String>> {
    value
        .list()?
        .iter()
        .map(|value| value.text().map(str::to_owned))
        .collect()
}

fn single(each: &Each) -> Option<f64> {
    match each {
        Each::One(value) => Some(*value),
        Each::Many(values) => match values[..] {
            [value] => Some(value),
            _ => None,
        },
    }
}

/// A number, a list of them, or a map from each joint to one.
fn each(value: &Value, joints: Option<&[String]>) -> Option<Each> {
    if let Some(number) = value.number() {
        return Some(Each::One(number));
    }
    if let Some(numbers) = value.numbers() {
        return Some(match numbers[..] {
            [number] => Each::One(number),
            _ => Each::Many(numbers),
        });
    }
    let numbers: Option<Vec<f64>> = joints?
        .iter()
        .map(|joint| value.get(joint)?.number())
        .collect();
    numbers
        .filter(|numbers| !numbers.is_empty())
        .map(Each::Many)
}

/// `deploy.yaml`: positions, scales and offsets are in the policy's order, gains in the robot's.
pub(crate) fn deploy(text: &str, source: &str, problems: &mut Problems) -> Said {
    let document = match crate::yaml::read(text) {
        Ok(document) => document,
        Err(problem) => {
            problems.add(source, problem);
            return Said::default();
        }
    };
    let mut said = Said::default();
    let robot = &mut said.robot;
    let mut used = |name: &str| {
        let value = document.get(name)?;
        said.used.push(name.into());
        Some(value)
    };
    robot.control_period_s = used("step_dt").and_then(Value::number);
    robot.default_position = used("default_joint_pos").and_then(Value::numbers);
    let map: Option<Vec<usize>> = used("joint_ids_map")
        .and_then(Value::numbers)
        .map(|ids| ids.iter().map(|&id| id as usize).collect());
    let by_policy = |values: Vec<f64>| -> Option<Each> {
        let Some(map) = &map else {
            return Some(Each::Many(values));
        };
        // The robot's joints that the policy moves, in the robot's order.
        let mut sorted = map.clone();
        sorted.sort_unstable();
        let place = |id| sorted.iter().position(|known| known == id);
        let values: Option<Vec<f64>> = map
            .iter()
            .map(|id| values.get(place(id)?).copied())
            .collect();
        values.map(Each::Many)
    };
    robot.action.stiffness = used("stiffness")
        .and_then(Value::numbers)
        .and_then(by_policy);
    robot.action.damping = used("damping").and_then(Value::numbers).and_then(by_policy);
    robot.joint_ids_map.clone_from(&map);
    let commands = used("commands").cloned().unwrap_or_default();
    if let Some(action) = used("actions").and_then(|actions| actions.get("JointPositionAction")) {
        robot.action.scale = action.get("scale").and_then(|value| each(value, None));
        robot.action.offset = action.get("offset").and_then(|value| each(value, None));
        robot.action.interface = Some("position".into());
        robot.action.unit = Some("rad".into());
        // The clip of a processed action is what its limits are.
        if let Some((low, high)) = action.get("clip").and_then(bounds) {
            (robot.action.min, robot.action.max) = (Some(low), Some(high));
        }
    }
    let terms = used("observations").map_or(&[][..], Value::pairs);
    for (name, row) in terms {
        let mut term = named(name.clone());
        term.scale = row.get("scale").and_then(|value| each(value, None));
        if let Some((low, high)) = row.get("clip").and_then(bounds) {
            term.clip = Some(Clip::Between([low, high]));
        }
        term.history = row
            .get("history_length")
            .and_then(Value::number)
            .map(|length| length.max(1.0) as usize);
        let command = row
            .get("params")
            .and_then(|params| params.get("command_name"))
            .and_then(Value::text);
        if let Some(ranges) = command
            .and_then(|command| commands.get(command))
            .and_then(|command| command.get("ranges"))
        {
            ranged(&mut term, ranges);
        }
        robot.terms.push(term);
    }
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

/// `[low, high]`, or a list of such pairs.
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

/// Names and limits of a command's elements; one without a range is not given to the policy.
fn ranged(term: &mut Term, ranges: &Value) {
    let rows: Vec<(&String, Vec<f64>)> = ranges
        .pairs()
        .iter()
        .filter_map(|(name, range)| Some((name, range.numbers()?)))
        .filter(|(_, range)| range.len() == 2)
        .collect();
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
    fn flat_metadata_is_read_and_rounded_gains_are_told() {
        let pairs = [
            ("run_path", "/home/somebody/logs/run"),
            ("joint_names", "hip, knee"),
            ("joint_stiffness", "0.000,0.000"),
            ("joint_damping", "0.5,0.25"),
            ("default_joint_pos", "0.100,-0.200"),
            ("observation_names", "base_ang_vel,joint_pos"),
            ("action_scale", "0.25"),
        ];
        let mut problems = Problems::default();
        let said = metadata(pairs.into_iter(), &mut problems);
        let robot = said.robot;
        assert_eq!(robot.joints, Some(vec!["hip".into(), "knee".into()]));
        assert_eq!(robot.default_position, Some(vec![0.1, -0.2]));
        assert_eq!(robot.action.damping, Some(Each::Many(vec![0.5, 0.25])));
        assert_eq!(robot.action.scale, Some(Each::One(0.25)));
        assert_eq!(robot.terms.len(), 2);
        assert!(!said.used.iter().any(|name| name == "run_path"));
        let told = problems.to_string();
        assert!(
            told.contains("joint_stiffness") && told.contains("action.stiffness"),
            "{told}"
        );
        assert_eq!(problems.all().len(), 1);
    }

    #[test]
    fn json_metadata_is_read() {
        let pairs = [
            ("dof_names", r#"["hip", "knee"]"#),
            ("kp", r#"{"knee": 30.0, "hip": 20.0}"#),
            ("robot_urdf", "<robot/>"),
        ];
        let mut problems = Problems::default();
        let said = metadata(pairs.into_iter(), &mut problems);
        assert_eq!(
            said.robot.action.stiffness,
            Some(Each::Many(vec![20.0, 30.0]))
        );
        assert!(problems.is_empty(), "{problems}");
    }

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
}
