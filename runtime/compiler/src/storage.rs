//! Storage formats of an image's numbers, and the evidence for them: `lads.storage` in a bundle's
//! metadata.
//!
//! Fewer bits make a control step faster and can change the policy. `lads-run tune` finds the
//! smallest formats that keep its behaviour and writes them, with the evidence, into the bundle,
//! where [`compile`](crate::compile) finds them. What can fail: text that is not such a record, a
//! format that does not exist, a part that the bundle does not have.

use std::collections::BTreeMap;
use std::fmt;

use lads_image::op::{CacheFormat, WeightFormat};
use prost::Message as _;
use serde::{Deserialize, Serialize};

use crate::bundle::Bundle;
use crate::error::BundleError;
use crate::onnx::{StringStringEntryProto, fields};

/// Key of the metadata.
const KEY: &str = "lads.storage";

/// Version of the record that is read and written.
const VERSION: u32 = 1;

/// Number of a `ModelProto`'s field that holds its metadata.
const METADATA_FIELD: u64 = 14;

/// Storage formats of the weights of dense layers and convolutions and of the KV caches of an image;
/// all other numbers are 32-bit floats. Convolutions take the integer formats and keep 32 bits in
/// others; depthwise ones keep them always.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(into = "Names", try_from = "Names")]
pub struct Storage {
    /// Format of the weights of all dense layers and convolutions that `parts` does not name.
    pub weights: WeightFormat,
    /// Exceptions for parts: by the name of an entry graph, for example `low_level/act`, or of one
    /// ONNX node in it, which takes precedence.
    pub parts: BTreeMap<String, WeightFormat>,
    /// Format of the KV caches.
    pub cache: CacheFormat,
}

impl Storage {
    /// Makes a storage of all weights in one format, and of the caches with 32 bits.
    pub fn of_weights(weights: WeightFormat) -> Self {
        Self {
            weights,
            ..Self::default()
        }
    }

    /// Adds an exception for an entry graph or an ONNX node.
    #[must_use]
    pub fn with_part(mut self, part: &str, weights: WeightFormat) -> Self {
        self.parts.insert(part.to_owned(), weights);
        self
    }

    /// Sets the format of the KV caches.
    #[must_use]
    pub fn with_cache(mut self, cache: CacheFormat) -> Self {
        self.cache = cache;
        self
    }

    /// Returns whether all numbers are stored with 32 bits.
    pub fn is_exact(&self) -> bool {
        let mut weights = self.parts.values().chain([&self.weights]);
        weights.all(|&format| format == WeightFormat::F32) && self.cache == CacheFormat::F32
    }

    /// Returns the format of the weights of the layer that was made from `node` of `entry`.
    pub fn of(&self, entry: &str, node: &str) -> WeightFormat {
        let part = self.parts.get(node).or_else(|| self.parts.get(entry));
        part.copied().unwrap_or(self.weights)
    }
}

/// Formats the storage, for example `f16 weights (low_level/act f32) and an f16 cache`.
impl fmt::Display for Storage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} weights", self.weights.name())?;
        let parts = self.parts.iter();
        let others = parts.filter(|&(_, &format)| format != self.weights);
        let others: Vec<_> = others
            .map(|(part, format)| format!("{part} {}", format.name()))
            .collect();
        if !others.is_empty() {
            write!(f, " ({})", others.join(", "))?;
        }
        if self.cache != CacheFormat::F32 {
            write!(f, " and an {} cache", self.cache.name())?;
        }
        Ok(())
    }
}

/// Formats that a person chooses. Naming `weights` discards everything that the bundle was tuned
/// for; else formats that are left out are as tuned, and 32 bits if it was not tuned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Formats {
    /// Format of all weights.
    pub weights: Option<WeightFormat>,
    /// Format of the weights that the action depends on, not only the choice of an index, if it
    /// differs.
    pub low_level: Option<WeightFormat>,
    /// Format of the KV caches.
    pub cache: Option<CacheFormat>,
}

impl Formats {
    /// Returns the chosen storage for this bundle; `None` if nothing was chosen.
    pub fn storage(self, bundle: &Bundle) -> Result<Option<Storage>, BundleError> {
        if self == Self::default() {
            return Ok(None);
        }
        let mut storage = if let Some(weights) = self.weights {
            Storage::of_weights(weights)
        } else {
            let tuned = bundle.tuned()?.map(|tuned| tuned.storage.clone());
            tuned.unwrap_or_default()
        };
        if let Some(weights) = self.low_level {
            for entry in bundle.acting_entries() {
                // The names of an entry's nodes begin with its own.
                let inside = format!("{entry}/");
                storage.parts.retain(|part, _| !part.starts_with(&inside));
                storage.parts.insert(entry, weights);
            }
        }
        if let Some(cache) = self.cache {
            storage.cache = cache;
        }
        Ok(Some(storage))
    }
}

/// Evidence for a storage: the policy's answers to recorded questions with these formats, compared
/// with its answers with 32 bits.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Evidence {
    /// SHA-256 of the file with the questions, hexadecimal.
    pub reference_sha256: String,
    /// Number of episodes replayed.
    pub episodes: usize,
    /// Number of control steps in the episodes.
    pub steps: usize,
    /// Number of decisions in the episodes; every one selected the same index.
    pub decisions: usize,
    /// Smallest lead of a selected index over the second best, with 32 bits, in logits; left out if
    /// no decision has two logits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub smallest_margin: Option<f64>,
    /// Largest difference of a logit, up to a constant added to all of a decision's.
    pub largest_logit_error: f64,
    /// Number of segments of the episodes that the trajectory encoder saw; it chose the same plan
    /// for every one.
    pub segments: usize,
    /// Share of the decisions with two logits or more whose margin is more than `margin_factor`
    /// times the largest logit error.
    pub clear_share: f64,
    /// Factor of the largest logit error in `clear_share`.
    pub margin_factor: f64,
    /// Largest difference of an action's element, in the action's units.
    pub largest_action_error: f64,
    /// Largest difference of an action's element that is allowed, in the action's units.
    pub action_tolerance: f64,
}

/// The record of a tuned bundle: storage formats and their evidence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tuned {
    version: u32,
    /// Storage formats of the numbers.
    pub storage: Storage,
    /// Evidence that the formats suffice.
    pub evidence: Evidence,
}

impl Tuned {
    /// Makes a record of this version.
    pub fn new(storage: Storage, evidence: Evidence) -> Self {
        Self {
            version: VERSION,
            storage,
            evidence,
        }
    }

    /// Finds the record of a bundle, whose metadata is given by key; `None` if it has none, an
    /// error if it is invalid.
    pub(crate) fn find<'m>(
        property: impl Fn(&str) -> Option<&'m str>,
    ) -> Result<Option<Self>, String> {
        /// Fields that all versions have.
        #[derive(Deserialize)]
        struct Head {
            version: u32,
        }
        let Some(text) = property(KEY) else {
            return Ok(None);
        };
        let head: Head = serde_json::from_str(text).map_err(|error| error.to_string())?;
        if head.version != VERSION {
            let found = head.version;
            return Err(format!(
                "it has version {found}, this program reads version {VERSION}"
            ));
        }
        serde_json::from_str(text)
            .map(Some)
            .map_err(|error| error.to_string())
    }

    /// Returns a bundle's file with this record in place of its own; all other bytes are unchanged.
    pub fn written_into(&self, bundle: &[u8]) -> Result<Vec<u8>, BundleError> {
        let mut written = without_record(bundle)?;
        let pair = StringStringEntryProto {
            key: KEY.into(),
            value: serde_json::to_string(self).map_err(|error| BundleError::Storage {
                problem: error.to_string().into(),
            })?,
        };
        prost::encoding::message::encode(METADATA_FIELD as u32, &pair, &mut written);
        Ok(written)
    }
}

/// Returns a bundle's file as it was before it was tuned.
pub(crate) fn without_record(bundle: &[u8]) -> Result<Vec<u8>, BundleError> {
    let mut rest = Vec::with_capacity(bundle.len() + 1024);
    for field in fields(bundle)? {
        let is_record = field.number == METADATA_FIELD
            && StringStringEntryProto::decode(field.value).is_ok_and(|pair| pair.key == KEY);
        if !is_record {
            rest.extend_from_slice(field.whole);
        }
    }
    Ok(rest)
}

/// Names of the formats in the record.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Names {
    weights: String,
    #[serde(default)]
    parts: BTreeMap<String, String>,
    cache: String,
}

impl From<Storage> for Names {
    fn from(storage: Storage) -> Self {
        let parts = storage.parts.into_iter();
        Self {
            weights: storage.weights.name().into(),
            parts: parts
                .map(|(part, format)| (part, format.name().into()))
                .collect(),
            cache: storage.cache.name().into(),
        }
    }
}

impl TryFrom<Names> for Storage {
    type Error = String;

    fn try_from(names: Names) -> Result<Self, String> {
        let weights = |name: &str| named(name, WeightFormat::ALL, WeightFormat::name);
        let parts = names.parts.into_iter();
        Ok(Self {
            weights: weights(&names.weights)?,
            parts: parts
                .map(|(part, name)| Ok((part, weights(&name)?)))
                .collect::<Result<_, String>>()?,
            cache: named(&names.cache, CacheFormat::ALL, CacheFormat::name)?,
        })
    }
}

/// Returns the format with this name; else the known names.
pub fn named<T: Copy, const N: usize>(
    name: &str,
    known: [T; N],
    name_of: fn(T) -> &'static str,
) -> Result<T, String> {
    let found = known.into_iter().find(|&format| name_of(format) == name);
    found.ok_or_else(|| {
        let known = known.map(name_of).join(", ");
        format!("there is no format `{name}`; the formats are {known}")
    })
}

#[cfg(test)]
mod tests;
