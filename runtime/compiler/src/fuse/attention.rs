//! Finds the attention of each layer and turns it into one node over the cache.
//!
//! The anchors are the names of the cache's inputs and outputs. With `k`, `v` the new keys and values `[1, heads, N, head_dim]`:
//!
//! ```text
//! present.n.key   = concat(past_key_values.n.key, k)        (without a past: k itself)
//! present.n.value = concat(past_key_values.n.value, v)
//! scores          = concat(scale * q·past_key^T, scale * q·k^T + mask)
//! out             = softmax(scores)·present.n.value
//! ```
//!
//! All of it is verified: both products read the same `q`, both scales are the same number, and the
//! mask is zero on and below the diagonal and at most [`MASKED`] above. The scale may be applied to
//! any of the factors. A mismatch is an error that names the layer, because a cache that is read in
//! another way cannot be compiled.

use std::collections::HashMap;

use lads_image::op::BinaryKind;

use super::Fused;
use crate::error::CompileError;
use crate::graph::{Dim, Graph, Id, Kind, Op, Rewriter, show, topological};

/// Largest value of the mask that hides a token: such a score vanishes in the softmax beside any
/// unmasked one.
const MASKED: f32 = -1e4;

/// Largest relative difference of two scales of the same attention: the rounding of a folded
/// product.
const SCALE_TOLERANCE: f32 = 1e-6;

/// One layer of the cache.
pub(super) struct Layer {
    /// Node that appends the layer's new keys and values.
    pub record: Id,
}

/// An entry whose cache is read and written only by attentions.
pub(super) struct Cached {
    pub graph: Graph,
    pub inputs: Vec<(String, Id)>,
    pub layers: Vec<Layer>,
    pub tokens: usize,
    /// New nodes by the old nodes that they replace.
    pub copies: HashMap<Id, Id>,
}

/// Reason why the cache cannot be compiled, with the ONNX node.
pub(super) struct Fault {
    operator: String,
    node: String,
    problem: String,
}

impl Fault {
    pub fn named(self, entry: &str) -> CompileError {
        CompileError::Operator {
            entry: entry.into(),
            operator: self.operator.into(),
            node: self.node.into(),
            problem: self.problem.into(),
        }
    }
}

/// New keys, values and the attention of a layer, in the old graph.
struct Found {
    k: Id,
    v: Id,
    /// Match of the part to replace: `softmax(scores)·present.value`.
    out: Option<Match>,
    heads: usize,
}

struct Match {
    node: Id,
    q: Id,
    scale: f32,
}

/// Parts of a product of queries and keys.
struct Scores {
    q: Id,
    k: Id,
    scale: f32,
    /// Mask that is added after scaling, with the scale that was applied to it.
    mask: Option<(Id, f32)>,
}

pub(super) fn fuse(
    mut graph: Graph,
    inputs: &[(String, Id)],
    outputs: &[(String, Id)],
) -> Result<Cached, Fault> {
    let find = |values: &[(String, Id)], name: String| {
        values
            .iter()
            .find(|(other, _)| *other == name)
            .map(|&(_, id)| id)
    };
    let mut found = vec![];
    for layer in 0.. {
        let present = ["key", "value"].map(|part| find(outputs, format!("present.{layer}.{part}")));
        let [Some(key), Some(value)] = present else {
            break;
        };
        let past =
            ["key", "value"].map(|part| find(inputs, format!("past_key_values.{layer}.{part}")));
        let one = locate(&mut graph, past, key, value)
            .map_err(|problem| fault(&graph, value, layer, &problem))?;
        found.push(one);
    }
    rebuild(graph, &found, inputs, outputs)
}

fn fault(graph: &Graph, at: Id, layer: usize, problem: &str) -> Fault {
    let (operator, node) = graph.origin(at);
    let problem = format!(
        "ends an attention over the cache (layer {layer}) that is not understood: {problem}"
    );
    Fault {
        operator: operator.into(),
        node: node.into(),
        problem,
    }
}

/// Finds the parts of one layer.
fn locate(g: &mut Graph, past: [Option<Id>; 2], key: Id, value: Id) -> Result<Found, String> {
    let [past_key, past_value] = past;
    let new = |g: &Graph, past: Option<Id>, present: Id| match (past, g.op(present)) {
        (None, _) => Ok(present),
        (Some(past), Op::Concat { axis: 2 })
            if g.node(present).inputs.len() == 2 && g.node(present).inputs[0] == past =>
        {
            Ok(g.node(present).inputs[1])
        }
        _ => Err(
            "a present value is not its past and the new rows, concatenated along axis 2"
                .to_string(),
        ),
    };
    let (k, v) = (new(g, past_key, key)?, new(g, past_value, value)?);
    let heads = match g.known_shape(k).as_deref() {
        Some(&[1, heads, _, _]) if g.shape(k) == g.shape(v) => heads,
        _ => {
            return Err(format!(
                "new keys {} and values {} are not [1, heads, N, head_dim]",
                show(g.shape(k)),
                show(g.shape(v))
            ));
        }
    };
    let products: Vec<Id> = g
        .ids()
        .filter(|&id| *g.op(id) == Op::MatMul && g.node(id).inputs[1] == value)
        .collect();
    let out = match products[..] {
        [] => None,
        [node] => {
            let (q, scale) = attends(g, node, past_key, k, key)?;
            if g.shape(q) != g.shape(k) {
                return Err(format!(
                    "queries {} and new keys {} differ in shape",
                    show(g.shape(q)),
                    show(g.shape(k))
                ));
            }
            Some(Match { node, q, scale })
        }
        _ => return Err("more than one product reads the layer's values".into()),
    };
    Ok(Found { k, v, out, heads })
}

/// Checks the scores of an attention and returns its queries and scale.
fn attends(
    g: &mut Graph,
    out: Id,
    past: Option<Id>,
    k: Id,
    present: Id,
) -> Result<(Id, f32), String> {
    let weights = g.node(out).inputs[0];
    if *g.op(weights) != Op::Softmax {
        return Err("the values are not weighted by a softmax".into());
    }
    let all = g.node(weights).inputs[0];
    let Some(past) = past else {
        let new = scores(g, all)?;
        expect(new.k == k, "the scores do not read the layer's keys")?;
        causal(g, &new, k)?;
        return Ok((new.q, new.scale));
    };
    let last = g.shape(all).len() - 1;
    if *g.op(all) != (Op::Concat { axis: last }) {
        // One token sees the whole past and itself, so one product over all keys is as good.
        let whole = scores(g, all)?;
        expect(
            whole.k == present,
            "the scores read neither past and new keys apart nor all of them at once",
        )?;
        expect(
            g.shape(k)[2].is_one(),
            "one product over all keys hides no later token",
        )?;
        expect(
            whole.mask.is_none(),
            "a mask over past tokens is not supported",
        )?;
        return Ok((whole.q, whole.scale));
    }
    let &[old, new] = &g.node(all).inputs[..] else {
        return Err(
            "the scores are not concatenated from those of the past and the new tokens".into(),
        );
    };
    let (old, new) = (scores(g, old)?, scores(g, new)?);
    expect(
        old.k == past && new.k == k,
        "the scores do not read the past keys first and the new keys second",
    )?;
    expect(
        old.q == new.q,
        "the scores of past and new tokens read different queries",
    )?;
    expect(
        old.mask.is_none(),
        "a mask over past tokens is not supported",
    )?;
    let close = (old.scale - new.scale).abs() <= SCALE_TOLERANCE * new.scale.abs();
    expect(
        close,
        "the scores of past and new tokens have different scales",
    )?;
    causal(g, &new, k)?;
    Ok((new.q, new.scale))
}

fn expect(condition: bool, problem: &str) -> Result<(), String> {
    if condition {
        Ok(())
    } else {
        Err(problem.into())
    }
}

/// Checks that the mask is exactly triangular; a single token needs no mask.
fn causal(g: &Graph, scores: &Scores, k: Id) -> Result<(), String> {
    let n = g.known_shape(k).map_or(0, |shape| shape[2]);
    let Some((mask, scale)) = scores.mask else {
        return expect(n == 1, "no mask hides later tokens");
    };
    let shape = g.known_shape(mask).unwrap_or_default();
    let square = shape.ends_with(&[n, n]) && shape.iter().rev().skip(2).all(|&dim| dim == 1);
    let data = g.constant(mask).and_then(|tensor| tensor.as_f32());
    let (Some(data), true) = (
        data,
        square || (n == 1 && shape.iter().all(|&dim| dim == 1)),
    ) else {
        return Err(format!("the mask {shape:?} is not a constant [{n}, {n}]"));
    };
    let triangular = (0..n).all(|i| {
        (0..n).all(|j| {
            if j <= i {
                data[i * n + j] == 0.0
            } else {
                data[i * n + j] * scale <= MASKED
            }
        })
    });
    expect(
        triangular,
        "the mask is not zero on and below the diagonal and very negative above it",
    )
}

/// Splits a product of queries and keys into its parts.
fn scores(g: &mut Graph, mut at: Id) -> Result<Scores, String> {
    let mut scale = 1.0f32;
    let mut mask = None;
    loop {
        if let Some((x, factor)) = scalar_factor(g, at) {
            scale *= factor;
            at = x;
            continue;
        }
        let Op::Binary(Kind(BinaryKind::Add)) = g.op(at) else {
            break;
        };
        let inputs = &g.node(at).inputs;
        let (x, added) = if g.constant(inputs[0]).is_some() {
            (inputs[1], inputs[0])
        } else {
            (inputs[0], inputs[1])
        };
        expect(
            g.constant(added).is_some() && mask.is_none(),
            "something other than one constant mask is added to the scores",
        )?;
        mask = Some((added, scale));
        at = x;
    }
    expect(
        *g.op(at) == Op::MatMul,
        "the scores are not a scaled product of queries and keys",
    )?;
    let &[mut q, keys] = &g.node(at).inputs[..] else {
        return Err("a product has two operands".into());
    };
    while let Some((x, factor)) = scalar_factor(g, q) {
        scale *= factor;
        q = x;
    }
    let mut keys = keys;
    while let Some((x, factor)) = scalar_factor(g, keys) {
        scale *= factor;
        keys = x;
    }
    expect(g.shape(keys).len() == 4, "the keys have not four axes")?;
    let mut k = g.transpose(keys, &[0, 1, 3, 2])?;
    while let Some((x, factor)) = scalar_factor(g, k) {
        scale *= factor;
        k = x;
    }
    Ok(Scores { q, k, scale, mask })
}

/// Returns `x` and `c` of a node that computes `x * c` or `x / c` with a scalar constant.
fn scalar_factor(g: &Graph, id: Id) -> Option<(Id, f32)> {
    let inputs = &g.node(id).inputs;
    let scalar = |id: Id| {
        let tensor = g.constant(id)?;
        tensor.as_f32()?;
        (tensor.shape.iter().product::<usize>() == 1)
            .then(|| tensor.uniform())
            .flatten()
    };
    match g.op(id) {
        Op::Binary(Kind(BinaryKind::Mul)) => match (scalar(inputs[0]), scalar(inputs[1])) {
            (_, Some(c)) => Some((inputs[0], c)),
            (Some(c), None) => Some((inputs[1], c)),
            _ => None,
        },
        Op::Binary(Kind(BinaryKind::Div)) => scalar(inputs[1]).map(|c| (inputs[0], 1.0 / c)),
        _ => None,
    }
}

/// Copies the nodes that do not read the cache into a new graph, with the attentions as single
/// nodes.
fn rebuild(
    mut old: Graph,
    found: &[Found],
    inputs: &[(String, Id)],
    outputs: &[(String, Id)],
) -> Result<Cached, Fault> {
    let mut replace = HashMap::new();
    let mut records = vec![];
    for (layer, one) in found.iter().enumerate() {
        let at = one.out.as_ref().map_or(one.v, |out| out.node);
        let replaced =
            replaced(&mut old, layer, one).map_err(|problem| fault(&old, at, layer, &problem))?;
        if let (Some(out), Some(new)) = (&one.out, replaced.out) {
            replace.insert(out.node, new);
        }
        records.push(replaced.record);
    }
    let tokens = found.first().map_or(0, |one| old.shape(one.k)[2].fixed);
    // Present values are gone: they are the cache itself.
    let reads_cache = |id: Id| old.shape(id).iter().any(|dim| dim.past);
    let present = |name: &str| name.starts_with("present.");
    let mut roots: Vec<Id> = outputs
        .iter()
        .filter(|(name, id)| !present(name) && !reads_cache(*id))
        .map(|&(_, id)| id)
        .collect();
    roots.extend(&records);
    roots.extend(inputs.iter().map(|&(_, id)| id));
    let mut rewriter = Rewriter::new(&old, replace.clone());
    let mut copies = HashMap::new();
    for id in topological(&old, &roots, &replace) {
        let operands = rewriter.operands(id);
        let new = rewriter
            .rebuild(id, &operands)
            .map_err(|problem| fault(&old, id, 0, &problem))?;
        rewriter.set(id, new);
        copies.insert(id, new);
    }
    for (&from, to) in &replace {
        if let Some(&copy) = copies.get(to) {
            copies.insert(from, copy);
        }
    }
    let inputs = inputs
        .iter()
        .map(|(name, id)| (name.clone(), rewriter.copy_of(*id)))
        .collect();
    let layers = records
        .iter()
        .map(|&record| Layer {
            record: rewriter.copy_of(record),
        })
        .collect();
    Ok(Cached {
        graph: rewriter.new,
        inputs,
        layers,
        tokens,
        copies,
    })
}

struct Replaced {
    record: Id,
    out: Option<Id>,
}

/// Makes the nodes that replace a layer: one row per token, the heads side by side.
fn replaced(g: &mut Graph, layer: usize, one: &Found) -> Result<Replaced, String> {
    let shape = g.known_shape(one.k).unwrap_or_default();
    let &[_, heads, tokens, head_dim] = &shape[..] else {
        return Err("keys of four axes".into());
    };
    let rows = [Dim::of(tokens), Dim::of(heads * head_dim)];
    let flat = |g: &mut Graph, id: Id| {
        let turned = g.transpose(id, &[0, 2, 1, 3])?;
        g.reshape(turned, &rows)
    };
    let (k, v) = (flat(g, one.k)?, flat(g, one.v)?);
    let record = g.cached(
        Op::Record {
            layer,
            heads: one.heads,
        },
        vec![k, v],
    );
    let Some(out) = &one.out else {
        return Ok(Replaced { record, out: None });
    };
    let q = flat(g, out.q)?;
    let op = Op::Attention {
        layer,
        heads: one.heads,
        scale: out.scale.to_bits(),
    };
    let y = g.cached(op, vec![q, k, v]);
    let split = g.reshape(y, &[1, tokens, heads, head_dim].map(Dim::of))?;
    let y = g.transpose(split, &[0, 2, 1, 3])?;
    Ok(Replaced {
        record,
        out: Some(y),
    })
}

/// Refuses an entry in which a value still depends on the context length.
pub(super) fn no_past_left(fused: &Fused, entry: &str) -> Result<(), CompileError> {
    let g = &fused.graph;
    for id in topological(g, &fused.roots(), &HashMap::new()) {
        if g.shape(id).iter().any(|dim| dim.past) {
            let (operator, node) = g.origin(id);
            let problem = format!(
                "reads the cache outside an attention (its value is {})",
                show(g.shape(id))
            );
            return Err(CompileError::Operator {
                entry: entry.into(),
                operator: operator.into(),
                node: node.into(),
                problem: problem.into(),
            });
        }
    }
    Ok(())
}
