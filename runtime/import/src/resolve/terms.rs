//! What an input of a graph is made of: its terms, their widths against the graph's, and the channels that bring their raw values.

use super::Edges;
use super::elements::{Joints, bounds, limits, spread};
use crate::known::known;
use crate::model::Edge;
use crate::plan::{Channel, Element, Feed, Source, Stack, Term};
use crate::problem::Problems;
use crate::robot::{self, From, History, Layout, Order, QuaternionOrder, Robot, Start};

/// The channel of terms that name none.
const OBSERVATION: &str = "observation";

/// Names that mean something else to a policy of the family `plain`.
const RESERVED: [&str; 6] = [
    "action",
    "previous_action",
    "timestep",
    "phase",
    "pass",
    "index",
];

/// A unit quaternion's elements, and a little more for the rounding of whoever computes it.
const QUATERNION: f64 = 1.01;

/// What the terms are resolved in.
pub(super) struct Context<'r, 'p> {
    pub edges: &'r Edges,
    pub robot: &'r Robot,
    pub joints: &'r Joints,
    pub action_width: Option<usize>,
    pub channels: &'p mut Vec<Channel>,
    pub problems: &'p mut Problems,
}

/// What an input is made of, if enough is said of its terms.
pub(super) fn feed(context: &mut Context, input: &Edge, said: &[&robot::Term]) -> Option<Feed> {
    let name = context.edges.name(input);
    let about = format!("input `{name}`");
    let len = input.len();
    if said.is_empty() {
        context.problems.add(
            about,
            format!("nothing says what its {len} elements are: a `[[term]]` for each part, in the graph's order; or a state, a constant or a wire"),
        );
        return None;
    }
    let own = context.robot.input.get(&name);
    let rule = own
        .and_then(|own| own.history.clone())
        .or_else(|| context.robot.history.clone())
        .unwrap_or_default();
    let terms: Vec<(robot::Term, bool)> = said
        .iter()
        .map(|term| completed(context.robot, term))
        .collect();
    let lengths: Vec<usize> = terms
        .iter()
        .map(|(term, _)| term.history.or(rule.length).unwrap_or(1))
        .collect();
    let widths = widths(context, &about, len, &terms, &lengths)?;
    let before = context.problems.all().len();
    let stack = stack(context, &about, &rule, &lengths, &terms);
    let mut made = vec![];
    for (((term, relative), width), history) in terms.iter().zip(&widths).zip(&lengths) {
        made.extend(resolved(context, term, *relative, *width, *history));
    }
    let clip = own.and_then(|own| own.clip.as_ref());
    let clip = bounds(clip, len, &format!("input.{name}.clip"), context.problems);
    (context.problems.all().len() == before).then_some(Feed::Terms {
        terms: made,
        stack: stack?,
        clip,
    })
}

/// A term with what its name says, and whether it is relative to the default posture by definition. What a sensor gives is said once,
/// also where several inputs read it.
fn completed(robot: &Robot, term: &robot::Term) -> (robot::Term, bool) {
    let mut term = term.clone();
    let same = |other: &&robot::Term| {
        let sensor = |from: &Option<From>| matches!(from, None | Some(From::Sensor));
        other.name == term.name
            && other.channel == term.channel
            && sensor(&other.from)
            && sensor(&term.from)
    };
    if let Some(other) = robot
        .terms
        .iter()
        .filter(same)
        .find(|other| other.unit.is_some())
    {
        term.fill(robot::Term {
            unit: other.unit.clone(),
            interface: other.interface.clone(),
            elements: other.elements.clone(),
            min: other.min.clone(),
            max: other.max.clone(),
            ..robot::Term::default()
        });
    }
    let found = known(&term.name);
    let relative = found.as_ref().is_some_and(|found| found.relative);
    if let Some(found) = found {
        term.fill(found.term);
    }
    (term, relative)
}

fn stack(
    context: &mut Context,
    about: &str,
    rule: &History,
    lengths: &[usize],
    terms: &[(robot::Term, bool)],
) -> Option<Stack> {
    if lengths.contains(&0) {
        context
            .problems
            .add(about, "a `history` is 0; 1 is the present step alone");
        return None;
    }
    let longest = lengths.iter().max().copied().unwrap_or(1);
    if longest > 1024 {
        context.problems.add(
            about,
            format!("a `history` is {longest}, more than 1024 steps"),
        );
        return None;
    }
    if longest == 1 {
        return Some(Stack {
            layout: Layout::Term,
            order: Order::OldestFirst,
            start: Start::Zero,
        });
    }
    for (field, missing, what) in [
        (
            "layout",
            rule.layout.is_none(),
            "\"term\" (all steps of a term, then of the next), \"time\" (all terms of a step, then of the next) or \"element\" (all steps of an element, then of the next)",
        ),
        (
            "order",
            rule.order.is_none(),
            "\"oldest_first\" or \"newest_first\"",
        ),
        (
            "start",
            rule.start.is_none(),
            "what stands for steps before the first: \"first\" (the first step) or \"zero\"",
        ),
    ] {
        if missing {
            context.problems.add(
                format!("history.{field}"),
                format!("is not said, and {about} reads {longest} steps: {what}"),
            );
        }
    }
    let stack = Stack {
        layout: rule.layout?,
        order: rule.order?,
        start: rule.start?,
    };
    if stack.layout != Layout::Term && lengths.iter().any(|&length| length != longest) {
        context.problems.add(
            about,
            "its terms have histories of different lengths, which only `layout = \"term\"` allows",
        );
        return None;
    }
    if stack.start == Start::First {
        for ((term, _), _) in terms.iter().zip(lengths).filter(|(_, length)| **length > 1) {
            if matches!(
                term.from,
                Some(From::Phase | From::Step | From::First | From::Output(_))
            ) {
                context.problems.add(
                    format!("term.{}", term.name),
                    "has a history that begins with its first step, which only what the caller gives and the last action can have; use `start = \"zero\"`",
                );
            }
        }
    }
    Some(stack)
}

/// The width of each term; they add up to the graph's.
fn widths(
    context: &mut Context,
    about: &str,
    len: usize,
    terms: &[(robot::Term, bool)],
    lengths: &[usize],
) -> Option<Vec<usize>> {
    let mut widths: Vec<Option<usize>> =
        terms.iter().map(|(term, _)| width(context, term)).collect();
    let sum = |widths: &[Option<usize>]| {
        let parts = widths.iter().zip(lengths);
        parts
            .filter_map(|(width, length)| width.map(|width| width.saturating_mul(*length)))
            .fold(0_usize, usize::saturating_add)
    };
    let unknown: Vec<usize> = (0..widths.len()).filter(|&i| widths[i].is_none()).collect();
    if let [one] = unknown[..] {
        // The graph itself says what is left for it.
        let rest = len.saturating_sub(sum(&widths));
        if rest > 0 && rest.is_multiple_of(lengths[one].max(1)) {
            widths[one] = Some(rest / lengths[one].max(1));
        }
    }
    let open: Vec<usize> = (0..widths.len()).filter(|&i| widths[i].is_none()).collect();
    for &i in &open {
        let wanted = "how many elements it has is not said: `width`, `elements` (their names) or `per_joint = true`";
        context
            .problems
            .add(format!("term.{}", terms[i].0.name), wanted);
    }
    let table = || {
        let rows = terms.iter().zip(&widths).zip(lengths);
        let rows = rows.map(|(((term, _), width), length)| {
            let width = width.map_or("?".into(), |width| width.to_string());
            let times = if *length == 1 {
                String::new()
            } else {
                format!(" x {length} steps")
            };
            format!("{} {width}{times}", term.name)
        });
        rows.collect::<Vec<_>>().join(", ")
    };
    if !open.is_empty() {
        context.problems.add(
            about,
            format!("has {len} elements; known so far: {}", table()),
        );
        return None;
    }
    if sum(&widths) != len {
        context.problems.add(
            about,
            format!(
                "has {len} elements, its terms add up to {}: {}",
                sum(&widths),
                table()
            ),
        );
        return None;
    }
    widths.into_iter().collect()
}

fn width(context: &Context, term: &robot::Term) -> Option<usize> {
    let lists = [&term.scale, &term.offset, &term.min, &term.max];
    let by_list = lists
        .into_iter()
        .find_map(|each| each.as_ref().and_then(robot::Each::len));
    match &term.from {
        Some(From::Gravity) => Some(3),
        Some(From::Action) => context.action_width,
        Some(From::Phase) => term.phase.as_ref().map(|phase| phase.elements.len()),
        Some(From::Step | From::First) => Some(1),
        Some(From::Output(output)) => context
            .edges
            .find(&context.edges.outputs, output)
            .ok()
            .map(Edge::len),
        Some(From::Sensor) | None => term
            .width
            .or_else(|| term.elements.as_ref().map(Vec::len))
            .or_else(|| {
                let joints = term.joints.as_ref().unwrap_or(&context.joints.policy);
                let per_joint = term.per_joint == Some(true) || term.joints.is_some();
                (per_joint && !joints.is_empty()).then_some(joints.len())
            })
            .or(by_list),
    }
    .or(term.width)
}

fn resolved(
    context: &mut Context,
    term: &robot::Term,
    relative: bool,
    width: usize,
    history: usize,
) -> Option<Term> {
    let about = format!("term.{}", term.name);
    if term.name.is_empty() || !plain(&term.name) {
        context.problems.add(
            &about,
            "a `name` has letters, digits, `_`, `-` and `.` only, and at least one of them",
        );
        return None;
    }
    let source = source(context, term, width, &about);
    let mut offset = term.offset.clone();
    if relative && offset.is_none() {
        offset = context
            .robot
            .default_position
            .clone()
            .map(robot::Each::Many);
    }
    let positions = term.per_joint == Some(true)
        && term.interface.as_deref() == Some("position")
        && matches!(term.from, None | Some(From::Sensor));
    if positions && offset.is_none() {
        context.problems.add(
            format!("{about}.offset"),
            "is not said: the joint positions that the policy sees as 0, in its own order (its default posture), or 0 if it sees positions as they are",
        );
    }
    let number =
        |each: Option<robot::Each>, otherwise: f64| each.unwrap_or(robot::Each::One(otherwise));
    let mut each = |each: robot::Each, field: &str| {
        spread(
            Some(&each),
            width,
            &format!("{about}.{field}"),
            context.problems,
        )
    };
    let offset = each(number(offset, 0.0), "offset");
    let scale = each(number(term.scale.clone(), 1.0), "scale");
    let clip = bounds(
        term.clip.as_ref(),
        width,
        &format!("{about}.clip"),
        context.problems,
    );
    Some(Term {
        name: term.name.clone(),
        source: source?,
        offset: offset?,
        clip,
        scale: scale?,
        history,
    })
}

fn plain(name: &str) -> bool {
    name.chars()
        .all(|c| c.is_alphanumeric() || "_-.".contains(c))
}

fn source(context: &mut Context, term: &robot::Term, width: usize, about: &str) -> Option<Source> {
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
            "is not said: `{ period_s = 0.8, elements = [{ of = \"sin\" }, { of = \"cos\" }] }`",
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
    let order = match &joints {
        Some(joints) => context.joints.by_robot(joints),
        None => (0..width).collect(),
    };
    let columns = |first: usize| {
        let place = |i| order.iter().position(|&other| other == i).unwrap_or(0);
        (0..width).map(|i| first + place(i)).collect::<Vec<_>>()
    };
    let (channel, first) = place(context, term, about)?;
    if let Some((first, known)) = first {
        // Another input reads the same values.
        if known != width {
            context.problems.add(
                about,
                format!("has {width} elements here and {known} in another input"),
            );
            return None;
        }
        return Some(Source::Columns {
            channel,
            columns: columns(first),
        });
    }
    if term.unit.is_none() {
        context.problems.add(
            format!("{about}.unit"),
            "is not said: of what the sensor gives, for example \"rad/s\"; \"1\" for none",
        );
    }
    let limits = limits(
        [term.min.as_ref(), term.max.as_ref()],
        width,
        about,
        term.unit.as_deref(),
        context.problems,
    );
    let names: Vec<String> = match (&term.elements, &joints) {
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
    let (limits, unit) = (limits?, term.unit.clone()?);
    let elements: Vec<Element> = order
        .iter()
        .map(|&i| Element {
            name: element(&term.name, &names[i]),
            unit: unit.clone(),
            min: limits.0[i],
            max: limits.1[i],
            joint: joints.as_ref().map(|joints| joints[i].clone()),
            interface: term.interface.clone(),
            stiffness: None,
            damping: None,
        })
        .collect();
    let channel = &mut context.channels[channel];
    let first = channel.elements.len();
    channel.elements.extend(elements);
    let channel = context
        .channels
        .iter()
        .position(|known| known.name == *term.channel.as_deref().unwrap_or(OBSERVATION))?;
    Some(Source::Columns {
        channel,
        columns: columns(first),
    })
}

fn gravity(context: &mut Context, term: &robot::Term, about: &str) -> Option<Source> {
    let Some(order) = context.robot.quaternion_order else {
        context.problems.add(
            "quaternion_order",
            "is not said: \"wxyz\" or \"xyzw\", how the orientation is given from which gravity follows",
        );
        return None;
    };
    let parts = match order {
        QuaternionOrder::Wxyz => ["w", "x", "y", "z"],
        QuaternionOrder::Xyzw => ["x", "y", "z", "w"],
    };
    let (channel, known) = place(context, term, about)?;
    let found = &mut context.channels[channel];
    let first = known.map_or(found.elements.len(), |(first, _)| first);
    if known.is_none() {
        found.quaternion_order = Some(order);
        found.elements.extend(parts.map(|part| Element {
            name: element(&term.name, part),
            unit: "1".into(),
            min: -QUATERNION,
            max: QUATERNION,
            joint: None,
            interface: Some("orientation".into()),
            stiffness: None,
            damping: None,
        }));
    }
    let at = |part: &str| first + parts.iter().position(|known| *known == part).unwrap_or(0);
    Some(Source::Gravity {
        channel,
        columns: ["w", "x", "y", "z"].map(at),
    })
}

/// The channel of a term, and where the term's elements lie in it if another input reads them too: the first, and how many.
fn place(
    context: &mut Context,
    term: &robot::Term,
    about: &str,
) -> Option<(usize, Option<(usize, usize)>)> {
    let name = term.channel.as_deref().unwrap_or(OBSERVATION);
    if RESERVED.contains(&name) || name.contains('.') || name.is_empty() || !plain(name) {
        context.problems.add(
            format!("{about}.channel"),
            format!(
                "\"{name}\" cannot name a channel: letters, digits, `_` and `-` do, except {}",
                RESERVED.join(", ")
            ),
        );
        return None;
    }
    let known = context.channels.iter().position(|known| known.name == name);
    let channel = known.unwrap_or_else(|| {
        context.channels.push(Channel {
            name: name.into(),
            elements: vec![],
            quaternion_order: None,
        });
        context.channels.len() - 1
    });
    let elements = &context.channels[channel].elements;
    let prefix = format!("{}.", term.name);
    let mine = |element: &Element| element.name == term.name || element.name.starts_with(&prefix);
    let first = elements.iter().position(mine);
    let count = elements.iter().filter(|element| mine(element)).count();
    Some((channel, first.map(|first| (first, count))))
}

fn element(term: &str, name: &str) -> String {
    if name.is_empty() {
        term.into()
    } else {
        format!("{term}.{name}")
    }
}

/// What a controller cannot take.
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
            "no term comes from the caller; a policy observes something",
        );
    }
    for channel in channels {
        for (i, element) in channel.elements.iter().enumerate() {
            if channel.elements[..i]
                .iter()
                .any(|other| other.name == element.name)
            {
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
