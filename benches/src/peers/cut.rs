//! Cuts entries out of a bundle: the models that general runtimes load are the very graphs that lads compiles.
//!
//! Nodes, weights and the types of inputs and outputs are carried over byte by byte; only their names are read.

use std::collections::{HashMap, HashSet};

use prost::Message;

use lads_pace::BenchError;

/// A `ModelProto` whose parts are not decoded.
#[derive(Clone, PartialEq, Message)]
struct Model {
    #[prost(int64, tag = "1")]
    ir_version: i64,
    #[prost(bytes = "vec", repeated, tag = "8")]
    opset_import: Vec<Vec<u8>>,
    #[prost(string, tag = "2")]
    producer_name: String,
    #[prost(message, optional, tag = "7")]
    graph: Option<Graph>,
}

/// A `GraphProto` whose parts are not decoded.
#[derive(Clone, PartialEq, Message)]
struct Graph {
    #[prost(bytes = "vec", repeated, tag = "1")]
    node: Vec<Vec<u8>>,
    #[prost(string, tag = "2")]
    name: String,
    #[prost(bytes = "vec", repeated, tag = "5")]
    initializer: Vec<Vec<u8>>,
    #[prost(bytes = "vec", repeated, tag = "11")]
    input: Vec<Vec<u8>>,
    #[prost(bytes = "vec", repeated, tag = "12")]
    output: Vec<Vec<u8>>,
}

/// Names of a `NodeProto`'s inputs and outputs.
#[derive(Clone, PartialEq, Message)]
struct NodeNames {
    #[prost(string, repeated, tag = "1")]
    input: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    output: Vec<String>,
}

/// The name of a `TensorProto`.
#[derive(Clone, PartialEq, Message)]
struct TensorName {
    #[prost(string, tag = "8")]
    name: String,
}

/// The name of a `ValueInfoProto`.
#[derive(Clone, PartialEq, Message)]
struct ValueName {
    #[prost(string, tag = "1")]
    name: String,
}

/// A `ValueInfoProto` with the lengths of its axes.
#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(message, optional, tag = "2")]
    kind: Option<Kind>,
}

/// A `TypeProto` of a tensor.
#[derive(Clone, PartialEq, Message)]
struct Kind {
    #[prost(message, optional, tag = "1")]
    tensor: Option<TensorKind>,
}

/// The type of a tensor.
#[derive(Clone, PartialEq, Message)]
struct TensorKind {
    #[prost(message, optional, tag = "2")]
    shape: Option<Shape>,
}

/// A `TensorShapeProto`.
#[derive(Clone, PartialEq, Message)]
struct Shape {
    #[prost(message, repeated, tag = "1")]
    axes: Vec<Axis>,
}

/// An axis; 0 where its length is a name.
#[derive(Clone, PartialEq, Message)]
struct Axis {
    #[prost(int64, tag = "1")]
    len: i64,
}

/// A bundle, as an ONNX model.
#[derive(Debug)]
pub struct Source {
    model: Model,
}

fn broken(error: impl std::fmt::Display) -> BenchError {
    BenchError::new("the bundle", error, "export it again")
}

/// Keeps the parts of a graph whose name, which `name` reads, is `wanted`.
fn keep<M: Message + Default>(
    parts: &[Vec<u8>],
    name: fn(M) -> String,
    wanted: impl Fn(&str) -> bool,
) -> Result<Vec<(String, Vec<u8>)>, BenchError> {
    let mut kept = vec![];
    for part in parts {
        let name = name(M::decode(part.as_slice()).map_err(broken)?);
        if wanted(&name) {
            kept.push((name, part.clone()));
        }
    }
    Ok(kept)
}

fn bytes(named: Vec<(String, Vec<u8>)>) -> Vec<Vec<u8>> {
    named.into_iter().map(|(_, part)| part).collect()
}

impl Source {
    /// Reads an ONNX model.
    pub fn new(bytes: &[u8]) -> Result<Self, BenchError> {
        let model = Model::decode(bytes).map_err(broken)?;
        Ok(Self { model })
    }

    /// Returns the name of the only entry; `None` of a bundle that has several.
    pub fn only_entry(&self) -> Result<Option<String>, BenchError> {
        let graph = self.model.graph.clone().unwrap_or_default();
        let outputs = keep(&graph.output, |value: ValueName| value.name, |_| true)?;
        let mut entries = outputs
            .iter()
            .map(|(name, _)| name.rsplit_once('/').map_or("", |(entry, _)| entry));
        let first = entries.next();
        let only = first.filter(|&first| entries.all(|entry| entry == first));
        Ok(only.map(str::to_owned))
    }

    /// Cuts out the entry whose values start with `entry/`, as a model of its own: its inputs and outputs, and what lies between.
    pub fn cut(&self, entry: &str) -> Result<Vec<u8>, BenchError> {
        self.cut_for(entry, |_| true)
    }

    /// Cuts out an entry with only those outputs for which `wanted` holds, given their names without the entry's.
    pub fn cut_for(
        &self,
        entry: &str,
        wanted: impl Fn(&str) -> bool,
    ) -> Result<Vec<u8>, BenchError> {
        let prefix = format!("{entry}/");
        let missing = || BenchError::new(entry, "the bundle has no such entry", "export it again");
        let graph = self.model.graph.as_ref().ok_or_else(missing)?;
        let value = |value: ValueName| value.name;
        let output = keep(&graph.output, value, |name| {
            name.strip_prefix(&prefix).is_some_and(&wanted)
        })?;
        if output.is_empty() {
            return Err(missing());
        }
        let nodes = graph
            .node
            .iter()
            .map(|node| NodeNames::decode(node.as_slice()));
        let nodes: Vec<_> = nodes.collect::<Result<_, _>>().map_err(broken)?;
        let producers: HashMap<&str, usize> = nodes
            .iter()
            .enumerate()
            .flat_map(|(i, node)| node.output.iter().map(move |name| (name.as_str(), i)))
            .collect();
        let (mut needed, mut values) = (HashSet::new(), HashSet::new());
        let mut open: Vec<&str> = output.iter().map(|(name, _)| name.as_str()).collect();
        while let Some(name) = open.pop() {
            if values.insert(name)
                && let Some(&i) = producers.get(name)
                && needed.insert(i)
                && let Some(node) = nodes.get(i)
            {
                open.extend(node.input.iter().map(String::as_str));
            }
        }
        let node = graph.node.iter().enumerate();
        let node = node
            .filter(|(i, _)| needed.contains(i))
            .map(|(_, node)| node.clone());
        let used = |name: &str| values.contains(name);
        let cut = Graph {
            node: node.collect(),
            name: entry.replace('/', "_"),
            initializer: bytes(keep(&graph.initializer, |t: TensorName| t.name, used)?),
            input: bytes(keep(&graph.input, value, used)?),
            output: bytes(output.clone()),
        };
        let model = Model {
            graph: Some(cut),
            ..self.model.clone()
        };
        Ok(model.encode_to_vec())
    }
}

/// Returns the names of a model's inputs and outputs, in order.
pub fn signature(model: &[u8]) -> Result<(Vec<String>, Vec<String>), BenchError> {
    let graph = Model::decode(model)
        .map_err(broken)?
        .graph
        .unwrap_or_default();
    let names = |values: &[Vec<u8>]| -> Result<Vec<String>, BenchError> {
        let named = keep(values, |value: ValueName| value.name, |_| true)?;
        Ok(named.into_iter().map(|(name, _)| name).collect())
    };
    Ok((names(&graph.input)?, names(&graph.output)?))
}

/// Returns the names of a model's inputs with the lengths of their axes, in order.
pub fn shapes(model: &[u8]) -> Result<Vec<(String, Vec<usize>)>, BenchError> {
    let graph = Model::decode(model)
        .map_err(broken)?
        .graph
        .unwrap_or_default();
    let read = |part: &Vec<u8>| {
        let value = Value::decode(part.as_slice()).map_err(broken)?;
        let shape = value.kind.and_then(|kind| kind.tensor?.shape);
        let axes = shape.unwrap_or_default().axes;
        let lens = axes.iter().map(|axis| axis.len.max(0) as usize);
        Ok((value.name, lens.collect()))
    };
    graph.input.iter().map(read).collect()
}

/// A tensor for a general runtime.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Lengths of the tensor's axes.
    pub shape: Vec<usize>,
    /// Elements of the tensor.
    pub data: Data,
}

/// The elements of a tensor.
#[derive(Debug, Clone, PartialEq)]
pub enum Data {
    /// 32-bit floating-point numbers.
    F32(Vec<f32>),
    /// 64-bit integers.
    I64(Vec<i64>),
}

impl Tensor {
    /// Makes a tensor of floating-point numbers.
    pub fn of(shape: Vec<usize>, values: Vec<f32>) -> Self {
        Self {
            shape,
            data: Data::F32(values),
        }
    }

    /// Makes a row `[1, n]`.
    pub fn row(values: &[f32]) -> Self {
        Self {
            shape: vec![1, values.len()],
            data: Data::F32(values.to_vec()),
        }
    }

    /// Makes a tensor of one integer, `[1]`.
    pub fn integer(value: usize) -> Self {
        Self {
            shape: vec![1],
            data: Data::I64(vec![value as i64]),
        }
    }

    /// Returns the elements as floating-point numbers; empty for integers.
    pub fn f32(&self) -> &[f32] {
        match &self.data {
            Data::F32(values) => values,
            Data::I64(_) => &[],
        }
    }

    /// Returns the first element of an integer tensor.
    pub fn first(&self) -> Option<i64> {
        match &self.data {
            Data::F32(_) => None,
            Data::I64(values) => values.first().copied(),
        }
    }

    /// Returns the first `rows` rows of keys or values, `[1, heads, P, head_dim]`.
    #[must_use]
    pub fn first_rows(&self, rows: usize) -> Self {
        let &[one, heads, len, dim] = self.shape.as_slice() else {
            return self.clone();
        };
        let heads_data = self.f32().chunks(len * dim).map(|head| &head[..rows * dim]);
        Self {
            shape: vec![one, heads, rows, dim],
            data: Data::F32(heads_data.flatten().copied().collect()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_are_cut_out_whole() {
        let bundle = std::fs::read(crate::bundle()).expect("the bundle that ships can be read");
        let source = Source::new(&bundle).expect("it is a model");
        let act = source.cut("low_level/act").expect("it has a low level");
        let (inputs, outputs) = signature(&act).expect("a model");
        assert_eq!(inputs, ["low_level/act/observation", "low_level/act/plan"]);
        assert_eq!(outputs, ["low_level/act/action"]);
        // The low level's weights and little more, out of several megabytes.
        assert!(
            (300_000..600_000).contains(&act.len()),
            "{} bytes",
            act.len()
        );
        assert_eq!(source.only_entry().expect("it is a model"), None);
        let read = shapes(&act).expect("a model");
        assert!(
            read.iter()
                .all(|(_, shape)| shape.len() == 2 && shape[0] == 1)
        );
        let step = source.cut("high_level/step").expect("it has a high level");
        let recording = source.cut_for("high_level/step", |name| name != "logits");
        assert!(recording.expect("it has a cache").len() < step.len());
        assert!(source.cut("high_level/nothing").is_err());
        assert!(Source::new(&bundle[..100]).is_err());
    }

    #[test]
    fn the_first_rows_of_every_head() {
        let keys = Tensor {
            shape: vec![1, 2, 3, 1],
            data: Data::F32(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        };
        let first = keys.first_rows(2);
        assert_eq!(first.shape, [1, 2, 2, 1]);
        assert_eq!(first.f32(), [1.0, 2.0, 4.0, 5.0]);
    }
}
