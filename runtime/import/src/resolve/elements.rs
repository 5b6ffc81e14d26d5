//! Resolves joints, and lists with a number for each element.

use std::collections::{HashMap, HashSet};

use crate::problem::Problems;
use crate::robot::{Clip, Each, Robot};

/// Joints in the policy's order and in the robot's.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Joints {
    /// Names in the policy's order.
    pub policy: Vec<String>,
    /// Names in the robot's order.
    pub robot: Vec<String>,
}

impl Joints {
    pub fn of(robot: &Robot, problems: &mut Problems) -> Self {
        let mut policy = robot.joints.clone().unwrap_or_default();
        let order = robot.wired_joints.clone();
        if let (true, Some(order), Some(map)) = (policy.is_empty(), &order, &robot.joint_ids_map) {
            let named: Option<Vec<String>> = map.iter().map(|&id| order.get(id).cloned()).collect();
            match named {
                Some(named) => policy = named,
                None => problems.add(
                    "robot_joints",
                    format!(
                        "has {} names, and `joint_ids_map` asks for number {}; name all of the robot's joints in its own order",
                        order.len(),
                        map.iter().max().unwrap_or(&0)
                    ),
                ),
            }
        } else if policy.is_empty() && robot.joint_ids_map.is_some() {
            problems.add(
                "robot_joints",
                "is not given: the names of all of the robot's joints in its own order, in which `joint_ids_map` numbers them",
            );
        }
        for (field, names) in [
            ("joints", &policy),
            ("robot_joints", order.as_ref().unwrap_or(&vec![])),
        ] {
            let mut known = HashSet::new();
            for name in names {
                if name.trim().is_empty() || !known.insert(name.as_str()) {
                    problems.add(field, format!("names \"{name}\" twice, or not at all"));
                }
            }
        }
        let robot = match order {
            None => policy.clone(),
            Some(order) => {
                let known: HashSet<&String> = order.iter().collect();
                for name in policy.iter().filter(|&name| !known.contains(name)) {
                    problems.add(
                        "robot_joints",
                        format!("misses \"{name}\", which the policy moves"),
                    );
                }
                order
            }
        };
        Self { policy, robot }
    }

    /// Returns the indices of joints in the policy's order, sorted by the robot's order.
    pub fn by_robot(&self, names: &[String]) -> Vec<usize> {
        let mut order: Vec<usize> = (0..names.len()).collect();
        let places = self.robot.iter().enumerate().rev();
        let places: HashMap<&String, usize> = places.map(|(i, name)| (name, i)).collect();
        order.sort_by_key(|&i| places.get(&names[i]).copied().unwrap_or(usize::MAX));
        order
    }
}

/// Returns a number for each element. A list of another length, or a value that is not a number, is
/// a problem.
pub(crate) fn spread(
    each: Option<&Each>,
    width: usize,
    about: &str,
    problems: &mut Problems,
) -> Option<Vec<f64>> {
    let values = match each? {
        Each::One(value) => vec![*value; width],
        Each::Many(values) if values.len() == width => values.clone(),
        Each::Many(values) => {
            problems.add(
                about,
                format!("has {} numbers, there are {width} elements", values.len()),
            );
            return None;
        }
    };
    if let Some(value) = values
        .iter()
        .find(|value| !value.is_finite() || value.abs() > 1e30)
    {
        problems.add(
            about,
            format!("holds {value}, which is not a finite number"),
        );
        return None;
    }
    Some(values)
}

/// Returns the bounds of a clip for each element.
pub(crate) fn bounds(
    clip: Option<&Clip>,
    width: usize,
    about: &str,
    problems: &mut Problems,
) -> Option<(Vec<f64>, Vec<f64>)> {
    let (low, high) = match clip? {
        Clip::Around(bound) => (Each::One(-bound), Each::One(*bound)),
        Clip::Between([low, high]) => (low.clone(), high.clone()),
    };
    let low = spread(Some(&low), width, about, problems)?;
    let high = spread(Some(&high), width, about, problems)?;
    if let Some((low, high)) = low.iter().zip(&high).find(|(low, high)| low >= high) {
        problems.add(about, format!("is {low} to {high}, which is not a range"));
        return None;
    }
    Some((low, high))
}

/// Returns the smallest and largest value of each element.
pub(crate) fn limits(
    [min, max]: [Option<&Each>; 2],
    width: usize,
    about: &str,
    unit: Option<&str>,
    problems: &mut Problems,
) -> Option<(Vec<f64>, Vec<f64>)> {
    let unit = unit.map_or(String::new(), |unit| format!(", in {unit}"));
    let mut limit = |each: Option<&Each>, field: &str, what: &str| {
        let about = format!("{about}.{field}");
        if each.is_none() {
            problems.add(
                &about,
                format!("is not given: the {what} value of each of {width} elements, or one for all{unit}"),
            );
        }
        spread(each, width, &about, problems)
    };
    let (low, high) = (limit(min, "min", "smallest"), limit(max, "max", "largest"));
    let (low, high) = (low?, high?);
    if let Some(i) = (0..width).find(|&i| low[i] >= high[i]) {
        problems.add(
            format!("{about}.min"),
            format!("element {i} is {}, not below its max {}", low[i], high[i]),
        );
        return None;
    }
    Some((low, high))
}
