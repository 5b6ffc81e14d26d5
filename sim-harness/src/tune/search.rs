//! Searches candidates from the smallest up: group by group of entries, the largest first, then the caches, then layer by layer.
//!
//! Every candidate is asked with what was accepted before it in place, so that the last one that was accepted is the result, as it was
//! seen. The same parts and the same answers give the same result. What can fail: the trial itself.

use std::collections::BTreeSet;

use lads_compiler::{CacheFormat, Storage, WeightFormat};
use lads_proof::rounding::Rounding;

/// Formats of weights with fewer bits than 32, the smallest first; of two of one size the faster first.
pub(super) const WEIGHTS: [WeightFormat; 3] =
    [WeightFormat::Int8, WeightFormat::Int16, WeightFormat::F16];

/// Formats of caches with fewer bits than 32, the smallest first.
const CACHES: [CacheFormat; 2] = [CacheFormat::Int8, CacheFormat::F16];

/// A group of entry graphs that read the same weights.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Group {
    /// Names of the entry graphs.
    pub entries: BTreeSet<String>,
    /// Layers of the group.
    pub layers: Vec<Layer>,
}

/// A weight matrix, and the ONNX nodes that read it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layer {
    /// Names of the ONNX nodes.
    pub nodes: BTreeSet<String>,
    /// Number of weights.
    pub weights: usize,
    /// Whether integer formats may store it; a matrix that weighs its inputs very differently keeps its floats.
    pub takes_integers: bool,
}

impl Group {
    /// Number of weights of the group.
    pub fn weights(&self) -> usize {
        self.layers.iter().map(|layer| layer.weights).sum()
    }

    /// Names of the group's entries, as one text.
    pub fn name(&self) -> String {
        let names: Vec<_> = self.entries.iter().map(String::as_str).collect();
        names.join(", ")
    }
}

/// Parts of an image whose storage may change.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Parts {
    /// Groups of entries, the largest first.
    pub groups: Vec<Group>,
    /// Whether the image has KV caches.
    pub has_cache: bool,
}

/// The decision about one part.
#[derive(Debug, Clone, PartialEq)]
pub struct Choice {
    /// Names of the entry graphs, or `cache`.
    pub part: String,
    /// The chosen formats.
    pub stored: String,
    /// Smaller formats that do not give the same policy, each with the reason.
    pub refused: Vec<(String, String)>,
}

/// Result of a search.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// Smallest formats that keep every plan.
    pub storage: Storage,
    /// Comparison of the chosen formats with 32 bits.
    pub judged: Rounding,
    /// Decisions, part by part.
    pub choices: Vec<Choice>,
}

/// Searches for the smallest formats; `exact` is the comparison of 32 bits with themselves, `trial` asks one candidate.
pub fn search<E>(
    parts: &Parts,
    exact: Rounding,
    trial: &mut dyn FnMut(&Storage) -> Result<Rounding, E>,
) -> Result<Found, E> {
    let mut found = Found {
        judged: exact,
        storage: Storage::default(),
        choices: vec![],
    };
    for group in &parts.groups {
        let formats =
            WEIGHTS.map(|format| (format.name(), with(&found.storage, &group.entries, format)));
        let kept = WeightFormat::F32.name();
        found.choose(group.name(), kept, formats, trial)?;
    }
    if parts.has_cache {
        let formats =
            CACHES.map(|format| (format.name(), found.storage.clone().with_cache(format)));
        found.choose("cache".to_owned(), CacheFormat::F32.name(), formats, trial)?;
    }
    // Last, because a cache takes more than a layer.
    let smallest = WEIGHTS[0].name();
    for (group, choice) in parts.groups.iter().zip(0..) {
        if found.choices[choice].stored != smallest {
            let taken = layers(group, &mut found, trial)?;
            if taken > 0 {
                let all = group.layers.len();
                let more = format!(", {taken} of {all} layers {smallest}");
                found.choices[choice].stored.push_str(&more);
            }
        }
    }
    Ok(found)
}

impl Found {
    /// Takes the first candidate that is the same policy, or keeps the present one, under the name `kept`.
    fn choose<E>(
        &mut self,
        part: String,
        kept: &str,
        candidates: impl IntoIterator<Item = (&'static str, Storage)>,
        trial: &mut dyn FnMut(&Storage) -> Result<Rounding, E>,
    ) -> Result<(), E> {
        let mut choice = Choice {
            part,
            stored: kept.to_owned(),
            refused: vec![],
        };
        for (format, candidate) in candidates {
            let judged = trial(&candidate)?;
            if let Some(loss) = &judged.loss {
                choice.refused.push((format.to_owned(), loss.to_string()));
                continue;
            }
            format.clone_into(&mut choice.stored);
            self.storage = candidate;
            self.judged = judged;
            break;
        }
        self.choices.push(choice);
        Ok(())
    }
}

/// Returns the storage with another format of these parts.
fn with(storage: &Storage, parts: &BTreeSet<String>, format: WeightFormat) -> Storage {
    let storage = storage.clone();
    parts
        .iter()
        .fold(storage, |storage, part| storage.with_part(part, format))
}

/// Gives single layers of a group the smallest format, the one that moves the answers least for its size first; returns how many.
fn layers<E>(
    group: &Group,
    found: &mut Found,
    trial: &mut dyn FnMut(&Storage) -> Result<Rounding, E>,
) -> Result<usize, E> {
    let mut alone = vec![];
    let layers = group.layers.iter().filter(|layer| layer.takes_integers);
    for layer in layers {
        let judged = trial(&with(&found.storage, &layer.nodes, WEIGHTS[0]))?;
        if judged.is_same() {
            let moved = judged.largest_logit_difference;
            let moved = moved.max(judged.largest_action_difference);
            alone.push((layer, moved / layer.weights.max(1) as f64));
        }
    }
    alone.sort_by(|a, b| a.1.total_cmp(&b.1));
    let mut taken = 0;
    for (layer, _) in alone {
        let candidate = with(&found.storage, &layer.nodes, WEIGHTS[0]);
        let judged = trial(&candidate)?;
        if judged.is_same() {
            found.storage = candidate;
            found.judged = judged;
            taken += 1;
        }
    }
    Ok(taken)
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use lads_proof::rounding::Loss;

    use super::*;

    fn parts() -> Parts {
        let group = |entries: &[&str], layers: &[&[&str]]| Group {
            entries: entries.iter().map(|&name| name.to_owned()).collect(),
            layers: layers
                .iter()
                .map(|nodes| Layer {
                    nodes: nodes.iter().map(|&name| name.to_owned()).collect(),
                    weights: 10,
                    takes_integers: nodes[0] != "d",
                })
                .collect(),
        };
        Parts {
            groups: vec![
                group(&["choose", "hear"], &[&["a", "e"], &["b"], &["c"]]),
                group(&["act"], &[&["d"]]),
            ],
            has_cache: true,
        }
    }

    /// Searches with a policy that is the same while `is_same` says so.
    fn searched(is_same: impl Fn(&Storage) -> bool) -> (Found, usize) {
        let mut trials = 0;
        let found = search(&parts(), Rounding::default(), &mut |storage| {
            trials += 1;
            let loss = Loss::Encoded { changed: 1 };
            Ok::<_, Infallible>(Rounding {
                loss: (!is_same(storage)).then_some(loss),
                ..Rounding::default()
            })
        });
        (found.unwrap_or_else(|never| match never {}), trials)
    }

    #[test]
    fn what_may_be_small_is() {
        let (found, trials) = searched(|_| true);
        let all = Storage::default()
            .with_part("choose", WeightFormat::Int8)
            .with_part("hear", WeightFormat::Int8)
            .with_part("act", WeightFormat::Int8)
            .with_cache(CacheFormat::Int8);
        assert_eq!(found.storage, all);
        assert_eq!(trials, 3);
        let stored: Vec<_> = found.choices.iter().map(|choice| &*choice.stored).collect();
        assert_eq!(stored, ["int8", "int8", "int8"]);
    }

    #[test]
    fn the_layer_that_is_the_reason_keeps_its_bits() {
        let int8 = |storage: &Storage, node| storage.of("choose", node) == WeightFormat::Int8;
        let (found, _) = searched(|storage| {
            let weights = !int8(storage, "b") && storage.of("act", "d") == WeightFormat::F32;
            weights && storage.cache != CacheFormat::Int8
        });
        let wanted = Storage::default()
            .with_part("choose", WeightFormat::Int16)
            .with_part("hear", WeightFormat::Int16)
            .with_part("e", WeightFormat::Int8)
            .with_part("a", WeightFormat::Int8)
            .with_part("c", WeightFormat::Int8)
            .with_cache(CacheFormat::F16);
        assert_eq!(found.storage, wanted);
        assert_eq!(found.choices[0].stored, "int16, 2 of 3 layers int8");
        assert_eq!(found.choices[1].stored, "f32");
        assert_eq!(found.choices[2].stored, "f16");
        let refused: Vec<_> = found.choices[1]
            .refused
            .iter()
            .map(|(name, _)| &**name)
            .collect();
        assert_eq!(refused, ["int8", "int16", "f16"]);
    }

    #[test]
    fn what_must_not_change_does_not() {
        let (found, _) = searched(Storage::is_exact);
        assert!(found.storage.is_exact() && found.judged.is_same());
    }
}
