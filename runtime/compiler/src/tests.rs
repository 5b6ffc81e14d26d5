//! Tests of the stages against oracles: tract for what a graph means, a plain interpreter for what ops do.

mod attention;
mod bombs;
mod layers;
mod machine;
mod models;
mod nodes;
mod operators;
mod oracle;
mod plans;
mod programs;

use std::collections::HashMap;

use lads_image::op::Port;

use crate::entries::Signature;
use crate::error::CompileError;
use crate::fuse::fuse;
use crate::import::Model;
use crate::lower::{Cache, Lowered, Weights, lower};
use crate::onnx::ModelProto;
use crate::plan::{Placed, plan};
use crate::verify::verify;

/// A program as far as the stages before the image take it.
struct Compiled {
    lowered: Lowered,
    placed: Placed,
    weights: Vec<f32>,
}

/// Compiles one entry, the named outputs only, and proves its memory plan.
fn compiled(
    model: &ModelProto,
    signature: &Signature,
    outputs: &[&str],
    ports: &[(&str, Port)],
    cache: Cache,
) -> Result<Compiled, CompileError> {
    let graph = model.graph.as_ref().expect("a graph");
    let entry = Model::new(model, graph)?.import(signature, &HashMap::new())?;
    let fused = fuse(entry, signature, outputs)?;
    let mut weights = Weights::default();
    let lowered = lower(signature.entry, &fused, ports, cache, &mut weights)?;
    let placed = plan(&lowered);
    verify(&lowered, &placed).expect("the memory plan is proven");
    Ok(Compiled {
        lowered,
        placed,
        weights: weights.data,
    })
}
