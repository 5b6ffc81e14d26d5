//! Charts of the plan in force over an episode, with the completions marked.

use kuva::plot::LinePlot;
use kuva::render::annotations::ReferenceLine;
use kuva::render::plots::Plot;

use super::Report;
use super::charts::{COLORS, Chart, HALF, Mark, chart, sized};
use crate::environment::Completion;
use crate::results::{self, Asked};
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
    let asked = results::asked(report.contract, trace.instruction as usize);
    let marks = marks(report.sub_tasks, asked.as_ref(), &trace.outcome.completions);
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

/// Lists the completions of an episode in their order, and whether the instruction asks for them; a sentence outside the table asks for
/// what `--sub-tasks` says, which is not in the contract.
fn marks(sub_tasks: &[&str], asked: Option<&Asked<'_>>, completions: &[Completion]) -> Vec<Mark> {
    let mut completions: Vec<_> = completions.iter().collect();
    completions.sort_by_key(|done| done.step);
    let mark = |(number, done): (usize, &Completion)| {
        let name = sub_tasks.get(done.sub_task).copied().unwrap_or("?");
        Mark {
            number,
            name: name.to_owned(),
            step: done.step,
            asked: asked.is_none_or(|asked| asked.sub_tasks.contains(&name)),
        }
    };
    (1..).zip(completions).map(mark).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_asked_for_is_marked() {
        let asked = Asked {
            id: "k",
            text: "move the kettle",
            split: "seen",
            sub_tasks: vec!["kettle"],
        };
        let completions = [(1, 30), (0, 20)].map(|(sub_task, step)| Completion { sub_task, step });
        let listed = |asked| {
            let marks = marks(&["kettle", "microwave"], asked, &completions);
            let told = |mark: Mark| (mark.number, mark.name, mark.step, mark.asked);
            marks.into_iter().map(told).collect::<Vec<_>>()
        };
        let [first, second] = [(1, "kettle", 20), (2, "microwave", 30)];
        let told = |(number, name, step): (usize, &str, usize), asked| {
            (number, name.to_owned(), step, asked)
        };
        assert_eq!(
            listed(Some(&asked)),
            [told(first, true), told(second, false)]
        );
        assert_eq!(listed(None), [told(first, true), told(second, true)]);
    }
}
