//! Peers of lads: the runtimes that users would pick instead, on the very same graphs.
//!
//! ONNX Runtime, tract and rten run in this process; PyTorch and OpenVINO in Python, in a worker that keeps to the same
//! protocol. They run policies of the family `lads` and, but for the worker, of one entry. Only with the cargo feature `peers`.

pub mod cut;
pub mod engine;
pub mod general;
pub mod onnxruntime;
pub mod plain;
pub mod recompute;
pub mod rten;
pub mod tract;
pub mod worker;

use std::path::PathBuf;

use lads_pace::BenchError;
use lads_pace::contender::{Contender, Episode};
use lads_pace::suite::Others;

use cut::Source;
use engine::Engine;
use general::General;
use plain::Plain;
use worker::{NAMES, Worker};

/// Choice of the peers to run, and where they are.
#[derive(Debug, Clone, Default)]
pub struct Peers {
    /// The bundle's bytes.
    pub bundle: Vec<u8>,
    /// The shared library of ONNX Runtime.
    pub onnxruntime: Option<PathBuf>,
    /// Whether to run tract and rten.
    pub crates: bool,
    /// Python that has PyTorch or OpenVINO, and the bundle's file.
    pub python: Option<(PathBuf, PathBuf)>,
}

impl Others for Peers {
    fn open<'e>(
        &self,
        episode: &'e Episode,
        absent: &mut Vec<String>,
    ) -> Vec<Box<dyn Contender + 'e>> {
        let mut open: Vec<Box<dyn Contender + 'e>> = vec![];
        let source = match Source::new(&self.bundle) {
            Ok(source) => source,
            Err(error) => {
                absent.push(error.to_string());
                return open;
            }
        };
        let mut engines: Vec<Box<dyn Engine>> = vec![];
        if let Some(library) = &self.onnxruntime {
            match onnxruntime::OnnxRuntime::new(library) {
                Ok(engine) => engines.push(Box::new(engine)),
                Err(error) => absent.push(error.to_string()),
            }
        }
        if self.crates {
            engines.push(Box::new(tract::Tract));
            engines.push(Box::new(rten::Rten));
        }
        for engine in engines {
            match on(engine.as_ref(), &source, episode) {
                Ok(contender) => open.push(contender),
                Err(error) => absent.push(error.to_string()),
            }
        }
        if let Some((python, path)) = &self.python {
            for name in NAMES {
                match Worker::new(name, python, path, episode) {
                    Ok(contender) => open.push(Box::new(contender)),
                    Err(error) => absent.push(error.to_string()),
                }
            }
        }
        open
    }
}

/// Opens a bundle on a general runtime.
fn on<'e>(
    engine: &dyn Engine,
    source: &Source,
    episode: &'e Episode,
) -> Result<Box<dyn Contender + 'e>, BenchError> {
    Ok(match source.only_entry()? {
        Some(entry) => Box::new(Plain::new(engine, source, &entry, episode)?),
        None => Box::new(General::new(engine, source, episode)?),
    })
}
