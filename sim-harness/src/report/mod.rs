//! `--report`: one HTML file that says and shows what a policy did, with nothing to fetch.
//!
//! The charts are SVG inside the page. Everything comes from the results and the traces; an episode's trace is needed for all but the success
//! table and the K-rates. What can fail: the template, which is compiled in.

mod charts;

use askama::Template;
use lads_core::Contract;

use crate::metrics::{Interval, Score};
use crate::results::Results;
use crate::trace::Trace;

/// What a report is made of.
pub struct Report<'r> {
    /// The results.
    pub results: &'r Results,
    /// Every episode's control steps.
    pub traces: &'r [Trace],
    /// The policy's contract.
    pub contract: Contract<'r>,
    /// Names of the sub-tasks that the environment watches.
    pub sub_tasks: &'r [&'static str],
}

/// A row of the success table.
struct Row {
    id: String,
    text: String,
    split: String,
    strong: bool,
    numbers: Vec<String>,
}

/// A chart with what it shows.
struct Figure {
    title: String,
    about: String,
    svgs: Vec<String>,
}

#[derive(Template)]
#[template(path = "report.html")]
struct Page<'r> {
    results: &'r Results,
    decision: String,
    rows: Vec<Row>,
    figures: Vec<Figure>,
}

impl Report<'_> {
    /// The page.
    pub fn html(&self) -> Result<String, askama::Error> {
        let results = self.results;
        let decision = match results.decision.temperature {
            Some(temperature) => format!("plans sampled at temperature {temperature}"),
            None => format!("plans by {}", results.decision.rule),
        };
        let page = Page {
            results,
            decision,
            rows: self.rows(),
            figures: self.figures(),
        };
        page.render()
    }

    fn rows(&self) -> Vec<Row> {
        let splits = self.results.splits.0.iter();
        let splits = splits.filter(|(_, result)| result.score.episodes > 0);
        let splits = splits.map(|(name, result)| Row {
            id: name.clone(),
            text: "all instructions of the split".to_owned(),
            split: name.clone(),
            strong: true,
            numbers: numbers(&result.score),
        });
        let each = self.results.instructions.iter().map(|result| Row {
            id: result.id.clone(),
            text: result.text.clone(),
            split: result.split.clone(),
            strong: false,
            numbers: numbers(&result.score),
        });
        splits.chain(each).collect()
    }

    fn figures(&self) -> Vec<Figure> {
        let figure = |title: &str, about: &str, svgs: Vec<String>| Figure {
            title: title.to_owned(),
            about: about.to_owned(),
            svgs,
        };
        let mut figures = vec![figure(
            "K-rates",
            "Share of episodes that completed at least K of the commanded sub-tasks, with Wilson 95 % intervals.",
            charts::k_rates(self.results),
        )];
        if self.traces.is_empty() {
            return figures;
        }
        figures.extend([
            figure(
                "Latent plans over an episode",
                "The plan in force at every control step; vertical lines are completions. Episodes that failed come first.",
                charts::timelines(self),
            ),
            figure(
                "Plans at the start of an episode",
                "Mean probability that the high level gives each plan in the first decision, by instruction. Where a composite instruction has \
                 atomic ones in the contract, the line is the composite's distribution and the bars are its parts'.",
                charts::start_distributions(self),
            ),
            figure(
                "Gripper by plan",
                "Where the gripper went from the decision on while a plan was in force, for the plans used most, in metres from where it was.",
                charts::gripper(self),
            ),
            figure(
                "Plans by word and by sub-task",
                "Left: how often each plan was decided under instructions that contain a word, as a share of the word's decisions. Right: which plan was in \
                 force when a sub-task was completed, as a share of its completions.",
                charts::heat_maps(self),
            ),
            figure(
                "Latency of the controller",
                "All control steps, in microseconds, measured while all threads ran. The slowest 1 % are beyond the right edge.",
                charts::latency(self),
            ),
        ]);
        figures.retain(|figure| !figure.svgs.is_empty());
        figures
    }
}

fn numbers(score: &Score) -> Vec<String> {
    let number = |x: Option<f64>| x.map_or("–".to_owned(), |x| format!("{x:.2}"));
    let with = |rate: Option<f64>, Interval(low, high): Interval| {
        format!("{} [{low:.2}, {high:.2}]", number(rate))
    };
    let n_rate = match score.n_rate_standard_error {
        Some(error) => format!("{} ± {error:.2}", number(score.n_rate)),
        None => number(score.n_rate),
    };
    let k_rates = score.k_rate.iter().zip(score.k_rate_interval);
    let k_rates = k_rates.map(|(&rate, interval)| with(rate, interval));
    let full = with(score.full_success, score.full_success_interval);
    [score.episodes.to_string(), n_rate]
        .into_iter()
        .chain(k_rates)
        .chain([full, score.un_instructed.to_string()])
        .collect()
}
