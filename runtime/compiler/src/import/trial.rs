//! Tries every node of a graph, also those after a refused one, to list everything that the
//! compiler does not support at once.
//!
//! After a refused node, a value has the type and shape that the file declares for it; if it
//! declares none, the nodes that read it are only checked for unknown operators. Nothing is
//! compiled.

use std::collections::{BTreeSet, HashMap, HashSet};

use super::attributes::Attributes;
use super::{Builder, MAX_NODES, Model, Operands, node_name, operators, sequences, shapes};
use crate::entries;
use crate::graph::{Dim, Graph, Type, show};
use crate::onnx::{GraphProto, NodeProto};

/// A node that the compiler does not support.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Refused {
    pub operator: String,
    pub node: String,
    /// Name and shape of each operand; `?` for a shape that is not known.
    pub inputs: Vec<(String, String)>,
    pub problem: String,
}

/// Types and shapes that a file declares.
pub(crate) type Declared<'d> = HashMap<&'d str, (Type, Vec<Dim>)>;

/// Tries all nodes that the graph's outputs need, and returns those that are refused. Values of
/// entries are tried entry by entry, as they are compiled.
pub(crate) fn trial(graph: &GraphProto, opset: i64, declared: &Declared) -> Vec<Refused> {
    let model = Model::of(graph, opset);
    let order: HashMap<*const NodeProto, usize> = (graph.node.iter().enumerate())
        .map(|(i, node)| (std::ptr::from_ref(node), i))
        .collect();
    let entry = |name: &str| entries::entry_of(name).unwrap_or("").to_owned();
    let groups: BTreeSet<String> = graph.output.iter().map(|out| entry(&out.name)).collect();
    let mut refused: Vec<(usize, Refused)> = vec![];
    for group in groups {
        let roots = graph.output.iter().map(|out| out.name.as_str());
        let roots = roots.filter(|name| entry(name) == group);
        let mut attempt = Attempt::new(&model, declared);
        for node in entries::needed(graph, roots) {
            let at = order.get(&std::ptr::from_ref(node)).copied();
            let problem = attempt.node(node);
            if let (Some(at), Some(problem)) = (at, problem)
                && !refused.iter().any(|(other, _)| *other == at)
            {
                refused.push((at, attempt.refused(node, problem)));
            }
            if attempt.builder.graph.ids().len() > MAX_NODES {
                let problem = format!("ends the trial: there are more than {MAX_NODES} operations");
                refused.push((usize::MAX, attempt.refused(node, problem)));
                break;
            }
        }
    }
    refused.sort_by_key(|(at, _)| *at);
    refused.into_iter().map(|(_, refused)| refused).collect()
}

/// One entry, as far as it could be built.
struct Attempt<'b, 'm> {
    builder: Builder<'b, 'm>,
    declared: &'b Declared<'b>,
    /// Values of unknown type and shape.
    unknown: HashSet<String>,
}

impl<'b, 'm> Attempt<'b, 'm> {
    fn new(model: &'b Model<'m>, declared: &'b Declared<'b>) -> Self {
        let mut attempt = Self {
            builder: Builder {
                model,
                graph: Graph::default(),
                values: HashMap::new(),
                sequences: HashMap::new(),
            },
            declared,
            unknown: HashSet::new(),
        };
        for input in &model.graph.input {
            if !model.protos.contains_key(input.name.as_str()) {
                attempt.assume(&input.name);
            }
        }
        attempt
    }

    /// Assumes that a value has its declared type and shape.
    fn assume(&mut self, name: &str) {
        match self.declared.get(name) {
            Some((ty, shape)) => {
                let id = self.builder.graph.input(name, shape, *ty);
                self.builder.values.insert(name.to_owned(), id);
            }
            None => {
                self.unknown.insert(name.to_owned());
            }
        }
    }

    /// Builds a node, or returns its fault.
    fn node(&mut self, node: &NodeProto) -> Option<String> {
        let problem = if node.input.iter().any(|name| self.unknown.contains(name)) {
            unknown(node)
        } else {
            self.builder.node(node).err()
        };
        for name in node.output.iter().filter(|name| !name.is_empty()) {
            let built =
                self.builder.values.contains_key(name) || self.builder.sequences.contains_key(name);
            if !built {
                self.assume(name);
            }
        }
        problem
    }

    fn refused(&self, node: &NodeProto, problem: String) -> Refused {
        let inputs = node.input.iter().filter(|name| !name.is_empty());
        Refused {
            operator: node.op_type.clone(),
            node: node_name(node).to_owned(),
            inputs: inputs
                .map(|name| (name.clone(), self.shape(name)))
                .collect(),
            problem,
        }
    }

    fn shape(&self, name: &str) -> String {
        let built = self.builder.values.get(name);
        let built = built.map(|&id| show(self.builder.graph.shape(id)));
        let proto = || Some(format!("{:?}", self.builder.model.protos.get(name)?.dims));
        built.or_else(proto).unwrap_or_else(|| "?".into())
    }
}

/// Returns the fault of a node whatever its operands: an unknown operator.
fn unknown(node: &NodeProto) -> Option<String> {
    if let Some(problem) = super::foreign(node) {
        return Some(problem);
    }
    if sequences::is_known(&node.op_type) {
        return None;
    }
    let nothing = Operands {
        inputs: vec![],
        outputs: node.output.len(),
        opset: *super::OPSETS.end(),
    };
    let attributes = Attributes::new(&[]).ok()?;
    let tried = operators::translate(&mut Graph::default(), &node.op_type, &nothing, &attributes);
    // Known operators miss their inputs.
    tried.err().filter(|problem| problem == shapes::UNKNOWN)
}
