//! Resolves the number of elements of each term of an input: as described, or the graph's remainder
//! for the only term without a description.

use super::terms::Context;
use crate::model::Edge;
use crate::robot::{self, From};

/// Returns the width of each term; they add up to the graph's.
pub(super) fn widths(
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
        let wanted = "how many elements it has is not given: `width`, `elements` (their names) or `per_joint = true`";
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
