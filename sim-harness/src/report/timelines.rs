//! Charts of the plan in force over an episode, with the completions marked.

use kuva::plot::LinePlot;
use kuva::render::annotations::ReferenceLine;
use kuva::render::plots::Plot;

use super::Report;
use super::charts::{COLORS, Chart, HALF, Mark, chart, sized};
use crate::trace::Trace;

/// Completions that are nearer than this share of an episode have one label in a timeline.
const TOGETHER: f64 = 0.04;

/// Vertical room above the plans of a timeline for the numbers of completions, as a factor.
const HEADROOM: f64 = 1.12;

/// Colour of completions that nobody asked for.
const UNASKED: &str = "#777777";

/// Draws the plan in force over control steps, with completions.
pub fn timelines(report: &Report<'_>) -> Vec<Chart> {
    let chosen = super::chosen(report.traces).into_iter();
    chosen.map(|trace| timeline(report, trace)).collect()
}

fn timeline(report: &Report<'_>, trace: &Trace) -> Chart {
    let steps = (0..).zip(&trace.steps);
    let points =
        steps.filter_map(|(number, step)| Some((f64::from(number), f64::from(step.plan?))));
    let plots: Vec<Plot> = vec![
        LinePlot::new()
            .with_data(points)
            .with_step()
            .with_color(COLORS[0])
            .with_stroke_width(2.0)
            .into(),
    ];
    let title = super::title(report.contract, trace);
    let steps = trace.steps.len() as f64;
    let mut layout = sized(&plots, &title, HALF, 300.0)
        .with_x_label("control step")
        .with_y_label("plan")
        .with_x_axis_max(steps)
        .with_y_axis_min(0.0)
        .with_y_axis_max(HEADROOM * report.plans as f64);
    let marks = marks(report, trace);
    // Numbers of completions that are close to each other stand at the first of their lines.
    let mut together: Vec<(f64, Vec<&Mark>)> = Vec::new();
    for mark in &marks {
        let at = mark.step as f64;
        match together.last_mut() {
            Some((first, near)) if at - *first < TOGETHER * steps => near.push(mark),
            _ => together.push((at, vec![mark])),
        }
    }
    for (_, near) in together {
        for (place, mark) in near.iter().enumerate() {
            let color = if mark.asked { COLORS[1] } else { UNASKED };
            let dashes = if mark.asked { "6 3" } else { "2 3" };
            let mut line = ReferenceLine::vertical(mark.step as f64)
                .with_color(color)
                .with_dasharray(dashes);
            if place == 0 {
                let numbers: Vec<_> = near.iter().map(|it| it.number.to_string()).collect();
                line = line.with_label(numbers.join(", "));
            }
            layout = layout.with_reference_line(line);
        }
    }
    Chart {
        marks,
        ..chart(plots, layout)
    }
}

/// Lists the completions of an episode in their order, and whether the instruction asks for them.
fn marks(report: &Report<'_>, trace: &Trace) -> Vec<Mark> {
    let known = crate::results::asked(report.contract, trace.instruction as usize);
    let asked = |name: &str| {
        // A sentence outside the table asks for what `--sub-tasks` says, which is not in the contract.
        known
            .as_ref()
            .is_none_or(|known| known.sub_tasks.contains(&name))
    };
    let mut completions: Vec<_> = trace.outcome.completions.iter().collect();
    completions.sort_by_key(|done| done.step);
    let mark = |(number, done): (usize, &crate::environment::Completion)| {
        let name = report.sub_tasks.get(done.sub_task).copied().unwrap_or("?");
        Mark {
            number,
            name: name.to_owned(),
            step: done.step,
            asked: asked(name),
        }
    };
    (1..).zip(completions).map(mark).collect()
}
