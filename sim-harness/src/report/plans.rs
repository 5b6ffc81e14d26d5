//! Charts of what plans are used for: by instruction at the start, by the gripper's path, by word and by
//! sub-task.

use std::collections::BTreeMap;

use kuva::plot::scatter3d::Scatter3DPlot;
use kuva::plot::{BarPlot, ColorMap, Heatmap, LegendPosition, LinePlot};
use kuva::render::plots::Plot;

use super::Report;
use super::charts::{COLORS, Chart, HALF, WHOLE, chart, sized};
use super::compositions;

/// Computes the mean softmax of the first decision's scores, by instruction.
fn starts(report: &Report<'_>) -> BTreeMap<u32, Vec<f64>> {
    let mut starts: BTreeMap<u32, (Vec<f64>, f64)> = BTreeMap::new();
    for trace in report.traces {
        let Some(first) = trace.steps.first().filter(|step| !step.scores.is_empty()) else {
            continue;
        };
        let most = first.scores.iter().copied().fold(f32::MIN, f32::max);
        let weights: Vec<f64> = first
            .scores
            .iter()
            .map(|&score| f64::from(score - most).exp())
            .collect();
        let total: f64 = weights.iter().sum();
        let (sums, count) = starts.entry(trace.instruction).or_default();
        sums.resize(weights.len(), 0.0);
        for (sum, weight) in sums.iter_mut().zip(weights) {
            *sum += weight / total;
        }
        *count += 1.0;
    }
    let mean = |(sums, count): (Vec<f64>, f64)| sums.iter().map(|sum| sum / count).collect();
    starts
        .into_iter()
        .map(|(i, sums)| (i, mean(sums)))
        .collect()
}

/// Draws the first decision's distribution over plans: Figure 4 of the paper, and a heat map of all instructions.
pub fn start_distributions(report: &Report<'_>) -> Vec<Chart> {
    let starts = starts(report);
    let id = |i: u32| {
        let known = report.contract.instructions.get(i as usize);
        known.map_or("?", |known| known.id.as_str()).to_owned()
    };
    let rows = starts
        .iter()
        .map(|(&i, row)| (id(i), row.clone()))
        .collect();
    let mut charts = heat_map("first decision: mean probability", rows, report.plans);
    let run: Vec<u32> = starts.keys().copied().collect();
    for members in compositions::find(report.contract, &run).iter().take(4) {
        let rows: Vec<_> = members.iter().map(|i| (id(*i), &starts[i])).collect();
        charts.extend(parts(&rows));
    }
    charts
}

/// Draws the distribution of a composite instruction, the first of `rows`, over those of its parts.
fn parts(rows: &[(String, &Vec<f64>)]) -> Option<Chart> {
    let ((composite, line), atoms) = rows.split_first()?;
    let names = atoms.iter().map(|(name, _)| name.as_str()).collect();
    let mut bars = BarPlot::new().with_legend(names);
    for plan in 0..line.len() {
        let shares = atoms.iter().zip(COLORS[1..].iter().cycle());
        let shares = shares.map(|((_, of_atom), color)| (of_atom[plan], *color));
        bars = bars.with_group(plan.to_string(), shares);
    }
    let points = (1..).zip(*line).map(|(place, &p)| (f64::from(place), p));
    let line = LinePlot::new()
        .with_data(points)
        .with_color(COLORS[0])
        .with_legend(composite.to_owned());
    let plots = vec![bars.into(), line.into()];
    let layout = sized(&plots, composite, HALF, 300.0)
        .with_x_label("plan")
        .with_y_label("probability");
    Some(chart(plots, layout))
}

/// Draws rows of shares over the plans as a heat map; plans that no row has are left out.
fn heat_map(title: &str, rows: Vec<(String, Vec<f64>)>, plans: usize) -> Vec<Chart> {
    let share = |row: &[f64], plan: usize| row.get(plan).copied().unwrap_or(0.0);
    let used = |&plan: &usize| rows.iter().any(|(_, row)| share(row, plan) >= 0.005);
    let used: Vec<usize> = (0..plans).filter(used).collect();
    if rows.is_empty() || used.is_empty() {
        return Vec::new();
    }
    let data: Vec<Vec<f64>> = rows
        .iter()
        .map(|(_, row)| used.iter().map(|&plan| share(row, plan)).collect())
        .collect();
    let (width, height) = (
        200.0 + 20.0 * used.len() as f64,
        130.0 + 20.0 * rows.len() as f64,
    );
    let names: Vec<String> = rows.into_iter().map(|(name, _)| name).collect();
    let plan = |plan: &usize| format!("plan {plan}");
    let plots: Vec<Plot> = vec![
        Heatmap::new()
            .with_data(data)
            .with_labels(names.clone(), used.iter().map(plan).collect())
            .with_color_map(ColorMap::Viridis)
            .with_tooltips()
            .into(),
    ];
    let layout = sized(&plots, title, width.max(420.0), height.max(260.0))
        .with_x_label("plan")
        .with_x_categories(used.iter().map(ToString::to_string).collect())
        .with_y_categories(names);
    vec![chart(plots, layout)]
}

/// Draws the gripper's path while a plan is in force: Figures 5 and 10 of the paper.
pub fn gripper(report: &Report<'_>) -> Vec<Chart> {
    let Some(period) = report.contract.period() else {
        return Vec::new();
    };
    let mut ways: BTreeMap<u32, Vec<[f64; 3]>> = BTreeMap::new();
    let mut uses: BTreeMap<u32, usize> = BTreeMap::new();
    for segment in report
        .traces
        .iter()
        .flat_map(|trace| trace.steps.chunks(period))
    {
        let Some((Some(plan), Some(from))) = segment.first().map(|step| (step.plan, step.gripper))
        else {
            continue;
        };
        *uses.entry(plan).or_default() += 1;
        let way = segment.iter().filter_map(|step| step.gripper);
        let way = way.map(|at| [at[0] - from[0], at[1] - from[1], at[2] - from[2]]);
        ways.entry(plan).or_default().extend(way);
    }
    let mut most: Vec<u32> = ways.keys().copied().collect();
    most.sort_by_key(|plan| std::cmp::Reverse(uses.get(plan).copied().unwrap_or(0)));
    let plots: Vec<Plot> = most
        .into_iter()
        .zip(COLORS)
        .filter_map(|(plan, color)| {
            let way = ways.get(&plan)?.iter().map(|&[x, y, z]| (x, y, z));
            let plot = Scatter3DPlot::new()
                .with_data(way)
                .with_color(color)
                .with_size(2.0)
                .with_x_label("x (m)")
                .with_y_label("y (m)")
                .with_z_label("z (m)")
                .with_grid_lines(3)
                .with_legend(format!("plan {plan}"));
            Some(plot.into())
        })
        .collect();
    if plots.is_empty() {
        return Vec::new();
    }
    let layout =
        sized(&plots, "", WHOLE, 520.0).with_legend_position(LegendPosition::OutsideRightTop);
    vec![chart(plots, layout)]
}

/// Draws the heat maps of Figure 9 of the paper.
pub fn heat_maps(report: &Report<'_>) -> Vec<Chart> {
    let size = report.plans;
    let by_word = super::words(report.results).by_word(size);
    let mut by_task: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for trace in report.traces {
        for done in &trace.outcome.completions {
            let name = report.sub_tasks.get(done.sub_task).copied();
            let step = done
                .step
                .checked_sub(1)
                .and_then(|step| trace.steps.get(step));
            if let (Some(name), Some(step)) = (name, step) {
                count(&mut by_task, name, step.plan, size);
            }
        }
    }
    let shares = |counts: BTreeMap<String, Vec<f64>>| {
        let share = |mut row: Vec<f64>| {
            let total: f64 = row.iter().sum();
            for count in &mut row {
                *count /= total.max(1.0);
            }
            row
        };
        counts
            .into_iter()
            .map(|(name, row)| (name, share(row)))
            .collect()
    };
    let mut charts = heat_map("plan by word: share of decisions", shares(by_word), size);
    charts.extend(heat_map(
        "plan by completed sub-task: share of completions",
        shares(by_task),
        size,
    ));
    charts
}

fn count(rows: &mut BTreeMap<String, Vec<f64>>, name: &str, plan: Option<u32>, size: usize) {
    let Some(plan) = plan else {
        return;
    };
    let row = rows
        .entry(name.to_owned())
        .or_insert_with(|| vec![0.0; size]);
    if let Some(count) = row.get_mut(plan as usize) {
        *count += 1.0;
    }
}
