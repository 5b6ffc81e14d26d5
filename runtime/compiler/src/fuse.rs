//! Passes over the graph, each of which makes a new graph: attention over the cache, channels of
//! images, convolutions, unused rows, linear layers.
//!
//! A pass changes how a value is computed, never the value itself, up to the rounding of folded
//! scales.

mod attention;
mod columns;
mod conv;
mod images;
mod linear;
mod rows;

use crate::entries::Signature;
use crate::error::CompileError;
use crate::graph::{Dim, Graph, Id, Op, Type, topological};
use crate::import::Entry;

/// One entry, ready to be lowered.
#[derive(Debug)]
pub(crate) struct Fused {
    pub graph: Graph,
    /// All inputs, including those that are no longer read.
    pub inputs: Vec<(String, Id)>,
    /// Requested outputs of the entry.
    pub outputs: Vec<(String, Id)>,
    /// Nodes of type `Record` for the layers whose attention is not computed.
    pub records: Vec<Id>,
    /// Number of tokens that a run appends to the cache.
    pub tokens: usize,
}

/// Fuses an entry, of which only some outputs are wanted besides the cache.
pub(crate) fn fuse(
    entry: Entry,
    signature: &Signature,
    wanted: &[String],
) -> Result<Fused, CompileError> {
    let name = signature.entry.as_str();
    let refused = |problem: String| CompileError::Entry {
        entry: name.into(),
        problem: problem.into(),
    };
    let Entry {
        graph,
        inputs,
        outputs,
    } = entry;
    let cached = attention::fuse(graph, &inputs, &outputs).map_err(|fault| fault.named(name))?;
    let kept: Vec<(String, Id)> = outputs
        .into_iter()
        .filter(|(output, _)| wanted.contains(output))
        .collect();
    // The constants that a value needs are part of it; inputs are kept so that their ports stay known.
    let mut fused = Fused {
        graph: cached.graph,
        inputs: cached.inputs,
        outputs: vec![],
        records: vec![],
        tokens: cached.tokens,
    };
    for (output, old) in kept {
        let id = cached.copies.get(&old).copied().ok_or_else(|| {
            refused(format!(
                "output {output} reads the cache outside an attention"
            ))
        })?;
        fused.outputs.push((output, id));
    }
    let roots: Vec<Id> = fused.outputs.iter().map(|&(_, id)| id).collect();
    let live = live_attentions(&fused.graph, &roots, &cached.layers);
    fused.records = cached
        .layers
        .iter()
        .zip(live)
        .filter(|(_, live)| !live)
        .map(|(layer, _)| layer.record)
        .collect();
    let fused = images::channels_to_the_end(fused).map_err(refused)?;
    let fused = conv::fuse(fused).map_err(refused)?;
    let fused = rows::narrow(fused).map_err(refused)?;
    let fused = linear::fuse(fused).map_err(refused)?;
    attention::no_past_left(&fused, name)?;
    Ok(fused)
}

impl Fused {
    /// Makes a program that only passes a value on: `output` is a copy of `input`.
    pub fn copy(input: &str, output: &str, shape: &[Dim]) -> Self {
        let mut graph = Graph::default();
        let id = graph.input(input, shape, Type::F32);
        Self {
            graph,
            inputs: vec![(input.into(), id)],
            outputs: vec![(output.into(), id)],
            records: vec![],
            tokens: 0,
        }
    }
}

/// Returns the layers whose attention is needed by the roots and by the recording of the other
/// layers.
fn live_attentions(graph: &Graph, roots: &[Id], layers: &[attention::Layer]) -> Vec<bool> {
    // A layer that only records needs the layers before it, so this is found from the last layer on.
    let mut live = vec![false; layers.len()];
    let mut roots = roots.to_vec();
    for (i, layer) in layers.iter().enumerate().rev() {
        let order = topological(graph, &roots, &std::collections::HashMap::new());
        live[i] = order
            .iter()
            .any(|&id| matches!(graph.op(id), Op::Attention { layer, .. } if *layer == i));
        if !live[i] {
            roots.push(layer.record);
        }
    }
    live
}

impl Fused {
    /// Returns all nodes that have to be computed.
    pub fn roots(&self) -> Vec<Id> {
        self.outputs
            .iter()
            .map(|&(_, id)| id)
            .chain(self.records.iter().copied())
            .collect()
    }

    /// Moves the entry to another graph, mapping the ids.
    fn mapped(self, graph: Graph, of: impl Fn(Id) -> Id) -> Self {
        let named = |values: Vec<(String, Id)>| {
            values
                .into_iter()
                .map(|(name, id)| (name, of(id)))
                .collect()
        };
        Self {
            graph,
            inputs: named(self.inputs),
            outputs: named(self.outputs),
            records: self.records.into_iter().map(&of).collect(),
            tokens: self.tokens,
        }
    }
}
