//! Tests of the stages against oracles: tract for the meaning of a graph, a plain interpreter for
//! the effect of ops.

mod attention;
mod bombs;
mod doubles;
mod field;
mod images;
mod layers;
mod machine;
mod models;
mod nodes;
mod operators;
mod oracle;
mod plans;
mod programs;
mod reach;

use std::collections::HashMap;

use lads_image::op::CacheFormat;

use crate::bundle::Bundle;
use crate::entries::{self, Signature};
use crate::error::CompileError;
use crate::family::{Entry, Keep};
use crate::fuse::fuse;
use crate::import::Model;
use crate::lower::{Cache, Lowered, Weights, lower};
use crate::onnx::ModelProto;
use crate::plan::{Placed, plan};
use crate::storage::Storage;
use crate::verify::verify;

/// A program after all stages before the image.
struct Compiled {
    lowered: Lowered,
    placed: Placed,
    weights: Vec<f32>,
}

/// Compiles one entry, with the named outputs only, and proves its memory plan.
fn compiled(
    model: &ModelProto,
    signature: &Signature,
    outputs: &[&str],
    cache: Cache,
) -> Result<Compiled, CompileError> {
    let graph = model.graph.as_ref().expect("a graph");
    let entry = Model::new(model, graph)?.import(signature, &HashMap::new())?;
    let outputs: Vec<String> = outputs.iter().map(|&output| output.into()).collect();
    let fused = fuse(entry, signature, &outputs)?;
    let storage = Storage::default();
    let mut weights = Weights::new(&storage);
    let lowered = lower(&signature.entry, &fused, cache, &mut weights)?;
    let placed = plan(&lowered);
    verify(&lowered, &placed).expect("the memory plan is proven");
    Ok(Compiled {
        lowered,
        placed,
        weights: weights.data,
    })
}

/// One program of a bundle.
struct Program {
    entry: Entry,
    signature: Signature,
    cache: Cache,
    compiled: Compiled,
}

/// Returns the programs of a bundle that are compiled from its graphs, with a KV cache of `rows`
/// rows.
fn programs(bundle: &Bundle, rows: usize) -> Vec<Program> {
    let contract = bundle.contract();
    let blueprint = contract.family.kind().blueprint(contract);
    let signatures = entries::signatures(bundle.graph(), contract, &blueprint)
        .unwrap_or_else(|error| panic!("{error}"));
    let mut programs = vec![];
    for entry in &blueprint.entries {
        let found = signatures
            .iter()
            .find(|signature| Some(signature.entry.as_str()) == entry.graph());
        let Some(signature) = found else { continue };
        let kept = blueprint
            .states
            .iter()
            .find(|state| Some(&state.name) == entry.cache.as_ref())
            .map(|state| state.keep);
        let cache = match kept {
            Some(Keep::Kv(network)) => Cache::new(network, rows, CacheFormat::F32),
            _ => Cache::NONE,
        };
        let outputs: Vec<&str> = entry.outputs.iter().map(String::as_str).collect();
        let compiled = compiled(&bundle.model, signature, &outputs, cache)
            .unwrap_or_else(|error| panic!("{error}"));
        programs.push(Program {
            entry: entry.clone(),
            signature: signature.clone(),
            cache,
            compiled,
        });
    }
    programs
}
