//! Reads descriptions of the robot from a policy file and the files beside it, in the form in which
//! a person writes them.
//!
//! The sources are the flat metadata of Isaac Lab and mjlab exports (comma-separated), JSON
//! metadata of the same meaning, `deploy.yaml` of unitree's tools, and JSON manifests with the same
//! names. Only the names listed here are read: paths, robot descriptions and anything else that an
//! author's machine has left in a file are ignored. What can fail: a value does not fit its name,
//! which is a problem.

mod deploy;
mod terms;

use crate::problem::Problems;
use crate::robot::{Each, Robot, Term};
use crate::yaml::Value;

pub(crate) use deploy::deploy;

/// Description from one source.
#[derive(Debug, Default)]
pub(crate) struct Said {
    pub robot: Robot,
    /// Names that were understood, for the notes.
    pub used: Vec<String>,
    /// Gains that were printed with too few decimals, with the source's names for them.
    pub lost: Vec<(String, Gain)>,
}

/// A gain of the joints' own controllers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Gain {
    Stiffness,
    Damping,
}

/// Names that exporters use for the same field.
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

/// Reads the metadata of a model file, keys and texts, beside the terms that a person described.
pub(crate) fn metadata<'m>(
    pairs: impl Iterator<Item = (&'m str, &'m str)>,
    own: &[Term],
    problems: &mut Problems,
) -> Said {
    let values = pairs.map(|(key, text)| (key.to_owned(), value(text)));
    flat(&Value::Map(values.collect()), own, "metadata", problems)
}

/// Parses JSON if the text is JSON, else a comma-separated list of numbers or of names.
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

/// Reads a JSON manifest.
pub(crate) fn manifest(text: &str, own: &[Term], source: &str, problems: &mut Problems) -> Said {
    match serde_json::from_str::<serde_json::Value>(text) {
        Ok(json) if json.is_object() => flat(&json.into(), own, source, problems),
        Ok(_) => {
            problems.add(source, "holds no fields");
            Said::default()
        }
        Err(error) => {
            problems.add(source, format!("is not JSON: {error}"));
            Said::default()
        }
    }
}

/// Reads values under the names that exporters use.
fn flat(values: &Value, own: &[Term], source: &str, problems: &mut Problems) -> Said {
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
    for (found, gain, place) in [
        (stiffness, Gain::Stiffness, &mut robot.action.stiffness),
        (damping, Gain::Damping, &mut robot.action.damping),
    ] {
        match found {
            Some((name, each)) if rounded_away(&each) => said.lost.push((name, gain)),
            Some((_, each)) => *place = Some(each),
            None => {}
        }
    }
    if let Some((name, value)) = terms {
        match texts(&value) {
            Some(names) => robot.terms = names.into_iter().map(named).collect(),
            None => problems.add(format!("{source}, `{name}`"), "is not a list of names"),
        }
    }
    terms::read(&mut said, values, own, source, problems);
    said
}

/// Returns whether gains were printed with too few decimals.
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

/// Reads a number, a list of them, or a map from each joint to one.
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
        let said = metadata(pairs.into_iter(), &[], &mut problems);
        let robot = said.robot;
        assert_eq!(robot.joints, Some(vec!["hip".into(), "knee".into()]));
        assert_eq!(robot.default_position, Some(vec![0.1, -0.2]));
        assert_eq!(robot.action.damping, Some(Each::Many(vec![0.5, 0.25])));
        assert_eq!(robot.action.scale, Some(Each::One(0.25)));
        assert_eq!(robot.terms.len(), 2);
        assert!(!said.used.iter().any(|name| name == "run_path"));
        assert_eq!(said.lost, [("joint_stiffness".into(), Gain::Stiffness)]);
        assert!(problems.is_empty(), "{problems}");
    }

    #[test]
    fn json_metadata_is_read() {
        let pairs = [
            ("dof_names", r#"["hip", "knee"]"#),
            ("kp", r#"{"knee": 30.0, "hip": 20.0}"#),
            ("robot_urdf", "<robot/>"),
        ];
        let mut problems = Problems::default();
        let said = metadata(pairs.into_iter(), &[], &mut problems);
        assert_eq!(
            said.robot.action.stiffness,
            Some(Each::Many(vec![20.0, 30.0]))
        );
        assert!(problems.is_empty(), "{problems}");
    }
}
