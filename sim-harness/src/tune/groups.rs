//! Groups layers by the weights that they read, and entries by the layers that they share.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::ops::Range;

use lads_compiler::LayerReport;

use super::search::{Group, Layer};

/// Groups collected so far, with the ranges of their weights.
#[derive(Debug, Default)]
pub(super) struct Groups(Vec<(Group, Vec<Range<usize>>)>);

impl Groups {
    /// Adds a layer of an entry to its group.
    pub fn add(&mut self, entry: &str, layer: &LayerReport, takes_integers: bool) {
        let shares =
            |words: &Range<usize>| words.start < layer.words.end && layer.words.start < words.end;
        let belongs = |(group, words): &(Group, Vec<Range<usize>>)| {
            group.entries.contains(entry) || words.iter().any(shares)
        };
        let (mut ours, others): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.0).into_iter().partition(belongs);
        self.0 = others;
        let (mut group, mut words) = ours.pop().unwrap_or_default();
        for (other, its_words) in ours {
            group.entries.extend(other.entries);
            group.layers.extend(other.layers);
            words.extend(its_words);
        }
        group.entries.insert(entry.to_owned());
        if let Some(at) = words.iter().position(shares) {
            let known = &mut group.layers[at];
            known.nodes.insert(layer.node.clone());
            known.weights = known.weights.max(layer.weights);
            words[at] = words[at].start.min(layer.words.start)..words[at].end.max(layer.words.end);
        } else {
            group.layers.push(Layer {
                nodes: BTreeSet::from([layer.node.clone()]),
                weights: layer.weights,
                takes_integers,
            });
            words.push(layer.words.clone());
        }
        self.0.push((group, words));
    }

    /// Returns the groups, the one with the most weights first.
    pub fn sorted(self) -> Vec<Group> {
        let mut groups: Vec<_> = self.0.into_iter().map(|(group, _)| group).collect();
        groups.sort_by_key(|group| (Reverse(group.weights()), group.name()));
        groups
    }
}

#[cfg(test)]
mod tests {
    use lads_compiler::WeightFormat;

    use super::*;

    fn layer(node: &str, words: Range<usize>) -> LayerReport {
        LayerReport {
            node: node.to_owned(),
            weights: words.len(),
            format: WeightFormat::F32,
            words,
        }
    }

    #[test]
    fn entries_that_share_weights_are_one_group() {
        let mut groups = Groups::default();
        groups.add("act", &layer("a", 0..10), true);
        groups.add("step", &layer("b", 10..50), true);
        groups.add("start", &layer("c", 50..60), true);
        // Some columns of the step's matrix.
        groups.add("start", &layer("d", 20..30), true);
        let groups = groups.sorted();
        let names: Vec<_> = groups.iter().map(Group::name).collect();
        assert_eq!(names, ["start, step", "act"]);
        let layers: Vec<Vec<&str>> = groups[0]
            .layers
            .iter()
            .map(|layer| layer.nodes.iter().map(String::as_str).collect())
            .collect();
        assert_eq!(layers.concat().len(), 3);
        assert!(layers.contains(&vec!["b", "d"]), "{layers:?}");
        assert_eq!(groups[0].weights(), 50);
    }
}
