//! A composite instruction and the instructions that it is made of: where the gripper goes, and which plans the episodes start with.
//! Figures 5 and 7 of the paper.

use kuva::plot::scatter::MarkerShape;
use kuva::plot::{LinePlot, ScatterPlot};
use kuva::render::plots::Plot;
use lads_compiler::Contract;

use super::charts::{COLORS, Chart, HALF, Key, chart, sized};
use super::scaling;
use crate::starts::{Draw, Drawn};
use crate::trace::Trace;

/// Number of control steps of a path, from the episode's start, as in the paper.
const STEPS: usize = 10;

/// Number of episodes of each instruction whose paths are drawn, as in the paper.
const EPISODES: usize = 10;

/// Size of the marker of a plan that was drawn once, in pixels.
const MARKER: f64 = 3.0;

/// Markers of the composite, a transparent one, and of its parts, with their signs in text: they tell apart what colours do not.
const SHAPES: [(MarkerShape, &str); 4] = [
    (MarkerShape::Circle, "●"),
    (MarkerShape::Square, "■"),
    (MarkerShape::Triangle, "▲"),
    (MarkerShape::Diamond, "◆"),
];

/// A composite instruction and its parts.
#[derive(Debug, Clone, PartialEq)]
pub struct Composition {
    /// The composite instruction, then one instruction for each of its sub-tasks.
    pub members: Vec<Member>,
}

/// What was seen of one instruction.
#[derive(Debug, Clone, PartialEq)]
pub struct Member {
    /// Text of the instruction.
    pub text: String,
    /// Where the gripper went in the first control steps of each episode, in metres from where it was; empty where the environment has none.
    pub ways: Vec<Vec<[f64; 3]>>,
    /// Plans drawn at the start; empty of a policy that keeps none.
    pub draws: Vec<Draw>,
}

/// Finds, for each composite instruction among those that were run, itself and the first of them for each of its sub-tasks; a composite that
/// misses one, or asks for the same as one before it, is left out.
pub fn find(contract: &Contract, run: &[u32]) -> Vec<Vec<u32>> {
    let asked = |instruction: u32| contract.evaluated(instruction as usize).0;
    let mut found: Vec<Vec<u32>> = Vec::new();
    for &whole in run {
        let sub_tasks = asked(whole);
        let part = |sub_task: &String| {
            let alone = std::slice::from_ref(sub_task);
            run.iter().copied().find(|&part| asked(part) == alone)
        };
        let parts: Option<Vec<u32>> = sub_tasks.iter().map(part).collect();
        let Some(parts) = parts.filter(|parts| parts.len() > 1) else {
            continue;
        };
        if found.iter().all(|known| known[1..] != parts) {
            found.push([&[whole], &parts[..]].concat());
        }
    }
    found
}

/// Lists the instructions of traces, in the contract's order.
pub fn run(traces: &[Trace]) -> Vec<u32> {
    let mut run: Vec<u32> = traces.iter().map(|trace| trace.instruction).collect();
    run.sort_unstable();
    run.dedup();
    run
}

/// Collects what was seen of each composite instruction that was run with all of its parts.
pub fn compositions(contract: &Contract, traces: &[Trace], drawn: &Drawn) -> Vec<Composition> {
    let member = |&instruction: &u32| {
        let known = contract.instructions.get(instruction as usize);
        let own = traces.iter().filter(|it| it.instruction == instruction);
        let ways = own.take(EPISODES).map(way);
        Member {
            text: known.map_or("?", |known| known.text.as_str()).to_owned(),
            ways: ways.filter(|way| !way.is_empty()).collect(),
            draws: drawn.get(&instruction).cloned().unwrap_or_default(),
        }
    };
    let found = find(contract, &run(traces));
    let found = found.iter().map(|members| Composition {
        members: members.iter().map(member).collect(),
    });
    found.collect()
}

fn way(trace: &Trace) -> Vec<[f64; 3]> {
    // The step after the last shows where the last one led.
    let steps = trace.steps.iter().take(STEPS + 1);
    let way: Vec<[f64; 3]> = steps.filter_map(|step| step.gripper).collect();
    let from = way.first().copied().unwrap_or_default();
    let moved = |at: [f64; 3]| [at[0] - from[0], at[1] - from[1], at[2] - from[2]];
    way.into_iter().map(moved).collect()
}

impl Composition {
    /// Text of the composite instruction.
    pub fn text(&self) -> &str {
        self.members.first().map_or("", |whole| &whole.text)
    }

    /// The composite and its parts, each with its colour.
    fn colored(&self) -> impl Iterator<Item = (&Member, &'static str)> {
        self.members.iter().zip(COLORS.into_iter().cycle())
    }

    /// What the colours stand for, each with its marker's sign, or with `sign`.
    fn key(&self, sign: Option<&'static str>) -> Vec<Key> {
        let marked = self.colored().zip(SHAPES.into_iter().cycle());
        let key = marked.map(|((member, color), (_, own))| Key {
            color,
            sign: sign.unwrap_or(own),
            text: member.text.clone(),
        });
        key.collect()
    }

    /// Draws the gripper's paths as seen from above, Figure 5 of the paper, up to a distance of `reach` metres along both axes; `None` where
    /// there are no paths.
    pub fn paths(&self, title: &str, reach: f64) -> Option<Chart> {
        let ways = self.colored();
        let ways = ways.flat_map(|(member, color)| member.ways.iter().map(move |way| (way, color)));
        let path = |(way, color): (&Vec<[f64; 3]>, &str)| {
            LinePlot::new()
                .with_data(way.iter().map(|&[x, y, _]| (x, y)))
                .with_color(color)
                .with_stroke_width(1.8)
                .into()
        };
        let plots: Vec<Plot> = ways.map(path).collect();
        if plots.is_empty() {
            return None;
        }
        let layout = sized(&plots, title, HALF, HALF)
            .with_equal_aspect()
            .with_x_label("x (m)")
            .with_y_label("y (m)")
            .with_x_axis_min(-reach)
            .with_x_axis_max(reach)
            .with_y_axis_min(-reach)
            .with_y_axis_max(reach);
        Some(Chart {
            key: self.key(Some("━")),
            ..chart(plots, layout)
        })
    }

    /// Returns the largest distance along an axis that a path reaches, in metres.
    pub fn reach(&self) -> f64 {
        let ways = self.members.iter().flat_map(|member| &member.ways);
        let far = ways.flatten().flat_map(|&[x, y, _]| [x.abs(), y.abs()]);
        far.fold(0.0, f64::max)
    }

    /// Draws the plans at the start of the episodes in the plane, Figure 7 of the paper; `None` where there are no draws.
    pub fn plans(&self, title: &str) -> Option<Chart> {
        let draws = self.members.iter().flat_map(|member| &member.draws);
        let first = draws.clone().next()?;
        let vectors: Vec<&[f32]> = draws.map(|draw| draw.vector.as_slice()).collect();
        let plane = scaling::plane(&vectors);
        let mut points = plane.points.as_slice();
        let mut plots: Vec<Plot> = Vec::new();
        for ((member, color), (shape, _)) in self.colored().zip(SHAPES.into_iter().cycle()) {
            let (own, rest) = points.split_at(member.draws.len());
            points = rest;
            plots.push(cluster(member, own, (color, shape)).into());
        }
        // The composite's transparent markers on top.
        plots.rotate_left(1);
        let layout = sized(&plots, title, HALF, HALF)
            .with_equal_aspect()
            .with_x_label("first dimension")
            .with_y_label("second dimension");
        let (elements, kept) = (first.vector.len(), 100.0 * plane.kept);
        let drawn = if first.plan.is_some() {
            format!(
                "entries of the codebook ({elements} elements), by the policy's probabilities; a larger marker was drawn more often"
            )
        } else {
            format!("vectors of {elements} elements, from the policy's normal distribution")
        };
        Some(Chart {
            key: self.key(None),
            note: format!(
                "Drawn: {drawn}. The two dimensions keep {kept:.0} % of the squared distances from the centre."
            ),
            ..chart(plots, layout)
        })
    }
}

/// Draws of an instruction as markers, whose area is the number of draws.
fn cluster(
    member: &Member,
    points: &[[f64; 2]],
    (color, shape): (&str, MarkerShape),
) -> ScatterPlot {
    let places = together(&member.draws, points);
    let label = |place: &Place| {
        let plan = place
            .plan
            .map_or(String::new(), |it| format!(", plan {it}"));
        format!("{}{plan}: {} of {}", member.text, place.count, points.len())
    };
    ScatterPlot::new()
        .with_data(places.iter().map(|place| (place.at[0], place.at[1])))
        .with_sizes(places.iter().map(|it| MARKER * (it.count as f64).sqrt()))
        .with_color(color)
        .with_marker(shape)
        .with_marker_opacity(0.3)
        .with_marker_stroke_width(1.6)
        .with_tooltips()
        .with_tooltip_labels(places.iter().map(label))
}

/// Draws of the same plan.
struct Place {
    plan: Option<u32>,
    at: [f64; 2],
    count: usize,
}

/// Joins draws of the same entry of the codebook; plans that are vectors alone stay apart.
fn together(draws: &[Draw], points: &[[f64; 2]]) -> Vec<Place> {
    let mut places: Vec<Place> = Vec::new();
    for (draw, &at) in draws.iter().zip(points) {
        let mut known = places.iter_mut();
        match known.find(|place| place.plan.is_some() && place.plan == draw.plan) {
            Some(place) => place.count += 1,
            None => places.push(Place {
                plan: draw.plan,
                at,
                count: 1,
            }),
        }
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_of_one_plan_are_one_marker_and_vectors_stay_apart() {
        let draw = |plan| Draw {
            plan,
            vector: Vec::new(),
        };
        let at = [[0.0, 1.0], [2.0, 3.0], [0.0, 1.0]];
        let joined = |plans: [Option<u32>; 3]| {
            let places = together(&plans.map(draw), &at);
            places
                .iter()
                .map(|it| (it.at[0], it.count))
                .collect::<Vec<_>>()
        };
        assert_eq!(joined([Some(4), Some(1), Some(4)]), [(0.0, 2), (2.0, 1)]);
        assert_eq!(joined([None; 3]), [(0.0, 1), (2.0, 1), (0.0, 1)]);
    }
}
