//! Renders `lads-run report`: one page about several policies in one environment, from bundles that ran, results and tables.

use std::collections::{BTreeMap, BTreeSet};

use askama::Template;

use super::charts::{self, Chart, Series};
use super::figures::{self, Behaviour, Figure};
use super::{Number, numbers};
use lads_proof::metrics::{Interval, K_RATES, Score};

/// Quantile of a standard normal number: 95 % lie within it.
const Z: f64 = 1.96;

/// Scores of a system on one split.
#[derive(Debug, Clone, PartialEq)]
pub struct Split {
    /// Name of the split.
    pub name: String,
    /// Scores of its episodes.
    pub score: Score,
    /// Largest number of sub-tasks that one of its instructions commands; `None` where the input does not say.
    pub commanded: Option<usize>,
}

/// A policy that is compared, or a row of a table: one system, of several seeds.
#[derive(Debug, Clone, PartialEq)]
pub struct System {
    /// Name in tables and charts.
    pub name: String,
    /// The input.
    pub file: String,
    /// Table and track that the system is a row of; `None` of an input of its own, which is beside every track.
    pub group: Option<String>,
    /// What ran, in one line.
    pub facts: String,
    /// Number of policies, of as many seeds, whose episodes are summed up.
    pub policies: usize,
    /// Scores by split.
    pub splits: Vec<Split>,
    /// What the systems of a sweep differ in, with this one's value; empty of others.
    pub sweep: BTreeMap<String, f64>,
    /// What the policy did.
    pub behaviour: Behaviour,
}

/// Systems of one environment, side by side.
pub struct Comparison<'c> {
    /// Id of the environment.
    pub environment: &'c str,
    /// The systems, in the order of the inputs.
    pub systems: Vec<System>,
}

/// A row of the success table: a split, or a system on it.
struct Row {
    name: String,
    group: String,
    policies: usize,
    /// None of a split.
    numbers: Vec<Number>,
}

#[derive(Template)]
#[template(path = "comparison.html")]
struct Page<'c> {
    environment: &'c str,
    /// Number of systems.
    count: usize,
    /// Name and description of each input, or of each track of a table.
    inputs: Vec<(&'c str, &'c System)>,
    /// Whether there are rows of tables among the systems.
    grouped: bool,
    rows: Vec<Row>,
    figures: Vec<Figure>,
}

impl Comparison<'_> {
    /// Renders the page.
    pub fn html(&self) -> Result<String, askama::Error> {
        let policies: Vec<(&str, &Behaviour)> = self
            .inputs()
            .map(|(name, system)| (name, &system.behaviour))
            .collect();
        let [paths, plans] = figures::composed(&policies);
        let page = Page {
            environment: self.environment,
            count: self.systems.len(),
            inputs: self.inputs().collect(),
            grouped: self.systems.iter().any(|it| it.group.is_some()),
            rows: self.rows(),
            figures: [self.rates()]
                .into_iter()
                .chain(self.sizes())
                .chain([paths, plans, figures::words(&policies)])
                .collect(),
        };
        page.render()
    }

    /// Lists the systems by their names; all rows of a track are one, by its name.
    fn inputs(&self) -> impl Iterator<Item = (&str, &System)> {
        let mut last = None;
        self.systems.iter().filter_map(move |system| {
            let name = system.group.as_deref().unwrap_or(&system.name);
            let again = system.group.is_some() && last == Some(name);
            last = Some(name);
            (!again).then_some((name, system))
        })
    }

    /// Names of all splits, in the order in which the systems name them.
    fn splits(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for split in self.systems.iter().flat_map(|system| &system.splits) {
            if split.score.episodes > 0 && !names.contains(&split.name.as_str()) {
                names.push(&split.name);
            }
        }
        names
    }

    /// Systems with episodes of a split.
    fn on<'s>(&'s self, name: &'s str) -> impl Iterator<Item = (&'s System, &'s Split)> + Clone {
        self.systems.iter().filter_map(move |system| {
            let mut splits = system.splits.iter();
            let split = splits.find(|split| split.name == name && split.score.episodes > 0)?;
            Some((system, split))
        })
    }

    fn rows(&self) -> Vec<Row> {
        let of_split = |name| {
            let most = most(self.on(name).map(|(_, split)| split));
            let systems = self.on(name).map(move |(system, split)| Row {
                name: system.name.clone(),
                group: system.group.clone().unwrap_or_default(),
                policies: system.policies,
                numbers: possible(numbers(&split.score), most),
            });
            let head = Row {
                name: name.to_owned(),
                group: String::new(),
                policies: 0,
                numbers: Vec::new(),
            };
            [head].into_iter().chain(systems)
        };
        self.splits().into_iter().flat_map(of_split).collect()
    }

    /// Draws Figure 3 of the paper: one chart for each split, and for each track of a table where there are several.
    fn rates(&self) -> Figure {
        let mut charts = Vec::new();
        for name in self.splits() {
            let mut groups: Vec<&str> = Vec::new();
            for group in self
                .on(name)
                .filter_map(|(system, _)| system.group.as_deref())
            {
                if !groups.contains(&group) {
                    groups.push(group);
                }
            }
            if groups.len() < 2 {
                charts.extend(self.rates_of(name, None));
            } else {
                let of_groups = groups.into_iter();
                charts.extend(of_groups.flat_map(|group| self.rates_of(name, Some(group))));
            }
        }
        let about = "Figure 3 of the paper: share of episodes that completed at least K of the commanded sub-tasks, or, where each instruction \
                     commands one, that carried it out; with Wilson 95 % intervals.";
        Figure::new("K-rates", about, charts)
    }

    /// Draws Figure 6 of the paper: the score by each size that systems were trained in several of; `None` without any.
    fn sizes(&self) -> Option<Figure> {
        let keys: BTreeSet<&String> = self.systems.iter().flat_map(|it| it.sweep.keys()).collect();
        let charts = keys.into_iter().filter_map(|key| {
            let whole = |split: &Split| split.commanded.is_none_or(|commanded| commanded < 2);
            let splits = self.splits();
            let successes = splits
                .iter()
                .all(|&name| self.on(name).all(|it| whole(it.1)));
            let curves = splits.iter().map(|&name| {
                let points = self.on(name).filter_map(|(system, split)| {
                    let score = &split.score;
                    let of_success = (score.full_success?, score.full_success_interval);
                    let (rate, bounds) = if successes {
                        of_success
                    } else {
                        let half = Z * score.n_rate_standard_error.unwrap_or(0.0);
                        let rate = score.n_rate?;
                        (rate, Interval(rate - half, rate + half))
                    };
                    Some((*system.sweep.get(key)?, rate, bounds))
                });
                let mut points: Vec<_> = points.collect();
                points.sort_by(|a, b| a.0.total_cmp(&b.0));
                (name, points)
            });
            let curves: Vec<_> = curves.filter(|(_, points)| points.len() > 1).collect();
            let measure = if successes { "success rate" } else { "N-rate" };
            charts::curves(key, measure, &curves)
        });
        let charts: Vec<_> = charts.collect();
        let about = "Figure 6 of the paper: one policy of each size, with 95 % intervals of its episodes; what another training would give is not in them.";
        (!charts.is_empty()).then(|| Figure::new("Sizes", about, charts))
    }

    fn rates_of(&self, name: &str, group: Option<&str>) -> Vec<Chart> {
        let own = |system: &System| {
            let own = system.group.as_deref();
            group.is_none() || own.is_none() || own == group
        };
        let on: Vec<_> = self.on(name).filter(|(system, _)| own(system)).collect();
        let most = most(on.iter().map(|&(_, split)| split));
        let series = on.iter().map(|(system, split)| Series {
            name: &system.name,
            score: &split.score,
        });
        let series: Vec<_> = series.collect();
        let title = match group {
            Some(group) => format!("{name} ({group})"),
            None => name.to_owned(),
        };
        if most > 1 {
            charts::k_rates(&title, &series, most)
        } else {
            charts::successes(&title, &series)
        }
    }
}

/// Leaves out the K-rates beyond `most`, which no episode can have.
fn possible(mut numbers: Vec<Number>, most: usize) -> Vec<Number> {
    // Episodes and N-rate come first, full success last.
    let k_rates = numbers.iter_mut().skip(2).take(K_RATES);
    for number in k_rates.skip(most.max(1)) {
        *number = Number {
            value: "–".to_owned(),
            within: String::new(),
        };
    }
    numbers
}

/// Returns the largest K that there is a rate of: by the instructions, where an input has them, else the largest that a system reached.
fn most<'s>(splits: impl Iterator<Item = &'s Split> + Clone) -> usize {
    let said = splits.clone().filter_map(|split| split.commanded).max();
    let reached = splits.map(|split| {
        let rates = split.score.k_rate.iter();
        rates.filter(|rate| rate.is_some_and(|it| it > 0.0)).count()
    });
    said.unwrap_or_else(|| reached.max().unwrap_or(0))
        .min(K_RATES)
}

#[cfg(test)]
mod tests {
    use super::*;
    use lads_proof::metrics::Outcome;

    fn system(name: &str, group: Option<&str>, commanded: Option<usize>) -> System {
        let outcome = |completed| Outcome {
            completed,
            un_instructed: 0,
            success: completed > 0,
        };
        System {
            name: name.to_owned(),
            file: format!("{name}.json"),
            group: group.map(str::to_owned),
            facts: String::new(),
            policies: 1,
            sweep: BTreeMap::new(),
            splits: vec![Split {
                name: "seen".to_owned(),
                score: Score::of([outcome(1), outcome(0)]),
                commanded,
            }],
            behaviour: Behaviour {
                compositions: Err("none".to_owned()),
                words: Err("none".to_owned()),
            },
        }
    }

    #[test]
    fn instructions_of_one_sub_task_have_bars_and_others_lines() {
        let rates = |commanded| {
            let systems = vec![system("a", None, commanded), system("b", None, None)];
            let comparison = Comparison {
                environment: "e",
                systems,
            };
            comparison.rates().charts.remove(0).svg
        };
        for (commanded, label) in [
            (None, "success rate"),
            (Some(1), "success rate"),
            (Some(3), "K-rate"),
        ] {
            assert!(
                rates(commanded).contains(&format!(">{label}<")),
                "{commanded:?}"
            );
        }
    }

    #[test]
    fn sizes_are_curves_by_what_they_vary() {
        let sized = |name: &str, sizes: &[(&str, f64)]| {
            let sizes = sizes.iter().map(|&(key, value)| (key.to_owned(), value));
            System {
                sweep: sizes.collect(),
                ..system(name, Some("sizes/x"), Some(4))
            }
        };
        let figure = |systems| {
            let environment = "e";
            let comparison = Comparison {
                environment,
                systems,
            };
            comparison.sizes()
        };
        let base = sized("base", &[("horizon", 10.0), ("codes", 40.0)]);
        assert!(figure(vec![base.clone()]).is_none(), "one size is no curve");
        let more = vec![
            base,
            sized("H", &[("horizon", 5.0)]),
            sized("M", &[("codes", 20.0)]),
            system("other", None, Some(4)),
        ];
        let charts = figure(more).unwrap().charts;
        assert_eq!(charts.len(), 2);
        assert!(charts[0].svg.contains(">codes<") && charts[1].svg.contains(">horizon<"));
        assert!(charts[1].svg.contains(">N-rate<"));
    }

    #[test]
    fn names_are_text_wherever_they_stand() {
        let comparison = Comparison {
            environment: "e",
            systems: vec![
                system("<i>a & b</i>", None, Some(1)),
                system("<i>c</i>", Some("<i>t</i>/x"), Some(4)),
            ],
        };
        let page = comparison.html().unwrap();
        assert!(!page.contains("<i>") && page.contains("a &amp; b"));
        let bars = charts::successes(
            "<i>",
            &[Series {
                name: "<i>a",
                score: &comparison.systems[0].splits[0].score,
            }],
        );
        assert!(!bars[0].svg.contains("<i>"));
    }

    #[test]
    fn tracks_have_charts_of_their_own_with_every_other_input() {
        let systems = vec![
            system("mine", None, Some(4)),
            system("LADS", Some("t/x"), Some(4)),
            system("LADS", Some("t/y"), Some(4)),
        ];
        let comparison = Comparison {
            environment: "e",
            systems,
        };
        let charts = comparison.rates().charts;
        assert_eq!(charts.len(), 2);
        for chart in &charts {
            assert_eq!(chart.svg.matches(">mine<").count(), 1);
            assert_eq!(chart.svg.matches(">LADS<").count(), 1);
        }
        let names: Vec<&str> = comparison.inputs().map(|(name, _)| name).collect();
        assert_eq!(names, ["mine", "t/x", "t/y"]);
        let rows = comparison.rows();
        assert_eq!(rows.len(), 4, "the split, then its systems");
        assert!(rows[0].numbers.is_empty() && rows[1].numbers.len() == 7);
    }
}
