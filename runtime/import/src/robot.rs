//! Description of a robot and its policy: the TOML file by a person, and the policy's neighbour
//! files in the same form.
//!
//! Every field may be missing here; [`resolve`](crate::resolve) decides whether the description is
//! complete. What can fail: the text is not TOML, or a field has an unknown name or type, which is
//! reported with its line.

use std::collections::BTreeMap;

use serde::Deserialize;

/// A number for each element, or one for all of them.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
pub(crate) enum Each {
    One(f64),
    Many(Vec<f64>),
}

impl Each {
    pub fn len(&self) -> Option<usize> {
        match self {
            Each::One(_) => None,
            Each::Many(values) => Some(values.len()),
        }
    }
}

/// Bounds of a clip: `[low, high]` of numbers or of lists, or one number for both sides.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
pub(crate) enum Clip {
    Around(f64),
    Between([Each; 2]),
}

#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Environment {
    pub id: String,
    pub version: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum QuaternionOrder {
    Wxyz,
    Xyzw,
}

/// Order in which a graph reads the values of several steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Layout {
    /// All steps of the first term, then of the next.
    Term,
    /// All terms of one step, then of the next.
    Time,
    /// All steps of the first element, then of the next.
    Element,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Order {
    OldestFirst,
    NewestFirst,
}

/// Values of steps before the first one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Start {
    /// Zeros, inserted where the graph reads them.
    Zero,
    /// Copies of the first step.
    First,
}

/// Number of the last steps that the graph reads, and their layout.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct History {
    pub length: Option<usize>,
    pub layout: Option<Layout>,
    pub order: Option<Order>,
    pub start: Option<Start>,
}

/// Options of a whole input of the graph.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Input {
    pub clip: Option<Clip>,
    pub history: Option<History>,
}

/// Source of the values of a term.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum From {
    /// Values that the caller gives, unchanged.
    Sensor,
    /// Direction of gravity in the body's frame, from the caller's orientation.
    Gravity,
    /// Last raw action of the policy.
    Action,
    /// Clock with the period of a gait.
    Phase,
    /// Number of control steps since the episode began.
    Step,
    /// Indicator that is 1 in the first step of an episode, 0 afterwards.
    First,
    /// Value of another output of the graphs.
    Output(String),
}

impl TryFrom<String> for From {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        Ok(match text.as_str() {
            "sensor" => From::Sensor,
            "gravity" => From::Gravity,
            "action" => From::Action,
            "phase" => From::Phase,
            "step" => From::Step,
            "first" => From::First,
            _ => match text.strip_prefix("output:") {
                Some(output) => From::Output(output.into()),
                None => {
                    return Err(format!(
                        "`from` is \"{text}\"; known are sensor, gravity, action, phase, step, first and output:NAME"
                    ));
                }
            },
        })
    }
}

impl<'de> Deserialize<'de> for From {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        From::try_from(String::deserialize(deserializer)?).map_err(serde::de::Error::custom)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Wave {
    Sin,
    Cos,
}

/// One element of a clock: sine or cosine of a turn, ahead by a part of a period.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Hand {
    pub of: Wave,
    #[serde(default)]
    pub ahead: f64,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Phase {
    pub period_s: f64,
    pub elements: Vec<Hand>,
}

/// Part of an input of the graph.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Term {
    pub name: String,
    pub input: Option<String>,
    pub width: Option<usize>,
    pub elements: Option<Vec<String>>,
    pub per_joint: Option<bool>,
    pub joints: Option<Vec<String>>,
    pub channel: Option<String>,
    pub from: Option<From>,
    pub unit: Option<String>,
    pub interface: Option<String>,
    pub min: Option<Each>,
    pub max: Option<Each>,
    pub offset: Option<Each>,
    pub clip: Option<Clip>,
    pub scale: Option<Each>,
    pub history: Option<usize>,
    pub phase: Option<Phase>,
}

/// Meaning of the policy's output.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Action {
    pub output: Option<String>,
    pub elements: Option<Vec<String>>,
    pub joints: Option<Vec<String>>,
    pub unit: Option<String>,
    pub interface: Option<String>,
    pub reference: Option<String>,
    pub clip: Option<Clip>,
    pub scale: Option<Each>,
    pub offset: Option<Each>,
    pub min: Option<Each>,
    pub max: Option<Each>,
    pub stiffness: Option<Each>,
    pub damping: Option<Each>,
    pub tolerance: Option<f64>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum ClearedBy {
    #[default]
    Episode,
}

/// An output that is the input of the next control step.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct State {
    pub input: String,
    pub output: String,
    #[serde(default)]
    pub cleared_by: ClearedBy,
}

/// An input that is always the same, with its value.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Constant {
    pub input: String,
    pub value: f64,
}

/// The whole description.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Robot {
    pub environment: Option<Environment>,
    pub control_period_s: Option<f64>,
    pub quaternion_order: Option<QuaternionOrder>,
    pub joints: Option<Vec<String>>,
    /// Names of the robot's joints in its order; `robot_joints` in the file.
    #[serde(rename = "robot_joints")]
    pub wired_joints: Option<Vec<String>>,
    /// Index among the robot's joints of each of the policy's joints.
    pub joint_ids_map: Option<Vec<usize>>,
    pub default_position: Option<Vec<f64>>,
    pub history: Option<History>,
    pub input: BTreeMap<String, Input>,
    #[serde(rename = "term")]
    pub terms: Vec<Term>,
    pub action: Action,
    #[serde(rename = "state")]
    pub states: Vec<State>,
    #[serde(rename = "constant")]
    pub constants: Vec<Constant>,
    pub axes: BTreeMap<String, usize>,
}

/// Copies the fields that `mine` lacks.
macro_rules! fill {
    ($mine:expr, $other:expr, $($field:ident)+) => {
        $(if $mine.$field.is_none() { $mine.$field = $other.$field; })+
    };
}

impl Robot {
    /// Reads the TOML form.
    pub fn parse(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|error| error.to_string().trim_end().replace('\n', " "))
    }

    /// Fills the fields that this source lacks from another source. Terms are matched by their
    /// names; another number of terms under other names is a contradiction, which is returned.
    pub fn fill(&mut self, other: Robot) -> Result<(), String> {
        fill!(self, other, environment control_period_s quaternion_order joints wired_joints joint_ids_map default_position);
        match (&mut self.history, other.history) {
            (Some(mine), Some(other)) => {
                fill!(mine, other, length layout order start);
            }
            (mine @ None, other) => *mine = other,
            (Some(_), None) => {}
        }
        let action = other.action;
        fill!(self.action, action, output elements joints unit interface reference clip scale offset min max stiffness damping tolerance);
        for (axis, len) in other.axes {
            self.axes.entry(axis).or_insert(len);
        }
        for (name, input) in other.input {
            let mine = self.input.entry(name).or_default();
            fill!(mine, input, clip history);
        }
        if self.states.is_empty() {
            self.states = other.states;
        }
        if self.constants.is_empty() {
            self.constants = other.constants;
        }
        if self.terms.is_empty() {
            self.terms = other.terms;
            return Ok(());
        }
        let names = |terms: &[Term]| {
            let names: Vec<&str> = terms.iter().map(|term| term.name.as_str()).collect();
            names.join(", ")
        };
        let (mine, theirs) = (names(&self.terms), names(&other.terms));
        if !other.terms.is_empty() && mine != theirs {
            return Err(format!(
                "the terms are {mine} here and {theirs} there; say them in the order in which the graph reads them, by the same names"
            ));
        }
        for (term, other) in self.terms.iter_mut().zip(other.terms) {
            term.fill(other);
        }
        Ok(())
    }
}

/// Adds the names of fields that are said both here and there, not alike.
macro_rules! differing {
    ($found:ident, $within:expr, $mine:expr, $other:expr, $settled:expr, $($field:ident)+) => {
        $(if let (Some(mine), Some(other), None) = (&$mine.$field, &$other.$field, &$settled.$field)
            && !mine.is_near(other)
        {
            $found.push(format!("{}{}", $within, stringify!($field)));
        })+
    };
}

impl Robot {
    /// Lists the fields of which another source says something else, where `settled`, a person's description, says nothing.
    pub fn contradictions(&self, other: &Robot, settled: &Robot) -> Vec<String> {
        let mut found = vec![];
        differing!(found, "", self, other, settled, control_period_s joints default_position);
        differing!(found, "action.", self.action, other.action, settled.action, scale offset min max stiffness damping);
        let none = Term::default();
        for (place, (mine, other)) in self.terms.iter().zip(&other.terms).enumerate() {
            let settled = settled.terms.get(place).unwrap_or(&none);
            let within = format!("{}: ", mine.name);
            differing!(found, within, mine, other, settled, scale clip history);
        }
        found
    }
}

/// Whether two sources say the same, one of which may have printed three decimals.
trait Near {
    fn is_near(&self, other: &Self) -> bool;
}

impl Near for f64 {
    fn is_near(&self, other: &Self) -> bool {
        (self - other).abs() <= 5.1e-4
    }
}

impl Near for usize {
    fn is_near(&self, other: &Self) -> bool {
        self == other
    }
}

impl Near for String {
    fn is_near(&self, other: &Self) -> bool {
        self == other
    }
}

impl<T: Near> Near for Vec<T> {
    fn is_near(&self, other: &Self) -> bool {
        let mut pairs = self.iter().zip(other);
        self.len() == other.len() && pairs.all(|(mine, other)| mine.is_near(other))
    }
}

impl Near for Each {
    fn is_near(&self, other: &Self) -> bool {
        match (self, other) {
            (Each::One(mine), Each::One(other)) => mine.is_near(other),
            (Each::Many(mine), Each::Many(other)) => mine.is_near(other),
            (Each::One(one), Each::Many(many)) | (Each::Many(many), Each::One(one)) => {
                many.iter().all(|each| each.is_near(one))
            }
        }
    }
}

impl Near for Clip {
    fn is_near(&self, other: &Self) -> bool {
        let sides = |clip: &Clip| match clip {
            Clip::Around(most) => [Each::One(-most), Each::One(*most)],
            Clip::Between(sides) => sides.clone(),
        };
        let ([low, high], [low_there, high_there]) = (sides(self), sides(other));
        low.is_near(&low_there) && high.is_near(&high_there)
    }
}

impl Term {
    /// Fills the fields that this term lacks from another source's description of it.
    pub fn fill(&mut self, other: Term) {
        fill!(self, other, input width elements per_joint joints channel from unit interface min max offset clip scale history phase);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_description_reads_and_unknown_fields_are_refused() {
        let text = r#"
            control_period_s = 0.02
            joints = ["hip", "knee"]
            history = { length = 3, layout = "time", order = "oldest_first", start = "first" }
            [[term]]
            name = "joint_pos"
            offset = [0.1, 0.2]
            scale = 2
            clip = [-1, [1, 2]]
            [[term]]
            name = "clock"
            from = "phase"
            phase = { period_s = 0.8, elements = [{ of = "sin" }, { of = "cos", ahead = 0.5 }] }
            [action]
            scale = 0.25
        "#;
        let robot = Robot::parse(text).expect("it reads");
        assert_eq!(robot.terms[0].offset, Some(Each::Many(vec![0.1, 0.2])));
        assert_eq!(robot.terms[1].from, Some(From::Phase));
        for (wrong, said) in [
            ("period = 1", "period"),
            ("[action]\nscael = 1", "scael"),
            ("[[term]]\nname = 3", "line 2"),
            ("[[term]]\nfrom = \"moon\"", "known are sensor"),
            ("joints = [", "line 1"),
        ] {
            let error = Robot::parse(wrong).expect_err(wrong);
            assert!(error.contains(said), "{error}");
        }
    }

    #[test]
    fn sources_that_contradict_each_other_are_told() {
        let parse = |text: &str| Robot::parse(text).expect("it reads");
        let mine = parse(
            "control_period_s = 0.02\n[[term]]\nname = \"a\"\nscale = 2\nclip = 5\n[action]\nscale = 0.25\noffset = [0.1, 0.2]",
        );
        let same = parse(
            "[[term]]\nname = \"a\"\nscale = [2, 2]\nclip = [-5, 5]\n[action]\nscale = [0.25, 0.25]\noffset = [0.1004, 0.2]",
        );
        let other = parse(
            "control_period_s = 0.01\n[[term]]\nname = \"a\"\nscale = 3\n[action]\nscale = 0.5\noffset = [0.1, 0.3]",
        );
        let none = Robot::default();
        assert!(mine.contradictions(&same, &none).is_empty());
        assert_eq!(
            mine.contradictions(&other, &none),
            [
                "control_period_s",
                "action.scale",
                "action.offset",
                "a: scale"
            ]
        );
        // A person's word settles it.
        let settled = parse(
            "control_period_s = 0.02\n[[term]]\nname = \"a\"\nscale = 2\n[action]\nscale = 0.25",
        );
        assert_eq!(mine.contradictions(&other, &settled), ["action.offset"]);
    }

    #[test]
    fn what_is_said_first_stays() {
        let parse = |text: &str| Robot::parse(text).expect("it reads");
        let mut mine = parse("[[term]]\nname = \"a\"\nscale = 2\n[action]\nunit = \"rad\"");
        mine.fill(parse("control_period_s = 0.02\n[[term]]\nname = \"a\"\nscale = 3\nwidth = 4\n[action]\nunit = \"m\"\nscale = 1"))
            .expect("the same terms");
        assert_eq!(mine.control_period_s, Some(0.02));
        assert_eq!(
            (mine.terms[0].scale.clone(), mine.terms[0].width),
            (Some(Each::One(2.0)), Some(4))
        );
        assert_eq!(mine.action.unit.as_deref(), Some("rad"));
        assert_eq!(mine.action.scale, Some(Each::One(1.0)));
        let error = mine
            .fill(parse("[[term]]\nname = \"b\""))
            .expect_err("other terms");
        assert!(error.contains("a here and b there"), "{error}");
    }
}
