//! Surveys what a file lacks to become a policy, all at once: operators that the compiler does not
//! support, and fields of the contract.
//!
//! [`survey`] takes any ONNX model. For a model without a contract it lists what a person has to
//! state: nothing is guessed. What can fail: the bytes are not an ONNX model, or a bundle of
//! another version.

use std::collections::{HashMap, HashSet};

use bytes::Bytes;
use prost::Message;

use crate::contract::{Contract, REQUIRED};
use crate::entries;
use crate::error::{BundleError, Line};
use crate::golden::Golden;
use crate::graph::{Dim, Type, show};
use crate::import::{Declared, Model, Refused, trial};
use crate::onnx::{self, GraphProto, ModelProto, TensorTypeProto, ValueInfoProto, data_type};
use crate::storage::Tuned;

/// Content of a file, and what it lacks to become a policy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Survey {
    /// Version of the ONNX operator set.
    pub opset: Option<i64>,
    /// Name of the program that wrote the file.
    pub producer: String,
    /// Number of operators in the graph.
    pub nodes: usize,
    /// Inputs of the graph.
    pub inputs: Vec<Value>,
    /// Outputs of the graph.
    pub outputs: Vec<Value>,
    /// Keys of the metadata.
    pub metadata: Vec<String>,
    /// Missing operators and fields.
    pub missing: Missing,
}

/// An input or output of a graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Value {
    /// Name of the value.
    pub name: String,
    /// Type of the value's elements, by ONNX' name.
    pub dtype: String,
    /// Lengths of the value's axes, or their names.
    pub shape: Vec<String>,
}

/// Gaps between a file and a policy; both lists are empty for a bundle that compiles.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Missing {
    /// Nodes that the compiler does not support, in the graph's order.
    pub operators: Vec<Operator>,
    /// Fields that the contract lacks.
    pub contract: Vec<Field>,
}

/// A node that the compiler does not support.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Operator {
    /// Name of the ONNX operator.
    pub operator: String,
    /// Name of the node, or of its first output.
    pub node: String,
    /// Operands of the node.
    pub inputs: Vec<Operand>,
    /// Unsupported use, and the supported alternative.
    pub problem: String,
}

/// Operand of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Operand {
    /// Name of the value.
    pub name: String,
    /// Shape of the value, `?` if it is unknown.
    pub shape: String,
}

/// A field that a contract lacks, or a step in place of one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// Name of the field.
    pub field: String,
    /// Content that the field needs, or its fault.
    pub needed: String,
}

impl Missing {
    /// Returns whether nothing is missing.
    pub fn is_empty(&self) -> bool {
        self.operators.is_empty() && self.contract.is_empty()
    }

    fn field(&mut self, field: impl Into<String>, needed: impl Into<String>) {
        self.contract.push(Field {
            field: line(&field.into()),
            needed: line(&needed.into()),
        });
    }
}

/// Escapes a name, because names in a hostile file may hold anything.
fn line(text: &str) -> String {
    Line::from(text).to_string()
}

/// Shapes of values inside a graph, which the compiler computes itself and only a survey reads.
#[derive(Clone, PartialEq, Message)]
struct Inner {
    #[prost(message, optional, tag = "7")]
    graph: Option<InnerGraph>,
}

#[derive(Clone, PartialEq, Message)]
struct InnerGraph {
    #[prost(message, repeated, tag = "13")]
    value_info: Vec<ValueInfoProto>,
}

/// Lists the content of a file and what it lacks to become a policy.
pub fn survey(bytes: &[u8]) -> Result<Survey, BundleError> {
    let bytes = Bytes::copy_from_slice(bytes);
    let model = onnx::decode(&bytes)?;
    let graph = model.graph.as_ref().ok_or_else(|| BundleError::NotOnnx {
        problem: "it has no graph".into(),
    })?;
    let inner = Inner::decode(bytes).ok().and_then(|inner| inner.graph);
    let inner = inner.map_or(vec![], |graph| graph.value_info);
    let initialized = |value: &&ValueInfoProto| {
        let name = &value.name;
        graph.initializer.iter().any(|tensor| tensor.name == *name)
    };
    let inputs = graph.input.iter().filter(|value| !initialized(value));
    let inputs: Vec<&ValueInfoProto> = inputs.collect();

    let mut missing = Missing::default();
    if let Err(error) = Model::new(&model, graph) {
        missing.operators.push(Operator {
            operator: "(operator set)".into(),
            node: String::new(),
            inputs: vec![],
            problem: line(&error.to_string()),
        });
    }
    let declared = |open| -> Declared {
        // An integer of one element is an index, others are numbers, as in a bundle's entries.
        let input = |value| -> Option<_> {
            let (ty, shape) = taken(value, open)?;
            let one = shape.iter().all(|dim| dim.is_one());
            Some((if one { ty } else { Type::F32 }, shape))
        };
        let inputs = inputs.iter().map(|value| (*value, input(value)));
        let others = graph.output.iter().chain(&inner);
        let known = inputs.chain(others.map(|value| (value, taken(value, open))));
        known
            .filter_map(|(value, found)| Some((value.name.as_str(), found?)))
            .collect()
    };
    let default = |domain: &str| domain.is_empty() || domain == "ai.onnx";
    let sets = &model.opset_import;
    let opset = (sets.iter().find(|set| default(&set.domain))).map(|set| set.version);
    let attempt = |open| trial(graph, opset.unwrap_or(i64::MAX), &declared(open));
    let mut refused = attempt(1);
    // What is wrong with a length that nobody said is no fault of the node: the axis is reported.
    if !refused.is_empty() && declared(1) != declared(OPEN) {
        let at_any = attempt(OPEN);
        refused.retain(|node| {
            let same =
                |other: &Refused| (&other.node, &other.problem) == (&node.node, &node.problem);
            at_any.iter().any(same)
        });
    }
    missing.operators.extend(refused.into_iter().map(|node| {
        Operator {
            operator: line(&node.operator),
            node: line(&node.node),
            inputs: (node.inputs.into_iter())
                .map(|(name, shape)| Operand {
                    name: line(&name),
                    shape,
                })
                .collect(),
            problem: line(&node.problem),
        }
    }));
    uncomputed(graph, &mut missing);
    match property(&model, "lads.contract") {
        Some(json) => of_bundle(&model, graph, json, &mut missing)?,
        None => of_stranger(&inputs, graph, &mut missing),
    }
    Ok(Survey {
        opset,
        producer: line(&model.producer_name),
        nodes: graph.node.len(),
        inputs: inputs.into_iter().map(value).collect(),
        outputs: graph.output.iter().map(value).collect(),
        metadata: (model.metadata_props.iter())
            .map(|pair| line(&pair.key))
            .collect(),
        missing,
    })
}

fn property<'m>(model: &'m ModelProto, key: &str) -> Option<&'m str> {
    let found = model.metadata_props.iter().find(|pair| pair.key == key);
    found.map(|pair| pair.value.as_str())
}

fn tensor(value: &ValueInfoProto) -> Option<&TensorTypeProto> {
    value.r#type.as_ref()?.tensor_type.as_ref()
}

/// Second length for axes of unknown length, beside 1: longer than any window over them.
const OPEN: usize = 256;

/// Returns a value's type and shape as the compiler reads them; a named axis that is not the
/// context's length counts as `open`, the first one, of batches, as 1.
fn taken(value: &ValueInfoProto, open: usize) -> Option<(Type, Vec<Dim>)> {
    let tensor = tensor(value)?;
    let ty = entries::elements(tensor.elem_type)?;
    let dims = tensor.shape.as_ref()?.dim.iter();
    let dims = dims.enumerate().map(|(axis, dim)| {
        let open = Dim::of(if axis == 0 { 1 } else { open });
        match (dim.dim_value, &dim.dim_param) {
            (Some(len), _) => usize::try_from(len)
                .ok()
                .filter(|&len| len > 0)
                .map(Dim::of),
            (None, Some(name)) => Some(entries::past(name).unwrap_or(open)),
            (None, None) => Some(open),
        }
    });
    Some((ty, dims.collect::<Option<_>>()?))
}

/// Returns a value as the file declares it.
fn value(value: &ValueInfoProto) -> Value {
    let tensor = tensor(value);
    let shape = tensor.and_then(|tensor| tensor.shape.as_ref());
    let dims = shape.into_iter().flat_map(|shape| &shape.dim);
    let dims = dims.map(|dim| match (dim.dim_value, &dim.dim_param) {
        (Some(len), _) => len.to_string(),
        (None, Some(name)) => line(name),
        (None, None) => "?".into(),
    });
    Value {
        name: line(&value.name),
        dtype: tensor.map_or("no tensor".into(), |tensor| {
            data_type::name(tensor.elem_type)
        }),
        shape: dims.collect(),
    }
}

/// Lists the outputs that no node computes.
fn uncomputed(graph: &GraphProto, missing: &mut Missing) {
    let computed: HashSet<&str> = (graph.node.iter().flat_map(|node| &node.output))
        .chain(graph.input.iter().map(|value| &value.name))
        .chain(graph.initializer.iter().map(|tensor| &tensor.name))
        .map(String::as_str)
        .collect();
    for output in &graph.output {
        if !computed.contains(output.name.as_str()) {
            missing.field(
                format!("outputs[{}]", output.name),
                "a node that computes it: export the graph again",
            );
        }
    }
    if graph.output.is_empty() {
        missing.field("outputs", "an action: the graph has no output");
    }
}

/// Lists the faults of a bundle's contract. A contract of another version is refused: its remedy is
/// another program.
fn of_bundle(
    model: &ModelProto,
    graph: &GraphProto,
    json: &str,
    missing: &mut Missing,
) -> Result<(), BundleError> {
    let (contract, faults) = Contract::read(json)?;
    let golden = property(model, "lads.golden");
    if golden.is_none() {
        missing.field("lads.golden", GOLDEN);
    }
    if let Err(problem) = Tuned::find(|key| property(model, key)) {
        missing.field(
            "lads.storage",
            format!("{problem}; tune the bundle again: `lads-run tune`"),
        );
    }
    let list = |missing: &mut Missing, field: &str, found: Result<(), BundleError>| match found {
        Err(BundleError::Golden { problems } | BundleError::Entry { problems }) => {
            for problem in problems {
                missing.field(field, problem.to_string());
            }
        }
        Err(error) => missing.field(field, error.to_string()),
        Ok(()) => {}
    };
    if let Some(contract) = contract {
        if let Some(golden) = golden {
            let read = Golden::read(golden, &contract, &faults).map(drop);
            list(missing, "lads.golden", read);
        }
        if faults.sound(&["family.kind"]) {
            let blueprint = contract.family.kind().blueprint(&contract);
            let found = entries::compared(graph, &contract, &blueprint, &faults).map(drop);
            list(missing, "entries", found);
        }
    }
    for fault in faults.into_vec() {
        missing.field(fault.field.to_string(), fault.problem.to_string());
    }
    Ok(())
}

const GOLDEN: &str = "a recorded episode, with which every target tests itself: the observations, the actions, and how far an action may be from them";

/// Largest number of outputs that are named as what may feed an input.
const MOST_FED: usize = 8;

/// Lists the fields that a person has to state for a graph without a contract.
fn of_stranger(inputs: &[&ValueInfoProto], graph: &GraphProto, missing: &mut Missing) {
    for (name, needed) in REQUIRED {
        if name != "channels" {
            missing.field(name, needed);
        }
    }
    let shape = |value: &ValueInfoProto| {
        let taken = taken(value, 1).map(|(_, shape)| show(&shape));
        taken.unwrap_or_else(|| "of a type that no channel has".into())
    };
    let len = |value: &ValueInfoProto| {
        let shape = taken(value, 1)?.1;
        let mut lens = shape.iter().map(|dim| dim.known());
        lens.try_fold(1_usize, |len, dim| len.checked_mul(dim?))
    };
    let shapes: HashMap<&str, _> = (graph.output.iter())
        .filter_map(|output| Some((output.name.as_str(), taken(output, 1)?)))
        .collect();
    for input in inputs {
        let elements = len(input).map_or("its".into(), |len| len.to_string());
        let own = taken(input, 1);
        let mut fed: Vec<&str> = (shapes.iter())
            .filter(|(_, of_output)| own.as_ref() == Some(of_output))
            .map(|(name, _)| *name)
            .collect();
        fed.sort_unstable();
        let state = if fed.is_empty() {
            String::new()
        } else {
            let more = fed.len().saturating_sub(MOST_FED);
            fed.truncate(MOST_FED);
            let more = if more > 0 {
                format!(" and {more} more")
            } else {
                String::new()
            };
            let fed = fed.join(", ");
            format!("; or a state that an output feeds ({fed}{more}) and what clears it")
        };
        missing.field(
            format!("channels[{}]", input.name),
            format!(
                "what the input {} is: an observation, with name, unit and limits of {elements} elements{state}",
                shape(input)
            ),
        );
        for (axis, dim) in
            (value(input).shape.iter().enumerate()).filter(|(_, dim)| dim.parse::<i64>().is_err())
        {
            missing.field(
                format!("channels[{}].shape[{axis}]", input.name),
                format!("a fixed length in place of `{dim}`, which was taken as 1"),
            );
        }
    }
    for output in &graph.output {
        let elements = len(output).map_or("its".into(), |len| len.to_string());
        missing.field(
            format!("channels[{}]", output.name),
            format!(
                "what the output {} is: the action, with name, unit, limits, scale and offset of {elements} elements and what they are relative to; or a state; or nothing that is needed",
                shape(output)
            ),
        );
    }
    if let Some(value) = (inputs.iter().copied())
        .chain(&graph.output)
        .find(|value| entries::entry_of(&value.name).is_none())
    {
        missing.field(
            "entries",
            format!(
                "values named after their entry; of a plain policy, `policy/act/{0}` in place of `{0}`",
                value.name
            ),
        );
    }
    missing.field("lads.golden", GOLDEN);
}
