//! Graphs of a bundle: the values that each reads and writes, checked against the contract.
//!
//! The graphs are parts of one ONNX graph; a value's name starts with its graph's. The contract's
//! family determines which graphs there are, and the names of their values determine their
//! bindings. What can fail: a graph or a value is missing, unknown, or declared with another type
//! or shape; [`signatures`] reports it together with the field of the contract.

mod declared;

use std::collections::{HashMap, HashSet};

use crate::contract::{Contract, DType, Faults, all_free, roles_are_known};
use crate::error::{BundleError, Line};
use crate::family::{Blueprint, Bound, Entry, Keep};
use crate::graph::{Dim, Type, show};
use crate::onnx::{GraphProto, NodeProto, ValueInfoProto};

use declared::declaration;
pub(crate) use declared::{elements, past};

/// Name of the graph that holds the table of known instructions: evaluated when a bundle is
/// compiled.
pub(crate) const LOOKUP_INSTRUCTION: &str = "instruction/lookup";

/// Name of the graph that encodes a piece of a demonstration. A bundle of any family may hold it, for
/// others to use.
const ENCODE_TRAJECTORY: &str = "trajectory_encoder/encode";

/// An input or output of a graph.
#[derive(Debug, Clone)]
pub(crate) struct Value {
    /// Name of the value without the graph's name.
    pub name: String,
    pub ty: Type,
    pub shape: Vec<Dim>,
    /// Fields of the contract that determine the shape.
    pub fields: String,
}

/// Inputs and outputs of a graph.
#[derive(Debug, Clone)]
pub(crate) struct Signature {
    pub entry: String,
    pub inputs: Vec<Value>,
    pub outputs: Vec<Value>,
}

impl Signature {
    /// Returns the number of rows that a run appends to the KV cache.
    pub fn tokens(&self) -> usize {
        let present = self
            .outputs
            .iter()
            .find(|value| value.name.starts_with("present."));
        present.map_or(0, |value| value.shape.get(2).map_or(0, |dim| dim.fixed))
    }
}

/// Returns the signatures of all graphs that the contract's family has, checked against the
/// contract.
pub(crate) fn signatures(
    graph: &GraphProto,
    contract: &Contract,
    blueprint: &Blueprint,
) -> Result<Vec<Signature>, BundleError> {
    compared(graph, contract, blueprint, &Faults::default())
}

/// Returns the signatures of all graphs of a contract that has faults: what they touch is not
/// compared.
pub(crate) fn compared(
    graph: &GraphProto,
    contract: &Contract,
    blueprint: &Blueprint,
    faults: &Faults,
) -> Result<Vec<Signature>, BundleError> {
    let mut problems: Vec<String> = vec![];
    if !graph.sparse_initializer.is_empty() {
        problems.push("the graph has sparse initializers".into());
    }
    let mut checker = Checker {
        contract,
        blueprint,
        faults,
        widths: HashMap::new(),
    };
    let mut all: Vec<Signature> = vec![];
    let known = checker.shapes_are_free();
    if let Some(words) = contract.words() {
        let mut found = vec![];
        all.push(lookup(graph, words, &mut found));
        problems.extend(found.into_iter().filter(|_| known));
    }
    for entry in &blueprint.entries {
        if let Some(signature) = checker.entry(graph, entry, &mut problems)
            && !all.iter().any(|known| known.entry == signature.entry)
        {
            all.push(signature);
        }
    }
    let mut found = vec![];
    unknown(graph, contract, &all, &mut found);
    problems.extend(found.into_iter().filter(|_| known));
    if problems.is_empty() {
        return Ok(all);
    }
    // Entries may share a graph.
    let mut seen = HashSet::new();
    problems.retain(|problem| seen.insert(problem.clone()));
    Err(BundleError::Entry {
        problems: problems.into_iter().map(Line::from).collect(),
    })
}

/// Returns whether an output is kept, or part of the KV cache.
fn is_used(entry: &Entry, output: &str) -> bool {
    output.starts_with("present.") || entry.outputs.iter().any(|kept| kept == output)
}

/// Checks that every value belongs to a graph of the family, or to a trajectory encoder.
fn unknown(
    graph: &GraphProto,
    contract: &Contract,
    known: &[Signature],
    problems: &mut Vec<String>,
) {
    for declared in graph.input.iter().chain(&graph.output) {
        let initialized = graph
            .initializer
            .iter()
            .any(|tensor| tensor.name == declared.name);
        let entry = entry_of(&declared.name).unwrap_or("");
        let found =
            known.iter().any(|signature| signature.entry == entry) || entry == ENCODE_TRAJECTORY;
        if !initialized && !found {
            problems.push(format!(
                "value {} belongs to no entry of a policy of kind `{}`",
                declared.name,
                contract.family.name()
            ));
        }
    }
}

/// Checker of declared values, with the widths found so far.
struct Checker<'c> {
    contract: &'c Contract,
    blueprint: &'c Blueprint,
    faults: &'c Faults,
    /// Number of elements of the states whose width no field states, by the first value that was
    /// bound to each.
    widths: HashMap<usize, (usize, String)>,
}

impl Checker<'_> {
    /// Returns whether a channel's shape, and for what it is there, are the contract's own.
    fn shape_is_free(&self, channel: usize) -> bool {
        let fields = ["name", "role", "dtype", "shape"];
        let fields = fields.map(|field| format!("channels[{channel}].{field}"));
        self.faults.free(&fields.each_ref().map(String::as_str))
    }

    fn shapes_are_free(&self) -> bool {
        (0..self.contract.channels.len()).all(|channel| self.shape_is_free(channel))
    }

    /// Returns whether every name that a value may be bound by is the contract's own.
    fn names_are_free(&self) -> bool {
        let channels = self.contract.channels.len();
        let states = self.contract.states.len();
        all_free("channels", channels, "name", self.faults)
            && all_free("states", states, "name", self.faults)
            && roles_are_known(self.contract, self.faults)
    }

    /// Returns the signature of an entry's graph; `None` for an entry without one.
    fn entry(
        &mut self,
        graph: &GraphProto,
        entry: &Entry,
        problems: &mut Vec<String>,
    ) -> Option<Signature> {
        let name = entry.graph()?;
        let prefix = format!("{name}/");
        let before = problems.len();
        let named = self.names_are_free();
        let mut values = |declared: &[ValueInfoProto], input: bool| -> Vec<Value> {
            let own = declared
                .iter()
                .filter(|value| value.name.starts_with(&prefix))
                // An output that this project does not use may be anything.
                .filter(|value| input || is_used(entry, &value.name[prefix.len()..]));
            own.filter_map(|value| {
                let own = &value.name[prefix.len()..];
                let read = match self.blueprint.bind(self.contract, &entry.name, own, input) {
                    Some(bound) => self.value(own, bound, value, input),
                    None if named => Err(self.unbound(value)),
                    None => return None,
                };
                read.map_err(|problem| problems.push(problem)).ok()
            })
            .collect()
        };
        let outputs = values(&graph.output, false);
        let declares = |name: &str| graph.output.iter().any(|value| value.name == name);
        if entry.optional
            && !graph
                .output
                .iter()
                .any(|value| value.name.starts_with(&prefix))
        {
            return None;
        }
        let inputs = values(&graph.input, true);
        for wanted in &entry.outputs {
            let wanted = format!("{prefix}{wanted}");
            let of_state = wanted[prefix.len()..].starts_with("next_");
            let judged = !of_state || self.faults.free(&["states"]);
            if judged && !declares(&wanted) {
                problems.push(format!("output {wanted} is missing"));
            }
        }
        // What is bound to the cache is known only of values that can be read.
        if problems.len() == before
            && named
            && self.shapes_are_free()
            && self.faults.free(&["network", "family"])
        {
            let checked = self.cache(entry.cache.as_deref(), name, &inputs, &outputs);
            problems.extend(checked.err());
        }
        Some(Signature {
            entry: name.into(),
            inputs,
            outputs,
        })
    }

    fn unbound(&self, declared: &ValueInfoProto) -> String {
        format!(
            "value {} is bound to nothing: it names no channel and no state of a policy of kind `{}`",
            declared.name,
            self.contract.family.name()
        )
    }

    /// Returns a declared value, called `name` within its graph, if it matches the contract.
    fn value(
        &mut self,
        name: &str,
        bound: Bound,
        declared: &ValueInfoProto,
        input: bool,
    ) -> Result<Value, String> {
        let (mut ty, shape) = declaration(declared)?;
        let len = shape
            .iter()
            .try_fold(1_usize, |len, dim| dim.known()?.checked_mul(len));
        let fields = match bound {
            Bound::Channel(index) => {
                let channel = &self.contract.channels[index];
                let squeezed = |dims: &mut dyn Iterator<Item = usize>| -> Vec<usize> {
                    dims.filter(|&dim| dim != 1).collect()
                };
                let found = squeezed(&mut shape.iter().map(|dim| dim.fixed));
                let wanted = squeezed(&mut channel.shape.iter().copied());
                let fields = format!("channel `{}`", channel.name);
                if self.shape_is_free(index) && (len.is_none() || found != wanted) {
                    let wanted = format!("{:?}", channel.shape);
                    return Err(differs(&declared.name, &shape, &wanted, &fields));
                }
                // An integer of one element is an index, others are numbers that the graph casts itself.
                ty = match (channel.dtype, ty) {
                    (DType::I32, Type::I64) if channel.len() == 1 && input => Type::I64,
                    (DType::I32 | DType::U8, _) | (DType::F32, Type::F32) => Type::F32,
                    (DType::F32, Type::I64) if !self.shape_is_free(index) => ty,
                    (DType::F32, Type::I64) => {
                        return Err(format!(
                            "{} has elements of I64, by the contract's {fields} they are F32",
                            declared.name
                        ));
                    }
                };
                fields
            }
            Bound::State(_) | Bound::Row(_) if !self.faults.free(&["states"]) => String::new(),
            Bound::State(index) | Bound::Row(index) => {
                let state = &self.blueprint.states[index];
                let rows = match (state.keep, bound, input) {
                    (Keep::Ring { rows, .. }, Bound::State(_), true) => rows,
                    _ => 1,
                };
                let len = len.filter(|len| len.is_multiple_of(rows) && ty == Type::F32);
                let width = len.and_then(|len| len.checked_div(rows)).ok_or_else(|| {
                    format!(
                        "{} is {ty:?} {}, state `{}` has {rows} rows of F32",
                        declared.name,
                        show(&shape),
                        state.name
                    )
                })?;
                let known = state.width.clone().unwrap_or_else(|| {
                    self.widths
                        .entry(index)
                        .or_insert_with(|| (width, declared.name.clone()))
                        .clone()
                });
                let fields = format!("`{}`", known.1);
                if known.0 != width && self.faults.free(&[&known.1]) {
                    let wanted = format!("[{rows}, {}]", known.0);
                    return Err(differs(&declared.name, &shape, &wanted, &fields));
                }
                fields
            }
            Bound::Timestep | Bound::Phase | Bound::Pass | Bound::Selected => {
                if ty != Type::I64 || len != Some(1) {
                    return Err(format!(
                        "{} is {ty:?} {}, it must be one I64",
                        declared.name,
                        show(&shape)
                    ));
                }
                "the family".into()
            }
            Bound::Cache => "`network`".into(),
        };
        Ok(Value {
            name: name.to_owned(),
            ty,
            shape,
            fields,
        })
    }

    /// Checks the keys and values of every layer of the entry's transformer, and that there are no
    /// others.
    fn cache(
        &self,
        cache: Option<&str>,
        entry: &str,
        inputs: &[Value],
        outputs: &[Value],
    ) -> Result<(), String> {
        let state = cache.and_then(|name| {
            self.blueprint
                .states
                .iter()
                .find(|state| state.name == name)
        });
        let network = match state.map(|state| state.keep) {
            Some(Keep::Kv(network)) => Some(network),
            _ => None,
        };
        let words = self.contract.words().map(|[words, _]| words);
        for (values, what) in [(inputs, "past_key_values"), (outputs, "present")] {
            let found: Vec<&Value> = values
                .iter()
                .filter(|value| value.name.starts_with(what))
                .collect();
            // What reads the instruction begins the cache, and so has no past.
            let begins = what == "past_key_values"
                && found.is_empty()
                && inputs
                    .iter()
                    .any(|value| Some(value.shape.len()) == words.map(|_| 3));
            let layers = match network {
                Some(_) if begins => 0,
                Some(network) => network.layers,
                None => 0,
            };
            if found.len() != 2 * layers {
                return Err(format!(
                    "entry {entry} has {} values {what}, by the contract's `network` there are {}",
                    found.len(),
                    2 * layers
                ));
            }
            for layer in 0..layers {
                for part in ["key", "value"] {
                    let name = format!("{what}.{layer}.{part}");
                    let value = found.iter().find(|value| value.name == name);
                    let value = value.ok_or_else(|| format!("value {entry}/{name} is missing"))?;
                    let (heads, head_dim) =
                        network.map_or((0, 0), |network| (network.heads, network.head_dim));
                    let fits = value.ty == Type::F32
                        && matches!(value.shape[..], [one, h, _, d]
                            if one.is_one() && h == Dim::of(heads) && d == Dim::of(head_dim));
                    if !fits {
                        let wanted = format!("[1, {heads}, P, {head_dim}]");
                        let full = format!("{entry}/{name}");
                        return Err(differs(&full, &value.shape, &wanted, "`network`"));
                    }
                }
            }
        }
        Ok(())
    }
}

/// Checks the table of instructions.
fn lookup(graph: &GraphProto, [words, dim]: [usize; 2], problems: &mut Vec<String>) -> Signature {
    let wanted = |name: &str, ty, shape: &[usize]| Value {
        name: name.into(),
        ty,
        shape: shape.iter().map(|&dim| Dim::of(dim)).collect(),
        fields: "the instruction channel".into(),
    };
    let signature = Signature {
        entry: LOOKUP_INSTRUCTION.into(),
        inputs: vec![wanted("id", Type::I64, &[1])],
        outputs: vec![
            wanted("words", Type::F32, &[1, words, dim]),
            wanted("length", Type::I64, &[1]),
        ],
    };
    for (values, declared, what) in [
        (&signature.inputs, &graph.input, "input"),
        (&signature.outputs, &graph.output, "output"),
    ] {
        for value in values {
            let name = format!("{LOOKUP_INSTRUCTION}/{}", value.name);
            match declared.iter().find(|other| other.name == name) {
                None => problems.push(format!("{what} {name} is missing")),
                Some(found) => match declaration(found) {
                    Ok((ty, shape)) if ty == value.ty && shape == value.shape => {}
                    Ok((_, shape)) => {
                        let wanted = show(&value.shape);
                        problems.push(differs(&name, &shape, &wanted, &value.fields));
                    }
                    Err(problem) => problems.push(problem),
                },
            }
        }
    }
    signature
}

fn differs(name: &str, found: &[Dim], wanted: &str, fields: &str) -> String {
    format!(
        "{name} has shape {}, by the contract's {fields} it is {wanted}",
        show(found)
    )
}

/// Returns the entry that a value's name starts with: its first two parts.
pub(crate) fn entry_of(name: &str) -> Option<&str> {
    let first = name.find('/')?;
    let second = name[first + 1..].find('/')?;
    Some(&name[..=first + second])
}

/// Returns the nodes that some values need, in the graph's order.
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
