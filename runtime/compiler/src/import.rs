//! Imports ONNX to the compiler's graph: an entry is cut out of the bundle by its outputs and built
//! node by node.
//!
//! Every attribute of every node is read or refused, and an operator without a translation is an
//! error that names the operator, the node and the entry: nothing is dropped silently. Shapes
//! follow from the inputs; the only symbolic axis is the context length.

mod activations;
mod arithmetic;
mod attributes;
mod constants;
mod einsum;
mod images;
mod indices;
mod layers;
mod logic;
mod norms;
mod operators;
mod parts;
mod recurrent;
mod reductions;
mod resize;
mod sequences;
mod shapes;
mod trial;

use std::cell::RefCell;
use std::collections::HashMap;
use std::sync::Arc;

use crate::entries::{self, Signature};
use crate::error::CompileError;
use crate::graph::{EMPTY, Graph, Id, show};
use crate::onnx::{GraphProto, ModelProto, NodeProto, TensorProto};
use crate::tensor::Tensor;

use attributes::Attributes;
use sequences::Given;
pub(crate) use trial::{Declared, Refused, trial};

/// Versions of ONNX's operator set that are read.
pub const OPSETS: std::ops::RangeInclusive<i64> = 7..=28;

/// Largest number of nodes of an entry; an LSTM counts its steps.
const MAX_NODES: usize = 1 << 16;

/// Initializers of a model, read once each, so that entries share them.
pub(crate) struct Model<'m> {
    graph: &'m GraphProto,
    opset: i64,
    protos: HashMap<&'m str, &'m TensorProto>,
    tensors: RefCell<HashMap<&'m str, Arc<Tensor>>>,
}

/// One entry as a graph.
pub(crate) struct Entry {
    pub graph: Graph,
    /// Inputs by their short names, in the signature's order.
    pub inputs: Vec<(String, Id)>,
    pub outputs: Vec<(String, Id)>,
}

impl<'m> Model<'m> {
    pub fn new(model: &'m ModelProto, graph: &'m GraphProto) -> Result<Self, CompileError> {
        let refused = |problem: String| CompileError::Entry {
            entry: "(all)".into(),
            problem: problem.into(),
        };
        let default = model
            .opset_import
            .iter()
            .find(|set| set.domain.is_empty() || set.domain == "ai.onnx");
        let opset = default
            .map(|set| set.version)
            .ok_or_else(|| refused("the model imports no ONNX operator set".into()))?;
        if !OPSETS.contains(&opset) {
            return Err(refused(format!(
                "ONNX operator set {opset} is not supported, {} to {} are",
                OPSETS.start(),
                OPSETS.end()
            )));
        }
        Ok(Self::of(graph, opset))
    }

    /// Reads a graph of any operator set.
    fn of(graph: &'m GraphProto, opset: i64) -> Self {
        let protos = graph
            .initializer
            .iter()
            .map(|tensor| (tensor.name.as_str(), tensor))
            .collect();
        Self {
            graph,
            opset,
            protos,
            tensors: RefCell::default(),
        }
    }

    fn initializer(&self, name: &str) -> Result<Option<Arc<Tensor>>, String> {
        let Some((&name, &proto)) = self.protos.get_key_value(name) else {
            return Ok(None);
        };
        if let Some(tensor) = self.tensors.borrow().get(name) {
            return Ok(Some(tensor.clone()));
        }
        let tensor = Tensor::from_proto(proto)
            .map_err(|problem| format!("initializer {name}: {problem}"))?;
        self.tensors.borrow_mut().insert(name, tensor.clone());
        Ok(Some(tensor))
    }

    /// Builds the graph of an entry. Inputs that are in `bindings` are constants.
    pub fn import(
        &self,
        signature: &Signature,
        bindings: &HashMap<&str, Tensor>,
    ) -> Result<Entry, CompileError> {
        let entry = signature.entry.as_str();
        let refused = |problem: String| CompileError::Entry {
            entry: entry.into(),
            problem: problem.into(),
        };
        let full = |name: &str| format!("{entry}/{name}");
        let mut builder = Builder {
            model: self,
            graph: Graph::default(),
            values: HashMap::new(),
            sequences: HashMap::new(),
        };
        let mut inputs = vec![];
        for input in &signature.inputs {
            let id = match bindings.get(input.name.as_str()) {
                Some(tensor) => builder.graph.add_const(Arc::new(tensor.clone())),
                None => builder
                    .graph
                    .input(&full(&input.name), &input.shape, input.ty),
            };
            builder.values.insert(full(&input.name), id);
            inputs.push((input.name.clone(), id));
        }
        let roots: Vec<String> = signature
            .outputs
            .iter()
            .map(|output| full(&output.name))
            .collect();
        for node in entries::needed(self.graph, roots.iter().map(String::as_str)) {
            builder
                .node(node)
                .map_err(|problem| CompileError::Operator {
                    entry: entry.into(),
                    operator: node.op_type.as_str().into(),
                    node: node_name(node).into(),
                    problem: problem.into(),
                })?;
            if builder.graph.ids().len() > MAX_NODES {
                return Err(refused(format!("it has more than {MAX_NODES} operations")));
            }
        }
        let mut outputs = vec![];
        for output in &signature.outputs {
            let name = full(&output.name);
            let id = builder.value(&name).map_err(refused)?;
            let (ty, shape) = (builder.graph.ty(id), builder.graph.shape(id));
            if ty != output.ty || shape != output.shape {
                let (found, wanted) = (show(shape), show(&output.shape));
                return Err(refused(format!(
                    "output {name} is {ty:?} {found}, by the contract's {} it is {:?} {wanted}",
                    output.fields, output.ty
                )));
            }
            outputs.push((output.name.clone(), id));
        }
        Ok(Entry {
            graph: builder.graph,
            inputs,
            outputs,
        })
    }
}

/// Returns a node's name, or its first output's.
fn node_name(node: &NodeProto) -> &str {
    if node.name.is_empty() {
        node.output.first().map_or("", String::as_str)
    } else {
        &node.name
    }
}

/// Returns the fault of a node of another domain than ONNX' own.
fn foreign(node: &NodeProto) -> Option<String> {
    (!node.domain.is_empty() && node.domain != "ai.onnx").then(|| {
        format!(
            "of domain {} is not supported; export the graph with ONNX' own operators",
            node.domain
        )
    })
}

/// Values of an entry that were built so far.
struct Builder<'b, 'm> {
    model: &'b Model<'m>,
    graph: Graph,
    values: HashMap<String, Id>,
    sequences: HashMap<String, Vec<Id>>,
}

impl Builder<'_, '_> {
    fn value(&mut self, name: &str) -> Result<Id, String> {
        if let Some(&id) = self.values.get(name) {
            return Ok(id);
        }
        let tensor = self.model.initializer(name)?.ok_or_else(|| {
            format!(
                "reads {name}, which no node of this entry computes and no weights are stored for"
            )
        })?;
        let id = self.graph.add_const(tensor);
        self.values.insert(name.into(), id);
        Ok(id)
    }

    fn node(&mut self, node: &NodeProto) -> Result<(), String> {
        self.graph.set_origin(&node.op_type, node_name(node));
        if let Some(problem) = foreign(node) {
            return Err(problem);
        }
        let mut inputs = vec![];
        for name in &node.input {
            match self.sequences.get(name) {
                // Without elements it adds nothing to the other parts.
                Some(list) if list.is_empty() && node.op_type == "Concat" => {}
                Some(_) => inputs.push(None),
                None if name.is_empty() => inputs.push(None),
                None => inputs.push(Some(self.value(name)?)),
            }
        }
        let attributes = Attributes::new(&node.attribute)?;
        if sequences::is_known(&node.op_type) {
            return self.sequence(node, &inputs, &attributes);
        }
        let operands = Operands {
            inputs,
            outputs: node.output.len(),
            opset: self.model.opset,
        };
        let translated =
            operators::translate(&mut self.graph, &node.op_type, &operands, &attributes);
        // PyTorch joins a shape's axes behind the last one, which are none, to a shape.
        if node.op_type == "Slice" && translated.as_ref().is_err_and(|problem| problem == EMPTY) {
            attributes.all_read()?;
            return self.give_sequence(node, vec![]);
        }
        let outputs = translated?;
        attributes.all_read()?;
        for (name, id) in node.output.iter().zip(outputs) {
            if !name.is_empty() && self.values.insert(name.clone(), id).is_some() {
                return Err(format!("gives {name}, which exists already"));
            }
        }
        match node
            .output
            .iter()
            .find(|name| !name.is_empty() && !self.values.contains_key(*name))
        {
            Some(missing) => Err(format!("does not support its output {missing}")),
            None => Ok(()),
        }
    }

    /// Builds a node that reads or writes a sequence.
    fn sequence(
        &mut self,
        node: &NodeProto,
        inputs: &[Option<Id>],
        attributes: &Attributes,
    ) -> Result<(), String> {
        let known = &self.sequences;
        let given = sequences::translate(&mut self.graph, node, inputs, known, attributes)?;
        attributes.all_read()?;
        let name = node.output.first().ok_or("gives nothing")?;
        match given {
            Given::Value(id) if self.values.insert(name.clone(), id).is_some() => {
                Err(format!("gives {name}, which exists already"))
            }
            Given::Value(_) => Ok(()),
            Given::Sequence(list) => self.give_sequence(node, list),
        }
    }

    /// Makes a list of values a node's output; one without elements has no values.
    fn give_sequence(&mut self, node: &NodeProto, list: Vec<Id>) -> Result<(), String> {
        let name = node.output.first().ok_or("gives nothing")?;
        if self.sequences.insert(name.clone(), list).is_some() {
            return Err(format!("gives {name}, which exists already"));
        }
        Ok(())
    }
}

/// Operands of a node.
struct Operands {
    inputs: Vec<Option<Id>>,
    /// Number of outputs of the node.
    outputs: usize,
    /// Operator set that defines the node's meaning.
    opset: i64,
}

impl Operands {
    fn get(&self, i: usize) -> Result<Id, String> {
        self.optional(i)
            .ok_or_else(|| format!("misses its input {i}"))
    }

    fn optional(&self, i: usize) -> Option<Id> {
        self.inputs.get(i).copied().flatten()
    }

    /// Returns all inputs, none of which may be left out.
    fn all(&self) -> Result<Vec<Id>, String> {
        (0..self.inputs.len()).map(|i| self.get(i)).collect()
    }

    /// Refuses inputs from `n` on.
    fn at_most(&self, n: usize) -> Result<(), String> {
        if self.inputs.iter().skip(n).any(Option::is_some) {
            return Err(format!("does not support its input {n}"));
        }
        Ok(())
    }
}
