//! Renders self-contained HTML files with nothing to fetch: `--report` about what a policy did, and `lads-run report`, which compares several
//! ([`Comparison`]).
//!
//! The charts are SVG inside the page, film strips are JPEG and the policy's own frames PNG inside it. Everything comes from the results and the traces; an episode's trace is needed for all but the success
//! table and the K-rates. What can fail: the template, which is compiled in.

mod charts;
mod compare;
mod compositions;
mod figures;
pub mod inputs;
mod plans;
mod scaling;
mod timelines;
mod words;

use std::collections::BTreeSet;

use askama::Template;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use lads_compiler::Contract;

use self::charts::{Chart, Series};
pub use self::compare::{Comparison, Split, System};
pub use self::figures::Behaviour;
use self::figures::Figure;
use crate::results::Results;
use crate::starts::Drawn;
use crate::trace::Trace;
use lads_proof::metrics::{Interval, K_RATES, Score};

/// Inputs of a report.
pub struct Report<'r> {
    /// Results of the evaluation.
    pub results: &'r Results,
    /// Traces of all episodes.
    pub traces: &'r [Trace],
    /// The contract of the policy's bundle.
    pub contract: &'r Contract,
    /// Number of the policy's plans; 0 if it selects none.
    pub plans: usize,
    /// Names of the sub-tasks that the environment watches.
    pub sub_tasks: &'r [&'static str],
    /// Plans drawn at the start of the episodes of the [`composed`] instructions.
    pub drawn: &'r Drawn,
    /// Pictures of the [`chosen`] episodes, or why there are none.
    pub strips: Result<Vec<Strip>, String>,
}

/// A picture of one moment of an episode.
pub struct Still {
    /// Caption of the picture.
    pub caption: String,
    /// The picture as JPEG.
    pub jpeg: Vec<u8>,
}

/// An episode in a few pictures.
pub struct Strip {
    /// Title: which episode.
    pub title: String,
    /// Pictures from the episode's start to its end.
    pub stills: Vec<Still>,
}

/// Largest number of episodes that are drawn as timelines and film strips.
const CHOSEN: usize = 6;

/// Chooses the episodes that are shown one by one: failed ones first, one of each instruction.
pub fn chosen(traces: &[Trace]) -> Vec<&Trace> {
    let mut chosen: Vec<&Trace> = traces.iter().filter(|t| !t.steps.is_empty()).collect();
    chosen.sort_by_key(|trace| trace.outcome.success);
    let mut seen = BTreeSet::new();
    chosen.retain(|trace| seen.insert(trace.instruction));
    chosen.truncate(CHOSEN);
    chosen
}

/// Lists the composite instructions that were run with all of their parts, and these parts.
pub fn composed(contract: &Contract, traces: &[Trace]) -> Vec<u32> {
    let found = compositions::find(contract, &compositions::run(traces));
    let all: BTreeSet<u32> = found.into_iter().flatten().collect();
    all.into_iter().collect()
}

/// Counts, for each plan, the words of the instructions under which it was decided.
fn words(results: &Results) -> words::Counts {
    words::Counts::of(results.instructions.iter().map(|result| {
        let plans = result.runs.iter().flat_map(|run| &run.plans).copied();
        (result.text.as_str(), plans.collect())
    }))
}

/// Title of an episode: its instruction, number and end.
pub fn title(contract: &Contract, trace: &Trace) -> String {
    let known = contract.instructions.get(trace.instruction as usize);
    format!(
        "{}, episode {}: {}",
        known.map_or("?", |known| known.id.as_str()),
        trace.episode,
        if trace.outcome.success {
            "carried out"
        } else {
            "failed"
        }
    )
}

/// A row of the success table.
struct Row {
    id: String,
    text: String,
    split: String,
    strong: bool,
    numbers: Vec<Number>,
}

/// A number of the table, with its interval.
struct Number {
    value: String,
    within: String,
}

/// A film strip, its pictures as text.
struct Film<'r> {
    title: &'r str,
    stills: Vec<(&'r str, String)>,
}

/// What the cameras showed in an episode: caption and file of each frame, as text.
struct Sight {
    title: String,
    frames: Vec<(String, String)>,
}

#[derive(Template)]
#[template(path = "report.html")]
struct Page<'r> {
    results: &'r Results,
    decision: String,
    rows: Vec<Row>,
    k_rates: Vec<Chart>,
    figures: Vec<Figure>,
    films: Vec<Film<'r>>,
    no_films: &'r str,
    /// None for a policy without cameras.
    sights: Vec<Sight>,
    /// Why the intervals of single instructions are wide, where they are.
    few: Option<Few>,
}

/// Note about few episodes of each instruction, with the widest interval that follows.
struct Few {
    episodes: u32,
    low: f64,
    high: f64,
}

/// Number of episodes per instruction below which their intervals say little.
const FEW: u32 = 10;

impl Report<'_> {
    /// Renders the page.
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
            k_rates: charts::k_rates("", &self.series(), K_RATES),
            figures: self.figures(),
            films: self.films(),
            no_films: self.strips.as_ref().err().map_or("", String::as_str),
            sights: self.sights(),
            few: self.few(),
        };
        page.render()
    }

    fn series(&self) -> Vec<Series<'_>> {
        let splits = self.results.splits.0.iter();
        let splits = splits.filter(|(_, result)| result.score.episodes > 0);
        let series = splits.map(|(name, result)| Series {
            name,
            score: &result.score,
        });
        series.collect()
    }

    fn rows(&self) -> Vec<Row> {
        let splits = self.results.splits.0.iter();
        let splits = splits.filter(|(_, result)| result.score.episodes > 0);
        let splits = splits.map(|(name, result)| Row {
            id: name.clone(),
            text: "all instructions of the split".to_owned(),
            split: name.clone(),
            strong: true,
            numbers: with_un_instructed(&result.score),
        });
        let each = self.results.instructions.iter().map(|result| Row {
            id: result.id.clone(),
            text: result.text.clone(),
            split: result.split.clone(),
            strong: false,
            numbers: with_un_instructed(&result.score),
        });
        splits.chain(each).collect()
    }

    fn few(&self) -> Option<Few> {
        let episodes = self.results.episodes_per_instruction;
        let each = self.results.instructions.iter();
        let intervals = each.flat_map(|result| {
            let score = &result.score;
            let measured = score.k_rate.iter().zip(score.k_rate_interval);
            measured.filter_map(|(rate, interval)| rate.map(|_| interval))
        });
        let width = |Interval(low, high): &Interval| high - low;
        let widest = intervals.max_by(|a, b| width(a).total_cmp(&width(b)));
        let Interval(low, high) = widest.filter(|_| episodes < FEW)?;
        Some(Few {
            episodes,
            low,
            high,
        })
    }

    fn films(&self) -> Vec<Film<'_>> {
        let strips = self.strips.as_deref().unwrap_or_default().iter();
        strips
            .map(|strip| Film {
                title: &strip.title,
                stills: strip
                    .stills
                    .iter()
                    .map(|it| (it.caption.as_str(), STANDARD.encode(&it.jpeg)))
                    .collect(),
            })
            .collect()
    }

    fn sights(&self) -> Vec<Sight> {
        let sight = |trace: &Trace| Sight {
            title: title(self.contract, trace),
            frames: (0..)
                .zip(&trace.steps)
                .flat_map(|(number, step)| {
                    let pictures = step
                        .pictures
                        .iter()
                        .filter(move |_| number == 0 || step.decided);
                    pictures.map(move |picture| {
                        let plan = step
                            .plan
                            .map_or(String::new(), |plan| format!(", plan {plan}"));
                        let caption = format!("{}, step {number}{plan}", picture.channel);
                        (caption, STANDARD.encode(&picture.png))
                    })
                })
                .collect(),
        };
        let mut sights: Vec<_> = chosen(self.traces).into_iter().map(sight).collect();
        sights.retain(|sight| !sight.frames.is_empty());
        sights
    }

    fn figures(&self) -> Vec<Figure> {
        // The first shows all instructions, the others composites and their parts.
        let starts = plans::start_distributions(self);
        let composites = starts.len() > 1;
        let behaviour = Behaviour::of(self.contract, self.traces, self.drawn, self.results);
        let alone = [("", &behaviour)];
        let [paths, starting] = figures::composed(&alone);
        let mut figures = vec![
            Figure::new(
                "Latent plans over an episode",
                "The plan in force at every control step. Vertical lines are completions, by number; those that the instruction does not ask \
                 for are grey and dotted. Episodes that failed come first.",
                timelines::timelines(self),
            ),
            Figure::new(
                "Plans at the start of an episode",
                if composites {
                    "Mean probability that the policy gives each plan in the first decision, by instruction. Then, for composite \
                     instructions: the line is the composite's distribution, the bars are those of its parts."
                } else {
                    "Mean probability that the policy gives each plan in the first decision, by instruction."
                },
                starts,
            ),
            Figure::new(
                "Gripper by plan",
                "Where the gripper went from the decision on while a plan was in force, for the plans used most, in metres from where it was.",
                plans::gripper(self),
            ),
            paths,
            starting,
            Figure::new(
                "Plans by word and by sub-task",
                "First: how often each plan was decided under instructions that contain a word, as a share of the word's decisions. Second: which plan was in \
                 force when a sub-task was completed, as a share of its completions.",
                plans::heat_maps(self),
            ),
            figures::words(&alone),
            Figure::new(
                "Latency of the controller",
                "All control steps, in microseconds, measured while all threads ran.",
                charts::latency(self),
            ),
        ];
        figures.retain(|figure| !figure.is_empty());
        figures
    }
}

fn numbers(score: &Score) -> Vec<Number> {
    let number = |x: Option<f64>| x.map_or("–".to_owned(), |x| format!("{x:.2}"));
    let plain = |value: String| Number {
        value,
        within: String::new(),
    };
    let with = |rate: Option<f64>, Interval(low, high): Interval| Number {
        value: number(rate),
        within: format!("{low:.2}–{high:.2}"),
    };
    let n_rate = Number {
        value: number(score.n_rate),
        within: score
            .n_rate_standard_error
            .map_or(String::new(), |error| format!("± {error:.2}")),
    };
    let k_rates = score.k_rate.iter().zip(score.k_rate_interval);
    let k_rates = k_rates.map(|(&rate, interval)| with(rate, interval));
    let full = with(score.full_success, score.full_success_interval);
    [plain(score.episodes.to_string()), n_rate]
        .into_iter()
        .chain(k_rates)
        .chain([full])
        .collect()
}

/// The numbers of a score, and the number of sub-tasks that nobody asked for.
fn with_un_instructed(score: &Score) -> Vec<Number> {
    let mut numbers = numbers(score);
    numbers.push(Number {
        value: score.un_instructed.to_string(),
        within: String::new(),
    });
    numbers
}
