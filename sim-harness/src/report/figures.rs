//! Figures of a page, and those of the paper that are drawn of one policy as of several: 5, 7 and 8.
//!
//! What an input has no data for is left out with a sentence that says why.

use lads_compiler::Contract;

use super::charts::Chart;
use super::compositions::{Composition, compositions};
use super::words::{self, Counts};
use crate::results::Results;
use crate::starts::Drawn;
use crate::trace::Trace;

/// Number of composite instructions whose Figures 5 and 7 are drawn.
const COMPOSITIONS: usize = 2;

/// Why episodes without a composite instruction and its parts have no Figures 5 and 7.
const NOT_COMPOSED: &str =
    "no composite instruction was run together with an instruction for each of its parts";

/// Why an environment without a gripper has no Figure 5.
const NO_GRIPPER: &str = "the environment does not say where a gripper is";

/// Why a policy without a vector for its plan has no Figure 7.
const NO_VECTOR: &str = "the policy keeps no vector of its plan from one decision to the next";

/// Why a policy that selects no plans has no Figure 8.
const NO_PLANS: &str = "the policy selects no numbered plans";

/// A figure with its explanation: charts, words by plan, and what was left out and why.
pub struct Figure {
    pub title: String,
    pub about: String,
    pub charts: Vec<Chart>,
    pub clouds: Vec<Cloud>,
    pub left_out: Vec<String>,
}

/// Words by plan of one policy.
pub struct Cloud {
    /// Name of the policy; empty where there is only one.
    pub name: String,
    pub plans: Vec<words::Plan>,
}

/// What a policy did, as far as Figures 5, 7 and 8 show it; where there is no data, why.
#[derive(Debug, Clone, PartialEq)]
pub struct Behaviour {
    /// Composite instructions that were run with their parts.
    pub compositions: Result<Vec<Composition>, String>,
    /// Words by plan.
    pub words: Result<Counts, String>,
}

impl Behaviour {
    /// Takes from an evaluation what the figures show.
    pub fn of(contract: &Contract, traces: &[Trace], drawn: &Drawn, results: &Results) -> Self {
        let found = compositions(contract, traces, drawn);
        Self {
            compositions: if found.is_empty() {
                Err(NOT_COMPOSED.to_owned())
            } else {
                Ok(found)
            },
            words: Self::words(super::words(results)),
        }
    }

    /// Takes the words by plan, of which a policy without plans has none.
    pub fn words(counts: Counts) -> Result<Counts, String> {
        if counts.is_empty() {
            return Err(NO_PLANS.to_owned());
        }
        Ok(counts)
    }
}

impl Figure {
    pub fn new(title: &str, about: &str, charts: Vec<Chart>) -> Self {
        Self {
            title: title.to_owned(),
            about: about.to_owned(),
            charts,
            clouds: Vec::new(),
            left_out: Vec::new(),
        }
    }

    pub fn is_empty(&self) -> bool {
        self.charts.is_empty() && self.clouds.is_empty() && self.left_out.is_empty()
    }

    /// Says what was left out and why: one sentence for all inputs with the same reason.
    pub fn leave_out(&mut self, reasons: &[(&str, &str)]) {
        let mut said: Vec<(&str, Vec<&str>)> = Vec::new();
        for &(name, why) in reasons {
            match said.iter_mut().find(|(known, _)| *known == why) {
                Some((_, names)) if names.contains(&name) => {}
                Some((_, names)) => names.push(name),
                None => said.push((why, vec![name])),
            }
        }
        self.left_out.extend(said.into_iter().map(|(why, names)| {
            let names = names.join(", ");
            let colon = if names.is_empty() { "" } else { ": " };
            format!("Left out: {names}{colon}{why}.")
        }));
    }
}

/// Draws Figures 5 and 7 of the paper: for the first composite instructions, one chart of each policy.
pub fn composed(policies: &[(&str, &Behaviour)]) -> [Figure; 2] {
    let mut paths = Figure::new(
        "Gripper of a composite instruction and its parts",
        "Figure 5 of the paper: where the gripper went in the first 10 control steps of up to 10 episodes of each instruction, from above, in \
         metres from where it began.",
        Vec::new(),
    );
    let mut plans = Figure::new(
        "Plans at the start of a composite instruction and its parts",
        "Figure 7 of the paper: 50 plans of each instruction, drawn from the policy's own distribution after what it saw in the first control \
         step of its episodes, in two dimensions by classical multidimensional scaling. Near points are similar plans; the axes have no meaning of \
         their own.",
        Vec::new(),
    );
    let (mut no_paths, mut no_plans) = (Vec::new(), Vec::new());
    let mut known: Vec<(&str, &[Composition])> = Vec::new();
    for (name, behaviour) in policies {
        match &behaviour.compositions {
            Ok(compositions) => known.push((name, compositions)),
            Err(why) => {
                no_paths.push((*name, why.as_str()));
                no_plans.push((*name, why.as_str()));
            }
        }
    }
    for text in shown(&known) {
        let own = known.iter().map(|&(name, of)| (name, find(of, text)));
        let reach = own.clone().filter_map(|(_, it)| Some(it?.reach()));
        let reach = reach.fold(0.0, f64::max);
        for (name, composition) in own {
            let Some(composition) = composition else {
                no_paths.push((name, NOT_COMPOSED));
                no_plans.push((name, NOT_COMPOSED));
                continue;
            };
            let colon = if name.is_empty() { "" } else { ": " };
            let title = format!("{name}{colon}{text}");
            match composition.paths(&title, reach) {
                Some(chart) => paths.charts.push(chart),
                None => no_paths.push((name, NO_GRIPPER)),
            }
            match composition.plans(&title) {
                Some(chart) => plans.charts.push(chart),
                None => no_plans.push((name, NO_VECTOR)),
            }
        }
    }
    paths.leave_out(&no_paths);
    plans.leave_out(&no_plans);
    [paths, plans]
}

fn find<'c>(compositions: &'c [Composition], text: &str) -> Option<&'c Composition> {
    compositions.iter().find(|it| it.text() == text)
}

/// Chooses the composite instructions that are shown: those that most policies have, in the first one's order.
fn shown<'k>(known: &[(&str, &'k [Composition])]) -> Vec<&'k str> {
    let all = known.iter().flat_map(|(_, of)| of.iter());
    let mut texts: Vec<&str> = Vec::new();
    for text in all.map(Composition::text) {
        if !texts.contains(&text) {
            texts.push(text);
        }
    }
    texts.sort_by_key(|text| {
        let having = known.iter().filter(|(_, of)| find(of, text).is_some());
        std::cmp::Reverse(having.count())
    });
    texts.truncate(COMPOSITIONS);
    texts
}

/// Shows the words by plan of each policy, Figure 8 of the paper.
pub fn words(policies: &[(&str, &Behaviour)]) -> Figure {
    let mut figure = Figure::new(
        "Words by plan",
        "Figure 8 of the paper: for each plan the most frequent words of the instructions under which it was decided, as a share of its \
         decisions, without articles, prepositions and conjunctions.",
        Vec::new(),
    );
    let mut reasons = Vec::new();
    for (name, behaviour) in policies {
        match &behaviour.words {
            Ok(counts) => figure.clouds.push(Cloud {
                name: (*name).to_owned(),
                plans: counts.by_plan(),
            }),
            Err(why) => reasons.push((*name, why.as_str())),
        }
    }
    figure.leave_out(&reasons);
    figure
}

#[cfg(test)]
mod tests {
    use super::*;

    fn without(why: &str) -> Behaviour {
        Behaviour {
            compositions: Err(why.to_owned()),
            words: Err(why.to_owned()),
        }
    }

    #[test]
    fn inputs_without_data_are_named_with_the_reason_once() {
        let (a, b, c) = (
            without("no steps"),
            without("no steps"),
            without("no plans"),
        );
        let policies = [("a", &a), ("b", &b), ("c", &c)];
        let wanted = ["Left out: a, b: no steps.", "Left out: c: no plans."];
        let figure = words(&policies);
        assert_eq!(figure.left_out, wanted);
        let [paths, plans] = composed(&policies);
        for figure in [paths, plans] {
            assert!(figure.charts.is_empty());
            let mut said = figure.left_out;
            said.sort();
            assert_eq!(said, wanted);
        }
        let alone = words(&[("", &a)]);
        assert_eq!(alone.left_out, ["Left out: no steps."]);
    }
}
