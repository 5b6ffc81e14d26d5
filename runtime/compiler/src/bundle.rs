//! Opens a bundle: one ONNX file with its contract, its golden episode and the entry graphs of a
//! policy.
//!
//! A [`Bundle`] is checked as a whole before anything is compiled: the file is an ONNX model, its
//! contract is valid, every entry that a policy of its kind needs is there, and the shapes that the
//! entries declare match the contract. Nothing is written.

use std::path::Path;

use bytes::Bytes;
use lads_image::records::Event;
use prost::Message;

use crate::contract::Contract;
use crate::digest;
use crate::entries;
use crate::error::BundleError;
use crate::family::{Blueprint, Entry};
use crate::golden::Golden;
use crate::onnx::{self, GraphProto, ModelProto};
use crate::storage::{Tuned, without_record};

/// Number of known instructions that are suggested for an unknown one.
const NEAREST: usize = 3;

/// A checked bundle, as the exporter wrote it.
#[derive(Debug, Clone)]
pub struct Bundle {
    contract: Contract,
    golden: Golden,
    /// Number formats that the bundle was tuned for, or the error in that record, which matters
    /// only to callers that follow it.
    tuned: Result<Option<Tuned>, String>,
    sha256: String,
    untuned_sha256: String,
    bytes: usize,
    pub(crate) model: ModelProto,
}

/// Reads a regular file; a device or a FIFO has no end that could be waited for.
fn read_regular(path: &Path) -> std::io::Result<Vec<u8>> {
    let kind = std::fs::metadata(path)?.file_type();
    if kind.is_file() || kind.is_dir() {
        return std::fs::read(path);
    }
    Err(std::io::Error::new(
        std::io::ErrorKind::InvalidInput,
        "it is a device or a pipe, not a regular file",
    ))
}

impl Bundle {
    /// Opens a bundle file. Errors name the file.
    pub fn open(path: &Path) -> Result<Self, BundleError> {
        let read = || Self::from_owned(&read_regular(path)?.into());
        read().map_err(|source| BundleError::File {
            path: path.into(),
            source: Box::new(source),
        })
    }

    /// Opens a bundle from a file's content.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, BundleError> {
        Self::from_owned(&Bytes::copy_from_slice(bytes))
    }

    fn from_owned(bytes: &Bytes) -> Result<Self, BundleError> {
        let model = onnx::decode(bytes)?;
        let property = |key: &str| {
            model
                .metadata_props
                .iter()
                .find(|pair| pair.key == key)
                .map(|pair| pair.value.as_str())
        };
        let contract = Contract::parse(property("lads.contract").ok_or(BundleError::NoContract)?)?;
        let golden = property("lads.golden").ok_or_else(|| BundleError::Golden {
            problems: vec!["missing from the model's metadata".into()],
        })?;
        let golden = Golden::parse(golden, &contract)?;
        let tuned = Tuned::find(property);
        let sha256 = digest::sha256(bytes);
        let untuned_sha256 = match tuned {
            Ok(None) => sha256.clone(),
            _ => digest::sha256(&without_record(bytes)?),
        };
        let graph = model.graph.as_ref().ok_or_else(|| BundleError::NotOnnx {
            problem: "it has no graph".into(),
        })?;
        let blueprint = contract.family.kind().blueprint(&contract);
        entries::signatures(graph, &contract, &blueprint)?;
        Ok(Self {
            contract,
            golden,
            tuned,
            sha256,
            untuned_sha256,
            bytes: bytes.len(),
            model,
        })
    }

    /// Returns the contract: the policy's channels, states and instructions.
    pub fn contract(&self) -> &Contract {
        &self.contract
    }

    /// Returns the recorded episode.
    pub fn golden(&self) -> &Golden {
        &self.golden
    }

    /// Returns the number formats of an image and the evidence for them; `None` until the bundle is
    /// tuned. Fails if the record is invalid.
    pub fn tuned(&self) -> Result<Option<&Tuned>, BundleError> {
        let tuned = self.tuned.as_ref().map(Option::as_ref);
        tuned.map_err(|problem| BundleError::Storage {
            problem: problem.as_str().into(),
        })
    }

    /// Returns the names of the entry graphs whose outputs reach the action, not only the choice of
    /// an index.
    pub fn acting_entries(&self) -> Vec<String> {
        self.entries_that(|_, entry| entry.acts)
    }

    /// Returns the names of the entry graphs that nothing but the trajectory encoder calls.
    pub fn encoding_entries(&self) -> Vec<String> {
        self.entries_that(|blueprint, entry| {
            let mut events = blueprint.events_of(&entry.name).peekable();
            events.peek().is_some() && events.all(|event| event == Event::Encode)
        })
    }

    fn entries_that(&self, is: impl Fn(&Blueprint, &Entry) -> bool) -> Vec<String> {
        let blueprint = self.contract.family.kind().blueprint(&self.contract);
        let found = blueprint
            .entries
            .iter()
            .filter(|entry| is(&blueprint, entry));
        let mut names: Vec<_> = found
            .filter_map(|entry| entry.graph().map(str::to_owned))
            .collect();
        names.dedup();
        names
    }

    /// Returns the SHA-256 of the file, hexadecimal.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Returns the SHA-256 of the file before it was tuned: a reference, by which a bundle is
    /// tuned, names this one.
    pub fn untuned_sha256(&self) -> &str {
        &self.untuned_sha256
    }

    /// Returns the size of the file in bytes.
    pub fn len_bytes(&self) -> usize {
        self.bytes
    }

    /// Returns the value of a metadata key, for example `action_scale`.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.model
            .metadata_props
            .iter()
            .find(|pair| pair.key == key)
            .map(|pair| pair.value.as_str())
    }

    /// Returns the names of the entry graphs of the file, in the order of their first input.
    pub fn entries(&self) -> Vec<&str> {
        let mut found: Vec<&str> = vec![];
        for value in &self.graph().input {
            if let Some(entry) = entries::entry_of(&value.name)
                && !found.contains(&entry)
            {
                found.push(entry);
            }
        }
        found
    }

    /// Cuts one entry out as an ONNX model of its own, with the bundle's names, to run it with
    /// another runtime.
    pub fn entry_onnx(&self, entry: &str) -> Result<Vec<u8>, BundleError> {
        let graph = self.graph();
        let prefix = format!("{entry}/");
        let outputs: Vec<_> = graph
            .output
            .iter()
            .filter(|value| value.name.starts_with(&prefix))
            .cloned()
            .collect();
        if outputs.is_empty() {
            let problem = format!(
                "entry {entry} is missing; the file has {}",
                self.entries().join(", ")
            );
            return Err(BundleError::Entry {
                problems: vec![problem.into()],
            });
        }
        let roots = outputs.iter().map(|value| value.name.as_str());
        let node: Vec<_> = entries::needed(graph, roots).into_iter().cloned().collect();
        let read: std::collections::HashSet<&str> = node
            .iter()
            .flat_map(|node| &node.input)
            .map(String::as_str)
            .collect();
        let own = GraphProto {
            name: entry.into(),
            initializer: graph
                .initializer
                .iter()
                .filter(|tensor| read.contains(tensor.name.as_str()))
                .cloned()
                .collect(),
            sparse_initializer: vec![],
            input: graph
                .input
                .iter()
                .filter(|value| value.name.starts_with(&prefix))
                .cloned()
                .collect(),
            output: outputs,
            node,
        };
        let model = ModelProto {
            graph: Some(own),
            metadata_props: vec![],
            ..self.model.clone()
        };
        Ok(model.encode_to_vec())
    }

    /// Returns the indices of the instructions that a person means, by [the one
    /// rule](lads_core::instructions_called). The result is empty if there are none.
    pub fn instruction_indices(&self, text_or_id: &str) -> Vec<usize> {
        let known = self.contract.instructions.iter();
        let known = known.map(|known| (known.id.as_str(), known.text.as_str()));
        lads_core::instructions_called(known, text_or_id.as_bytes())
            .map(|index| index as usize)
            .collect()
    }

    /// Returns the known instructions that are most similar to a text, the best first.
    pub fn nearest_instructions(&self, text: &str) -> Vec<&str> {
        let wanted = plain(text);
        let mut scored: Vec<(f64, &str)> = self
            .contract
            .instructions
            .iter()
            .map(|known| {
                let by_text = strsim::normalized_damerau_levenshtein(&wanted, &plain(&known.text));
                let by_id = strsim::normalized_damerau_levenshtein(&wanted, &plain(&known.id));
                (by_text.max(by_id), known.text.as_str())
            })
            .collect();
        scored.sort_by(|a, b| b.0.total_cmp(&a.0));
        scored
            .into_iter()
            .take(NEAREST)
            .map(|(_, text)| text)
            .collect()
    }

    pub(crate) fn graph(&self) -> &GraphProto {
        static NONE: GraphProto = GraphProto {
            node: vec![],
            name: String::new(),
            initializer: vec![],
            sparse_initializer: vec![],
            input: vec![],
            output: vec![],
        };
        // Always there: opening the bundle asked for it.
        self.model.graph.as_ref().unwrap_or(&NONE)
    }
}

/// Normalises a text to lower case and single spaces.
fn plain(text: &str) -> String {
    text.to_lowercase()
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
}
