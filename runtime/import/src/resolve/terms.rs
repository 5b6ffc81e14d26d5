//! Resolves an input of a graph: its terms, the processing of their values, and the layout of
//! several steps.

use super::Edges;
use super::elements::{Joints, bounds, spread};
use super::sources::source;
use super::widths::widths;
use crate::known::known;
use crate::model::Edge;
use crate::plan::{Channel, Feed, Stack, Term};
use crate::problem::Problems;
use crate::robot::{self, From, History, Layout, Order, Robot, Start};

/// Context in which terms are resolved.
pub(super) struct Context<'r, 'p> {
    pub edges: &'r Edges,
    pub robot: &'r Robot,
    pub joints: &'r Joints,
    pub action_width: Option<usize>,
    pub channels: &'p mut Vec<Channel>,
    pub problems: &'p mut Problems,
}

/// Resolves the composition of an input, if the description of its terms is complete.
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

/// Completes a term with the facts that follow from its name, and returns whether it is relative to
/// the default posture by definition. The description of a sensor is given once, even if several
/// inputs read it.
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
                format!("is not given, and {about} reads {longest} steps: {what}"),
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
            "is not given: the joint positions that the policy sees as 0, in its own order (its default posture), or 0 if it sees positions as they are",
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

/// Returns whether a name is valid for a term: it becomes a part of names of values and states.
pub(super) fn plain(name: &str) -> bool {
    name.chars()
        .all(|c| c.is_alphanumeric() || "_-.".contains(c))
}
