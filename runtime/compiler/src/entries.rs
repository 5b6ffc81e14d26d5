//! The entries of a policy of kind `lads`: which values each reads and gives, with which shapes, as the contract says them.
//!
//! The entries live in one graph; a value's name starts with its entry's. What can fail: a value is missing or is declared
//! with another type or shape, which [`check`] reports together with the field of the contract.

use std::collections::{HashMap, HashSet};

use crate::contract::Contract;
use crate::error::BundleError;
use crate::graph::{Dim, Type, show};
use crate::onnx::{GraphProto, NodeProto, TensorTypeProto, ValueInfoProto, data_type};

pub(crate) const LOOKUP_INSTRUCTION: &str = "instruction/lookup";
pub(crate) const INSTRUCT: &str = "high_level/instruct";
pub(crate) const START: &str = "high_level/start";
pub(crate) const STEP: &str = "high_level/step";
pub(crate) const LOOKUP_PLAN: &str = "codebook/lookup";
pub(crate) const ACT: &str = "low_level/act";
pub(crate) const ENCODE: &str = "trajectory_encoder/encode";

/// A value at the edge of an entry.
#[derive(Debug, Clone)]
pub(crate) struct Value {
    /// Without the entry's name.
    pub name: String,
    pub ty: Type,
    pub shape: Vec<Dim>,
    /// The fields of the contract that the shape comes from.
    pub fields: &'static str,
}

/// What an entry reads and gives.
#[derive(Debug, Clone)]
pub(crate) struct Signature {
    pub entry: &'static str,
    pub inputs: Vec<Value>,
    pub outputs: Vec<Value>,
}

fn value(name: &str, ty: Type, shape: &[usize], fields: &'static str) -> Value {
    let shape = shape.iter().map(|&dim| Dim::of(dim)).collect();
    Value {
        name: name.into(),
        ty,
        shape,
        fields,
    }
}

/// `past_key_values.N.key|value` or `present.N.key|value` of every layer.
fn cache(contract: &Contract, name: &str, len: Dim) -> Vec<Value> {
    let network = contract.network;
    (0..network.layers)
        .flat_map(|layer| ["key", "value"].map(|part| format!("{name}.{layer}.{part}")))
        .map(|name| Value {
            name,
            ty: Type::F32,
            shape: vec![
                Dim::of(1),
                Dim::of(network.heads),
                len,
                Dim::of(network.head_dim),
            ],
            fields: "`network`, `context.words`",
        })
        .collect()
}

/// The signatures of all entries.
pub(crate) fn signatures(contract: &Contract) -> Vec<Signature> {
    use Type::{F32, I64};
    let c = contract;
    let (o, a, h) = (c.observation.len(), c.action.len(), c.horizon);
    let words = || {
        value(
            "words",
            F32,
            &[1, c.context.words, c.language.dim],
            "`context.words`, `language.dim`",
        )
    };
    let observation = || value("observation", F32, &[1, o], "`observation`");
    let logits = || value("logits", F32, &[1, c.codebook.size], "`codebook.size`");
    let plan = || value("plan", F32, &[1, c.codebook.dim], "`codebook.dim`");
    let int = |name| value(name, I64, &[1], "version");
    let with_cache = |mut values: Vec<Value>, name, len| {
        values.extend(cache(c, name, len));
        values
    };
    let past = || (Dim::past(0), "past_key_values");
    vec![
        Signature {
            entry: LOOKUP_INSTRUCTION,
            inputs: vec![int("id")],
            outputs: vec![words(), int("length")],
        },
        Signature {
            entry: INSTRUCT,
            inputs: vec![words()],
            outputs: with_cache(vec![], "present", Dim::of(c.context.words)),
        },
        Signature {
            entry: START,
            inputs: with_cache(vec![observation(), int("timestep")], past().1, past().0),
            outputs: with_cache(vec![logits()], "present", Dim::past(1)),
        },
        Signature {
            entry: STEP,
            inputs: with_cache(
                vec![
                    value("action", F32, &[1, a], "`action`"),
                    observation(),
                    int("timestep"),
                ],
                past().1,
                past().0,
            ),
            outputs: with_cache(vec![logits()], "present", Dim::past(2)),
        },
        Signature {
            entry: LOOKUP_PLAN,
            inputs: vec![int("index")],
            outputs: vec![plan()],
        },
        Signature {
            entry: ACT,
            inputs: vec![observation(), plan()],
            outputs: vec![value("action", F32, &[1, a], "`action`")],
        },
        Signature {
            entry: ENCODE,
            inputs: vec![
                value("observations", F32, &[1, h, o], "`horizon`, `observation`"),
                value("actions", F32, &[1, h, a], "`horizon`, `action`"),
            ],
            outputs: vec![
                value("latent", F32, &[1, c.codebook.dim], "`codebook.dim`"),
                int("index"),
            ],
        },
    ]
}

/// The entry that a value's name starts with: its first two parts.
pub(crate) fn entry_of(name: &str) -> Option<&str> {
    let first = name.find('/')?;
    let second = name[first + 1..].find('/')?;
    Some(&name[..=first + second])
}

/// Compares what the graph declares with what the contract says.
pub(crate) fn check(graph: &GraphProto, contract: &Contract) -> Result<(), BundleError> {
    let refused = |problem: String| BundleError::Entry {
        problem: problem.into(),
    };
    if !graph.sparse_initializer.is_empty() {
        return Err(refused("the graph has sparse initializers".into()));
    }
    let mut known = HashSet::new();
    for Signature {
        entry,
        inputs,
        outputs,
    } in signatures(contract)
    {
        for (values, declared, what) in [
            (inputs, &graph.input, "input"),
            (outputs, &graph.output, "output"),
        ] {
            for value in values {
                let name = format!("{entry}/{}", value.name);
                let found = declared.iter().find(|other| other.name == name);
                let found = found.ok_or_else(|| refused(format!("{what} {name} is missing")))?;
                compare(&name, &value, found).map_err(refused)?;
                known.insert(name);
            }
        }
    }
    for declared in graph.input.iter().chain(&graph.output) {
        let initialized = graph
            .initializer
            .iter()
            .any(|tensor| tensor.name == declared.name);
        if !initialized && !known.contains(&declared.name) {
            return Err(refused(format!(
                "value {} belongs to no entry of a policy of kind `lads`",
                declared.name
            )));
        }
    }
    Ok(())
}

/// The type and shape that a value declares: symbolic axes must be called `P` or `P+n`.
fn declared(tensor: &TensorTypeProto) -> Option<(Option<Type>, Vec<Dim>)> {
    let ty = match tensor.elem_type {
        data_type::FLOAT => Some(Type::F32),
        data_type::INT64 => Some(Type::I64),
        _ => None,
    };
    let shape =
        tensor
            .shape
            .as_ref()?
            .dim
            .iter()
            .map(|dim| match (&dim.dim_value, &dim.dim_param) {
                (Some(len), _) => usize::try_from(*len).ok().map(Dim::of),
                (None, Some(text)) => {
                    let rest = text.strip_prefix('P')?;
                    let added = rest
                        .trim()
                        .strip_prefix('+')
                        .map_or_else(|| rest.is_empty().then_some(0), |n| n.trim().parse().ok());
                    added.map(Dim::past)
                }
                (None, None) => None,
            });
    Some((ty, shape.collect::<Option<_>>()?))
}

fn compare(name: &str, wanted: &Value, found: &ValueInfoProto) -> Result<(), String> {
    let tensor = found.r#type.as_ref().and_then(|ty| ty.tensor_type.as_ref());
    let tensor = tensor.ok_or_else(|| format!("{name} declares no tensor type"))?;
    let (ty, shape) = declared(tensor).ok_or_else(|| {
        format!("{name} declares no shape that can be read (the only symbolic axis is `P`)")
    })?;
    if ty != Some(wanted.ty) {
        return Err(format!(
            "{name} has elements of {}, it must be {:?}",
            data_type::name(tensor.elem_type),
            wanted.ty
        ));
    }
    if shape != wanted.shape {
        let (found, wanted_shape, fields) = (show(&shape), show(&wanted.shape), wanted.fields);
        return Err(format!(
            "{name} has shape {found}, by the contract's {fields} it is {wanted_shape}"
        ));
    }
    Ok(())
}

/// The nodes that some values need, in the graph's order.
pub(crate) fn needed<'g>(
    graph: &'g GraphProto,
    roots: impl Iterator<Item = &'g str>,
) -> Vec<&'g NodeProto> {
    let producers: HashMap<&str, usize> = graph
        .node
        .iter()
        .enumerate()
        .flat_map(|(i, node)| node.output.iter().map(move |name| (name.as_str(), i)))
        .collect();
    let mut wanted = vec![false; graph.node.len()];
    let mut stack: Vec<&str> = roots.collect();
    while let Some(name) = stack.pop() {
        if let Some(&i) = producers.get(name)
            && !wanted[i]
        {
            wanted[i] = true;
            stack.extend(graph.node[i].input.iter().map(String::as_str));
        }
    }
    graph
        .node
        .iter()
        .zip(wanted)
        .filter_map(|(node, wanted)| wanted.then_some(node))
        .collect()
}
