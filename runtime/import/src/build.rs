//! Builds the bundle's graph: the policy's own nodes, with nodes before and after them that turn
//! raw sensor values into its inputs and its output into the robot's commands.
//!
//! All added nodes are of the operators
//! `Add Cast Concat Div Gather Identity MatMul Max Min Mul Reshape Sqrt Sub Transpose`, which mean
//! the same in every operator set. Values of the policy keep their names, prefixed with the number
//! of their file; nothing else of the files is kept. What can fail: files of different operator
//! sets.

mod states;
mod terms;

use bytes::Bytes;
use lads_compiler::onnx::{
    AttributeProto, DimensionProto, GraphProto, ModelProto, NodeProto, OperatorSetIdProto,
    TensorProto, TensorShapeProto, TensorTypeProto, TypeProto, ValueInfoProto, data_type,
};

use crate::model::{Edge, Model};
use crate::plan::{Bounds, Feed, Plan};
use crate::problem::Problems;

pub(crate) use states::Kept;

/// Name of the entry of a plain policy.
const ENTRY: &str = "policy/act";

/// ONNX's numbers for the types of attributes.
const INT: i32 = 2;
const INTS: i32 = 7;

/// A graph under construction.
#[derive(Default)]
struct Net {
    graph: GraphProto,
    /// States besides those of the policy's own graphs.
    kept: Vec<Kept>,
    values: usize,
}

/// Builds the graph, and the states that the contract has to name.
pub(crate) fn build(
    models: &[Model],
    plan: &Plan,
    problems: &mut Problems,
) -> Option<(ModelProto, Vec<Kept>)> {
    let opsets = opsets(models, problems)?;
    let mut net = Net::default();
    net.graph.name = "plain".into();
    for channel in &plan.channels {
        net.input(&channel.name, &[1, channel.elements.len()]);
    }
    let mut pieces = terms::Pieces::new(plan);
    for (number, state) in plan.states.iter().enumerate() {
        let name = states::name(number);
        net.input(&name, &state.input.dims);
        net.kept.push(Kept::plain(&name, &state.input.dims));
    }
    // A graph whose input another one's output is a part of comes after it.
    for file in order(models.len(), plan, problems)? {
        for (edge, feed) in plan.feeds.iter().filter(|(edge, _)| edge.file == file) {
            let made = match feed {
                Feed::Terms { terms, stack, clip } => {
                    let flat = pieces.input(&mut net, terms, *stack);
                    net.clipped(flat, clip.as_ref())
                }
                Feed::State(number) => entry(&states::name(*number)),
                Feed::Constant(value) => net.floats(&[1, edge.len()], &vec![*value; edge.len()]),
                Feed::Wire(output) => inside(output),
            };
            net.arrive(edge, &made);
        }
        net.take(file, &models[file]);
    }
    let action = &plan.action;
    let width = action.scale.len();
    let raw = net.leave(&action.edge, &[1, width]);
    let raw = net.clipped(raw, action.clip.as_ref());
    pieces.finish(&mut net, &raw);
    let scaled = net.scaled(raw, &action.scale);
    let moved = net.moved("Add", scaled, &action.offset);
    let ordered = net.columns(moved, &action.order, width);
    net.output("action", &ordered, &[1, width]);
    for (number, state) in plan.states.iter().enumerate() {
        let value = net.leave(&state.output, &state.output.dims);
        let name = format!("next_{}", states::name(number));
        net.output(&name, &value, &state.output.dims);
    }
    let model = ModelProto {
        ir_version: models.iter().map(|model| model.proto.ir_version).max()?,
        opset_import: opsets,
        producer_name: "lads".into(),
        graph: Some(net.graph),
        metadata_props: vec![],
    };
    Some((model, net.kept))
}

/// Returns the name of a value of the entry.
fn entry(name: &str) -> String {
    format!("{ENTRY}/{name}")
}

/// Returns the name in the bundle of a value of a policy's file.
fn inside(edge: &Edge) -> String {
    format!("{}/{}", edge.file, edge.name)
}

/// Returns the operator sets, which all files must share.
fn opsets(models: &[Model], problems: &mut Problems) -> Option<Vec<OperatorSetIdProto>> {
    let of = |model: &Model| {
        let sets = model.proto.opset_import.iter();
        let own = sets.filter(|set| set.domain.is_empty() || set.domain == "ai.onnx");
        own.map(|set| set.version).collect::<Vec<_>>()
    };
    let first = of(models.first()?);
    for model in models {
        if of(model) != first {
            problems.add(
                model.path.display(),
                format!(
                    "has operator set {:?}, the first file has {first:?}; export them alike, or convert one in Python: `onnx.version_converter.convert_version(model, {})`",
                    of(model),
                    first.first().unwrap_or(&17)
                ),
            );
            return None;
        }
    }
    Some(models.first()?.proto.opset_import.clone())
}

/// Returns the files in order, each after those whose outputs it reads.
fn order(files: usize, plan: &Plan, problems: &mut Problems) -> Option<Vec<usize>> {
    let reads = |file: usize| {
        plan.feeds
            .iter()
            .filter(move |(edge, _)| edge.file == file)
            .flat_map(|(_, feed)| terms::outputs(feed))
            .filter(move |&other| other != file)
    };
    let mut done: Vec<usize> = vec![];
    while done.len() < files {
        let next = (0..files)
            .find(|file| !done.contains(file) && reads(*file).all(|other| done.contains(&other)));
        let Some(next) = next else {
            problems.add("wire", "the files read each other's outputs in a circle");
            return None;
        };
        done.push(next);
    }
    Some(done)
}

impl Net {
    /// Adds a node with one output, and returns the output.
    fn op(&mut self, operator: &str, inputs: &[&str], attributes: Vec<AttributeProto>) -> String {
        let output = format!("edge/{}", self.values);
        self.values += 1;
        self.node(operator, inputs, &output, attributes);
        output
    }

    fn node(
        &mut self,
        operator: &str,
        inputs: &[&str],
        output: &str,
        attributes: Vec<AttributeProto>,
    ) {
        self.graph.node.push(NodeProto {
            input: inputs.iter().map(|&name| name.into()).collect(),
            output: vec![output.into()],
            name: output.into(),
            op_type: operator.into(),
            domain: String::new(),
            attribute: attributes,
        });
    }

    fn floats(&mut self, shape: &[usize], values: &[f64]) -> String {
        let raw: Vec<u8> = (values.iter())
            .flat_map(|&value| (value as f32).to_le_bytes())
            .collect();
        self.constant(shape, data_type::FLOAT, raw.into())
    }

    fn integers(&mut self, values: &[i64]) -> String {
        let raw: Vec<u8> = values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect();
        self.constant(&[values.len()], data_type::INT64, raw.into())
    }

    fn constant(&mut self, shape: &[usize], data_type: i32, raw_data: Bytes) -> String {
        let name = format!("edge/{}", self.values);
        self.values += 1;
        self.graph.initializer.push(TensorProto {
            dims: shape.iter().map(|&dim| dim as i64).collect(),
            data_type,
            name: name.clone(),
            raw_data,
            ..TensorProto::default()
        });
        name
    }

    fn input(&mut self, name: &str, shape: &[usize]) {
        let value = declared(&entry(name), shape);
        self.graph.input.push(value);
    }

    fn output(&mut self, name: &str, value: &str, shape: &[usize]) {
        let full = entry(name);
        self.node("Identity", &[value], &full, vec![]);
        self.graph.output.push(declared(&full, shape));
    }

    fn shaped(&mut self, value: &str, shape: &[usize]) -> String {
        let wanted: Vec<i64> = shape.iter().map(|&dim| dim as i64).collect();
        let wanted = self.integers(&wanted);
        self.op("Reshape", &[value, &wanted], vec![])
    }

    /// Makes a value an input of one of the policy's graphs.
    fn arrive(&mut self, edge: &Edge, value: &str) {
        let shaped = self.shaped(value, &edge.dims);
        let full = inside(edge);
        if edge.elem_type == data_type::FLOAT {
            self.node("Identity", &[&shaped], &full, vec![]);
        } else {
            let to = attribute("to", INT, i64::from(edge.elem_type), vec![]);
            self.node("Cast", &[&shaped], &full, vec![to]);
        }
    }

    /// Returns an output of one of the policy's graphs, as floats of a shape.
    fn leave(&mut self, edge: &Edge, shape: &[usize]) -> String {
        let mut value = inside(edge);
        if edge.elem_type != data_type::FLOAT {
            let to = attribute("to", INT, i64::from(data_type::FLOAT), vec![]);
            value = self.op("Cast", &[&value], vec![to]);
        }
        if edge.dims == shape {
            value
        } else {
            self.shaped(&value, shape)
        }
    }

    /// Adds the nodes and weights of a file.
    fn take(&mut self, file: usize, model: &Model) {
        let graph = model.graph();
        let own = |name: &String| {
            if name.is_empty() {
                String::new()
            } else {
                format!("{file}/{name}")
            }
        };
        for tensor in &graph.initializer {
            self.graph.initializer.push(TensorProto {
                name: own(&tensor.name),
                ..tensor.clone()
            });
        }
        for node in &graph.node {
            self.graph.node.push(NodeProto {
                input: node.input.iter().map(own).collect(),
                output: node.output.iter().map(own).collect(),
                name: own(&node.name),
                ..node.clone()
            });
        }
    }

    /// Selects columns of a value `[rows, width]`; returns the value itself if they are all of it
    /// in order.
    fn columns(&mut self, value: String, columns: &[usize], width: usize) -> String {
        if columns.len() == width && columns.iter().enumerate().all(|(i, &column)| i == column) {
            return value;
        }
        let wanted: Vec<i64> = columns.iter().map(|&column| column as i64).collect();
        self.gathered(&value, &wanted, 1)
    }

    fn gathered(&mut self, value: &str, wanted: &[i64], axis: i64) -> String {
        let wanted = self.integers(wanted);
        let axis = attribute("axis", INT, axis, vec![]);
        self.op("Gather", &[value, &wanted], vec![axis])
    }

    fn joined(&mut self, parts: &[String], axis: i64) -> String {
        if let [part] = parts {
            return part.clone();
        }
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        self.op("Concat", &parts, vec![attribute("axis", INT, axis, vec![])])
    }

    fn turned(&mut self, value: &str) -> String {
        let perm = attribute("perm", INTS, 0, vec![1, 0]);
        self.op("Transpose", &[value], vec![perm])
    }

    /// Multiplies a value by a scale, `value * scale`; adds no node if that changes nothing.
    fn scaled(&mut self, value: String, scale: &[f64]) -> String {
        if scale.iter().all(|&scale| scale == 1.0) {
            return value;
        }
        let scale = self.floats(&[1, scale.len()], scale);
        self.op("Mul", &[&value, &scale], vec![])
    }

    /// Adds or subtracts an offset; adds no node if that changes nothing.
    fn moved(&mut self, operator: &str, value: String, offset: &[f64]) -> String {
        if offset.iter().all(|&offset| offset == 0.0) {
            return value;
        }
        let offset = self.floats(&[1, offset.len()], offset);
        self.op(operator, &[&value, &offset], vec![])
    }

    fn clipped(&mut self, value: String, clip: Option<&Bounds>) -> String {
        let Some((low, high)) = clip else {
            return value;
        };
        let (low, high) = (
            self.floats(&[1, low.len()], low),
            self.floats(&[1, high.len()], high),
        );
        let value = self.op("Max", &[&value, &low], vec![]);
        self.op("Min", &[&value, &high], vec![])
    }
}

fn attribute(name: &str, kind: i32, i: i64, ints: Vec<i64>) -> AttributeProto {
    AttributeProto {
        name: name.into(),
        kind,
        i,
        ints,
        ..AttributeProto::default()
    }
}

fn declared(name: &str, shape: &[usize]) -> ValueInfoProto {
    let dim = |&dim: &usize| DimensionProto {
        dim_value: Some(dim as i64),
        dim_param: None,
    };
    let tensor = TensorTypeProto {
        elem_type: data_type::FLOAT,
        shape: Some(TensorShapeProto {
            dim: shape.iter().map(dim).collect(),
        }),
    };
    ValueInfoProto {
        name: name.into(),
        r#type: Some(TypeProto {
            tensor_type: Some(tensor),
        }),
    }
}
