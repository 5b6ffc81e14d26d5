//! Post-hoc labels: sentences that say what a trajectory did, by the rules of the `LOReL` benchmark.
//!
//! Each mug that moved gives one clause with its directions, the drawer and the faucet one each; directions within a clause and the
//! clauses are shuffled and joined with "and". A trajectory that moved nothing has no label. Nothing here can fail.

use super::spec::{BLACK_MUG, DRAWER, FAUCET, OBSERVATION_LEN, SUB_TASKS, SubTask, WHITE_MUG};
use crate::random::Stream;

/// Post-hoc label of a trajectory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Label {
    /// The label's sentence.
    pub text: String,
    /// Names of the sub-tasks that the sentence speaks of, in its order.
    pub sub_tasks: Vec<&'static str>,
}

/// Labels a trajectory from `start` to `end`; `None` where nothing moved far enough ("do nothing").
pub fn label(
    start: &[f64; OBSERVATION_LEN],
    end: &[f64; OBSERVATION_LEN],
    stream: &mut Stream,
) -> Option<Label> {
    let done = |elements: std::ops::Range<usize>| {
        let tasks = SUB_TASKS.iter().filter(|task| task.holds(start, end));
        tasks
            .filter(|task| elements.contains(&task.element))
            .collect::<Vec<&SubTask>>()
    };
    let objects = [
        WHITE_MUG..BLACK_MUG,
        BLACK_MUG..FAUCET,
        DRAWER..DRAWER + 1,
        FAUCET..FAUCET + 1,
    ];
    let mut clauses: Vec<Vec<&SubTask>> = objects.into_iter().map(done).collect();
    clauses.retain(|clause| !clause.is_empty());
    for clause in &mut clauses {
        shuffle(clause, stream);
    }
    shuffle(&mut clauses, stream);
    if clauses.is_empty() {
        return None;
    }
    let texts: Vec<String> = clauses.iter().map(|clause| sentence(clause)).collect();
    Some(Label {
        text: texts.join(" and "),
        sub_tasks: clauses.iter().flatten().map(|task| task.name).collect(),
    })
}

/// Joins the sub-tasks of one mug: the first one's name, then only the direction of each other one, which is its last word.
fn sentence(clause: &[&SubTask]) -> String {
    let word = |(place, task): (usize, &&SubTask)| match task.name.rsplit_once(' ') {
        Some((_, direction)) if place > 0 => direction,
        _ => task.name,
    };
    let words: Vec<_> = clause.iter().enumerate().map(word).collect();
    words.join(" and ")
}

/// Shuffles `items` in place by Fisher and Yates' method.
fn shuffle<T>(items: &mut [T], stream: &mut Stream) {
    for last in (1..items.len()).rev() {
        let other = (stream.unit() * (last + 1) as f64) as usize;
        items.swap(last, other);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    fn moved(changes: &[(usize, f64)]) -> [f64; OBSERVATION_LEN] {
        let mut end = [0.25; OBSERVATION_LEN];
        for &(element, change) in changes {
            end[element] += change;
        }
        end
    }

    #[test]
    fn every_order_of_clauses_and_directions_comes_up() {
        let mut stream = Stream::new(&[1]);
        let end = moved(&[(WHITE_MUG, 0.03), (WHITE_MUG + 1, 0.03), (DRAWER, -0.03)]);
        let mut seen = BTreeMap::new();
        for _ in 0..400 {
            let label = label(&[0.25; OBSERVATION_LEN], &end, &mut stream).unwrap();
            assert_eq!(label.sub_tasks.len(), 3);
            *seen.entry(label.text).or_insert(0) += 1;
        }
        let texts: Vec<_> = seen.keys().map(String::as_str).collect();
        assert_eq!(
            texts,
            [
                "move white mug down and left and open drawer",
                "move white mug left and down and open drawer",
                "open drawer and move white mug down and left",
                "open drawer and move white mug left and down",
            ]
        );
        // 100 expected of each, standard deviation 8.7.
        assert!(
            seen.values().all(|count| (60..140).contains(count)),
            "{seen:?}"
        );
    }

    #[test]
    fn thresholds_are_strict_and_nothing_has_no_label() {
        let start = [0.0; OBSERVATION_LEN];
        let mut end = start;
        end[FAUCET] = std::f64::consts::PI / 10.0;
        end[DRAWER] = 0.02;
        let mut stream = Stream::new(&[2]);
        assert_eq!(label(&start, &end, &mut stream), None);
        end[FAUCET] += 1e-9;
        let label = label(&start, &end, &mut stream).unwrap();
        assert_eq!(label.text, "turn faucet left");
    }
}
