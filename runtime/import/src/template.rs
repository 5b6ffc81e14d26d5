//! Template of the description that a person fills in: TOML with everything known, and a commented
//! line for everything missing.

use std::fmt::{self, Display, Write};

use lads_compiler::Line;

use crate::known::known;
use crate::model::Edge;
use crate::problem::Problems;
use crate::resolve::Edges;
use crate::robot::{Clip, Each, From, History, Layout, Order, Robot, Start, Term};

/// Formats the whole template.
pub(crate) fn template(edges: &Edges, robot: &Robot, problems: &Problems) -> String {
    let mut form = Form::default();
    form.line("# Processing between sensors and policy. Remove the `#` in front of a field and fill in its value.");
    form.line(format_args!(
        "# The graph reads {} and gives {}.",
        listed(edges, &edges.inputs),
        listed(edges, &edges.outputs)
    ));
    if !problems.is_empty() {
        form.line("# Problems of the files so far:");
    }
    for problem in problems.all() {
        form.line(format_args!("#   {}: {}", problem.about, problem.wrong));
    }
    form.line("");
    match &robot.environment {
        Some(known) => form.line(format_args!(
            "environment = {{ id = {}, version = {} }}",
            text(&known.id),
            text(&known.version)
        )),
        None => form.line("# environment = { id = \"my-robot\", version = \"1\" }   # what the policy was made for"),
    }
    form.field(
        "control_period_s",
        robot.control_period_s.map(number),
        "0.02",
        "seconds from one control step to the next",
    );
    form.field(
        "joints",
        robot.joints.as_deref().map(texts),
        "[\"hip\", \"knee\"]",
        "in the policy's order",
    );
    if robot.joint_ids_map.is_some() || robot.wired_joints.is_some() {
        form.field(
            "joint_ids_map",
            robot.joint_ids_map.as_ref().map(|map| format!("{map:?}")),
            "[0, 1]",
            "the number of each of the policy's joints among the robot's",
        );
        form.field(
            "robot_joints",
            robot.wired_joints.as_deref().map(texts),
            "[\"hip\", \"knee\"]",
            "all of the robot's joints, in its own order",
        );
    } else {
        form.line("# robot_joints = [\"knee\", \"hip\"]   # only if the robot has them in another order; it then gives and gets that one");
    }
    form.line(
        "# quaternion_order = \"wxyz\"   # or \"xyzw\"; only for terms with `from = \"gravity\"`",
    );
    history(&mut form, robot);
    if edges.inputs.len() > 1 {
        form.line("# Several inputs: terms name theirs with `input`; others are states, constants or wired.");
        form.line("# [[state]]\n# input = \"h_in\"\n# output = \"h_out\"");
        form.line("# [[constant]]\n# input = \"mask\"\n# value = 1");
    }
    form.line("\n# The parts of the input in the graph's order: clip(raw - offset) * scale. Lists have a number for each element,");
    form.line("# in the policy's order; one number stands for all.");
    if robot.terms.is_empty() {
        form.line("# [[term]]\n# name = \"joint_pos\"\n# per_joint = true   # or width = 3, or elements = [\"x\", \"y\", \"z\"]");
        form.line("# unit = \"rad\"\n# interface = \"position\"\n# min = -3.0\n# max = 3.0\n# offset = 0   # the posture that the policy sees as 0");
        form.line("# scale = 1\n# clip = [-100, 100]\n# channel = \"observation\"   # the caller may give several vectors");
        form.line("# from = \"sensor\"   # or \"gravity\" (of an orientation), \"action\" (the last one), \"phase\", \"step\", \"first\", \"output:NAME\"");
    }
    for said in &robot.terms {
        term(&mut form, said, robot);
    }
    action(&mut form, edges, robot);
    form.text
}

fn listed(edges: &Edges, values: &[Edge]) -> String {
    let values = values
        .iter()
        .map(|edge| format!("`{}` {:?}", edges.name(edge), edge.dims));
    // A line break in a name would end the comment.
    Line::from(values.collect::<Vec<_>>().join(", ")).to_string()
}

fn history(form: &mut Form, robot: &Robot) {
    let said = robot.history.clone().unwrap_or_default();
    let longest = robot.terms.iter().filter_map(|term| term.history).max();
    let History {
        length,
        layout,
        order,
        start,
    } = said;
    let name = |name: Option<&str>| name.map_or("?".into(), text);
    let line = format!(
        "history = {{ length = {}, layout = {}, order = {}, start = {} }}",
        length.or(longest).unwrap_or(1),
        name(layout.map(|layout| match layout {
            Layout::Term => "term",
            Layout::Time => "time",
            Layout::Element => "element",
        })),
        name(order.map(|order| match order {
            Order::OldestFirst => "oldest_first",
            Order::NewestFirst => "newest_first",
        })),
        name(start.map(|start| match start {
            Start::First => "first",
            Start::Zero => "zero",
        })),
    );
    if robot.history.is_some() && !line.contains('?') {
        form.line(line);
    } else {
        let example = "history = { length = 5, layout = \"term\", order = \"oldest_first\", start = \"first\" }";
        form.line(format_args!(
            "# {example}   # only if the graph reads several steps"
        ));
    }
}

fn term(form: &mut Form, said: &Term, robot: &Robot) {
    let found = known(&said.name);
    let mut full = said.clone();
    let relative = found.as_ref().is_some_and(|found| found.relative);
    if let Some(found) = found {
        full.fill(found.term);
    }
    form.line("\n[[term]]");
    form.line(format_args!("name = {}", text(&full.name)));
    if let Some(input) = &full.input {
        form.line(format_args!("input = {}", text(input)));
    }
    match &full.from {
        None | Some(From::Sensor) => {}
        Some(from) => {
            let from = match from {
                From::Sensor => "sensor".into(),
                From::Gravity => "gravity".into(),
                From::Action => "action".into(),
                From::Phase => "phase".into(),
                From::Step => "step".into(),
                From::First => "first".into(),
                From::Output(output) => format!("output:{output}"),
            };
            form.line(format_args!("from = {}", text(&from)));
        }
    }
    let raw = matches!(full.from, None | Some(From::Sensor));
    if raw {
        if let Some(channel) = &full.channel {
            form.line(format_args!(
                "channel = {}   # a vector of its own",
                text(channel)
            ));
        }
        match (&full.elements, full.per_joint, full.width) {
            (Some(names), ..) => form.line(format_args!("elements = {}", texts(names))),
            (None, Some(true), _) => form.line("per_joint = true"),
            (None, _, Some(width)) => form.line(format_args!("width = {width}")),
            _ => form
                .line("# width = 3   # or elements = [\"x\", \"y\", \"z\"], or per_joint = true"),
        }
        form.field(
            "unit",
            full.unit.as_deref().map(text),
            "\"rad\"",
            "unit of the sensor's values; \"1\" for none",
        );
        if let Some(interface) = &full.interface {
            form.line(format_args!("interface = {}", text(interface)));
        }
        form.field(
            "min",
            full.min.as_ref().map(each),
            "-1.0",
            "the smallest valid value",
        );
        form.field(
            "max",
            full.max.as_ref().map(each),
            "1.0",
            "the largest valid value",
        );
        let posture = robot.default_position.clone().map(Each::Many);
        let offset = full
            .offset
            .clone()
            .or_else(|| posture.clone().filter(|_| relative));
        let positions =
            full.per_joint == Some(true) && full.interface.as_deref() == Some("position");
        if positions || offset.is_some() {
            let example = posture.as_ref().map_or("0".into(), each);
            form.field(
                "offset",
                offset.as_ref().map(each),
                &example,
                "the posture that the policy sees as 0; 0 if it sees positions as they are",
            );
        }
    }
    if let Some(bounds) = &full.clip {
        form.line(format_args!("clip = {}", clip(bounds)));
    }
    if let Some(scale) = &full.scale {
        form.line(format_args!("scale = {}", each(scale)));
    }
    if let Some(length) = full.history {
        form.line(format_args!("history = {length}"));
    }
}

fn action(form: &mut Form, edges: &Edges, robot: &Robot) {
    let said = &robot.action;
    form.line(
        "\n# Meaning of the policy's output: clip(raw) * scale + offset, which the robot gets.",
    );
    form.line("[action]");
    let example = edges
        .outputs
        .first()
        .map_or(String::new(), |edge| edges.name(edge));
    if edges.outputs.len() > 1 || said.output.is_some() {
        form.field(
            "output",
            said.output.as_deref().map(text),
            &text(&example),
            "which output is the action",
        );
    }
    if let Some(names) = &said.elements {
        form.line(format_args!("elements = {}", texts(names)));
    }
    form.field(
        "unit",
        said.unit.as_deref().map(text),
        "\"rad\"",
        "unit of the robot's command",
    );
    form.field(
        "interface",
        said.interface.as_deref().map(text),
        "\"position\"",
        "position, velocity or effort",
    );
    form.field(
        "scale",
        said.scale.as_ref().map(each),
        "0.25",
        "factor of the policy's number; 1 for none",
    );
    let posture = robot.default_position.clone().map(Each::Many);
    let example = posture.as_ref().map_or("0".into(), each);
    form.field(
        "offset",
        said.offset.as_ref().map(each),
        &example,
        "added after scaling, for example the default posture; 0 for none",
    );
    form.field(
        "min",
        said.min.as_ref().map(each),
        "-1.0",
        "the smallest value that the robot may get",
    );
    form.field(
        "max",
        said.max.as_ref().map(each),
        "1.0",
        "the largest value that the robot may get",
    );
    match &said.clip {
        Some(bounds) => form.line(format_args!("clip = {}", clip(bounds))),
        None => form.line("# clip = [-100, 100]   # of the raw output, if training had one"),
    }
    form.field(
        "stiffness",
        said.stiffness.as_ref().map(each),
        "20.0",
        "gains of the joints' controllers that training had; they are only handed on",
    );
    form.field("damping", said.damping.as_ref().map(each), "0.5", "");
}

#[derive(Default)]
struct Form {
    text: String,
}

impl Form {
    fn line(&mut self, line: impl Display) {
        // Writing to a string cannot fail.
        let _: fmt::Result = writeln!(self.text, "{line}");
    }

    /// Writes a field with its known value, or as a comment with an example.
    fn field(&mut self, name: &str, known: Option<String>, example: &str, what: &str) {
        let what = if what.is_empty() {
            String::new()
        } else {
            format!("   # {what}")
        };
        match known {
            Some(value) => self.line(format_args!("{name} = {value}")),
            None => self.line(format_args!("# {name} = {example}{what}")),
        }
    }
}

fn text(text: &str) -> String {
    // JSON's texts are TOML's basic strings, which may not hold a delete character as it is.
    let json = serde_json::Value::from(text).to_string();
    json.replace('\u{7f}', "\\u007F")
}

fn texts(names: &[String]) -> String {
    let names: Vec<String> = names.iter().map(|name| text(name)).collect();
    format!("[{}]", names.join(", "))
}

fn each(each: &Each) -> String {
    match each {
        Each::One(value) => number(*value),
        Each::Many(values) => {
            let values: Vec<String> = values.iter().map(|&value| number(value)).collect();
            format!("[{}]", values.join(", "))
        }
    }
}

/// Formats a float of TOML: with a point or an exponent, or `nan`.
fn number(value: f64) -> String {
    if value.is_nan() {
        "nan".into()
    } else {
        format!("{value:?}")
    }
}

fn clip(clip: &Clip) -> String {
    match clip {
        Clip::Around(bound) => number(*bound),
        Clip::Between([low, high]) => format!("[{}, {}]", each(low), each(high)),
    }
}
