//! Words per plan: under instructions with which words each plan was decided. Figure 8 of the paper, and the counts of its Figure 9.

use std::collections::{BTreeMap, BTreeSet};

/// Words without a meaning of their own, which say nothing about a plan.
const EMPTY: [&str; 13] = [
    "a", "an", "and", "at", "from", "in", "it", "of", "on", "the", "then", "to", "with",
];

/// Largest number of words that are shown of a plan.
const SHOWN: usize = 6;

/// Decisions for each plan, by the words of the instruction under which it was decided.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Counts(BTreeMap<u32, OfPlan>);

/// Decisions for one plan.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct OfPlan {
    decisions: usize,
    words: BTreeMap<String, usize>,
}

/// A plan with its most frequent words.
pub struct Plan {
    /// Index of the plan.
    pub index: u32,
    /// Number of decisions for the plan.
    pub decisions: usize,
    /// Words, most frequent first, each with the percentage of these decisions whose instruction has it.
    pub words: Vec<(String, f64)>,
}

impl Counts {
    /// Counts the decisions of episodes: for each instruction its text, and the plans decided in all of its episodes.
    pub fn of<'t>(decided: impl IntoIterator<Item = (&'t str, Vec<u32>)>) -> Self {
        let mut counts = Self::default();
        for (text, plans) in decided {
            let words: BTreeSet<String> = text
                .split(|letter: char| !letter.is_alphanumeric())
                .filter(|word| !word.is_empty())
                .map(str::to_lowercase)
                .collect();
            for plan in plans {
                let plan = counts.0.entry(plan).or_default();
                plan.decisions += 1;
                for word in &words {
                    *plan.words.entry(word.clone()).or_default() += 1;
                }
            }
        }
        counts
    }

    /// Whether nothing was decided.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns each word's number of decisions for each of `plans` plans.
    pub fn by_word(&self, plans: usize) -> BTreeMap<String, Vec<f64>> {
        let mut rows = BTreeMap::new();
        for (&plan, of_plan) in &self.0 {
            for (word, &count) in &of_plan.words {
                let row: &mut Vec<f64> =
                    rows.entry(word.clone()).or_insert_with(|| vec![0.0; plans]);
                if let Some(cell) = row.get_mut(plan as usize) {
                    *cell += count as f64;
                }
            }
        }
        rows
    }

    /// Returns the plans that were decided, each with its most frequent words but those without a meaning of their own.
    pub fn by_plan(&self) -> Vec<Plan> {
        let plan = |(&index, of_plan): (&u32, &OfPlan)| {
            let telling = of_plan.words.iter();
            let telling = telling.filter(|(word, _)| !EMPTY.contains(&word.as_str()));
            let mut words: Vec<(String, f64)> = telling
                .map(|(word, &count)| {
                    let percent = 100.0 * count as f64 / of_plan.decisions as f64;
                    (word.clone(), percent)
                })
                .collect();
            // Stable: words of the same share stay in the order of the alphabet.
            words.sort_by(|(_, a), (_, b)| b.total_cmp(a));
            words.truncate(SHOWN);
            Plan {
                index,
                decisions: of_plan.decisions,
                words,
            }
        };
        self.0.iter().map(plan).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts() -> Counts {
        Counts::of([
            ("Open the drawer.", vec![2, 2, 0]),
            ("turn the faucet, then open the DRAWER", vec![0]),
        ])
    }

    #[test]
    fn words_by_plan_by_hand() {
        let plans = counts().by_plan();
        let said: Vec<_> = plans.iter().map(|it| (it.index, it.decisions)).collect();
        assert_eq!(said, [(0, 2), (2, 2)]);
        let words = |place: usize| -> Vec<(&str, f64)> {
            let words = plans[place].words.iter();
            words.map(|(word, share)| (word.as_str(), *share)).collect()
        };
        assert_eq!(
            words(0),
            [
                ("drawer", 100.0),
                ("open", 100.0),
                ("faucet", 50.0),
                ("turn", 50.0)
            ]
        );
        assert_eq!(words(1), [("drawer", 100.0), ("open", 100.0)]);
    }

    #[test]
    fn plans_by_word_by_hand() {
        let rows = counts().by_word(3);
        assert_eq!(rows["drawer"], [2.0, 0.0, 2.0]);
        assert_eq!(rows["faucet"], [1.0, 0.0, 0.0]);
        assert_eq!(rows["the"], [2.0, 0.0, 2.0]);
        assert!(!rows.contains_key("THE") && !rows.contains_key(""));
        // A codebook that is smaller than a plan's index, in a damaged file, loses the count and nothing else.
        assert_eq!(counts().by_word(1)["drawer"], [2.0]);
    }
}
