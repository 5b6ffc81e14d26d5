//! Computes a plain policy in double precision, straight from its graph, as the reference for a
//! compiled policy.
//!
//! Nothing is fused or planned, and only folded constants are rounded to 32 bits: the reference
//! shares only the reading of ONNX and the folding of constants with the compiled policy. What can
//! fail: the bytes are not a bundle of the family `plain`, or a value has another shape than the
//! contract states.

use std::collections::HashMap;

use bytes::Bytes;
use ndarray::{ArrayD, Axis, IxDyn, Slice, concatenate};

use crate::contract::{Contract, Fill, StateKind};
use crate::entries;
use crate::error::{BundleError, CompileError};
use crate::graph::{Graph, Id, Type, Value, evaluate, topological};
use crate::import::Model;
use crate::onnx;

/// A plain policy in double precision.
pub struct Reference {
    contract: Contract,
    graph: Graph,
    inputs: Vec<(String, Id)>,
    outputs: Vec<(String, Id)>,
    /// Nodes that the outputs need, operands first.
    order: Vec<Id>,
    constants: HashMap<Id, Value<f64>>,
    /// Values of plain states, and the rows that rings have seen.
    states: HashMap<String, ArrayD<f64>>,
}

impl Reference {
    /// Reads a model with the contract of a plain policy in its metadata; a golden episode is not needed.
    pub fn new(bytes: &[u8]) -> Result<Self, CompileError> {
        let bundle = |error: BundleError| CompileError::Bundle(error);
        let model = onnx::decode(&Bytes::copy_from_slice(bytes)).map_err(bundle)?;
        let contract = model
            .metadata_props
            .iter()
            .find(|pair| pair.key == "lads.contract")
            .ok_or(BundleError::NoContract)
            .and_then(|pair| Contract::parse(&pair.value))
            .map_err(bundle)?;
        let graph = model.graph.as_ref().ok_or_else(|| {
            bundle(BundleError::NotOnnx {
                problem: "it has no graph".into(),
            })
        })?;
        let blueprint = contract.family.kind().blueprint(&contract);
        let signatures = entries::signatures(graph, &contract, &blueprint).map_err(bundle)?;
        let signature = signatures
            .iter()
            .find(|signature| signature.entry == "policy/act" && contract.words().is_none())
            .ok_or_else(|| refused("only policies of the family `plain` are computed".into()))?;
        let imported = Model::new(&model, graph)?.import(signature, &HashMap::new())?;
        let roots: Vec<Id> = imported.outputs.iter().map(|&(_, id)| id).collect();
        let order = topological(&imported.graph, &roots, &HashMap::new());
        let constants = order
            .iter()
            .filter_map(|&id| Some((id, Value::of(imported.graph.constant(id)?)?)))
            .collect();
        let mut reference = Self {
            contract,
            graph: imported.graph,
            inputs: imported.inputs,
            outputs: imported.outputs,
            order,
            constants,
            states: HashMap::new(),
        };
        reference.reset();
        Ok(reference)
    }

    /// Returns the contract of the policy.
    pub fn contract(&self) -> &Contract {
        &self.contract
    }

    /// Starts an episode: every state returns to its initial value.
    pub fn reset(&mut self) {
        self.states.clear();
    }

    /// Returns the action for the values of each observation channel, in the contract's order,
    /// inside the action's limits.
    pub fn step(&mut self, observations: &[Vec<f64>]) -> Result<Vec<f64>, CompileError> {
        let channels: HashMap<&str, &Vec<f64>> = self
            .contract
            .observations()
            .map(|channel| channel.name.as_str())
            .zip(observations)
            .collect();
        let mut rings = HashMap::new();
        for state in &self.contract.states {
            if let (StateKind::Ring, Some(source)) = (state.kind, &state.source) {
                let row = channels
                    .get(source.as_str())
                    .ok_or_else(|| refused(format!("no values for channel `{source}`")))?;
                let rows = appended(self.states.get(&state.name), row, state.rows)
                    .map_err(|problem| refused(format!("state `{}`: {problem}", state.name)))?;
                rings.insert(state.name.clone(), rows);
            }
        }
        let mut values = HashMap::new();
        for (name, id) in &self.inputs {
            let shape: Vec<usize> = self.graph.shape(*id).iter().map(|dim| dim.fixed).collect();
            let given = if let Some(values) = channels.get(name.as_str()) {
                Some((*values).clone())
            } else if let Some(rows) = rings.get(name) {
                Some(self.filled(name, rows))
            } else {
                self.states
                    .get(name)
                    .map(|state| state.iter().copied().collect())
            };
            let given = given.unwrap_or_else(|| vec![0.0; shape.iter().product()]);
            let integer = self.graph.ty(*id) == Type::I64;
            let array = ArrayD::from_shape_vec(IxDyn(&shape), given)
                .map_err(|error| refused(format!("`{name}`: {error}")))?;
            let value = if integer {
                Value::Int(array.mapv(|x| x as i64))
            } else {
                Value::Float(array)
            };
            values.insert(*id, value);
        }
        for &id in &self.order {
            if self.value(id, &values).is_some() {
                continue;
            }
            let value = self.node(id, &values).ok_or_else(|| {
                let (operator, node) = self.graph.origin(id);
                CompileError::Operator {
                    entry: "policy/act".into(),
                    operator: operator.into(),
                    node: node.into(),
                    problem: "is not computed in double precision".into(),
                }
            })?;
            values.insert(id, value);
        }
        let mut action = vec![];
        let mut after = rings;
        for (name, id) in &self.outputs {
            let Some(Value::Float(value)) = self.value(*id, &values) else {
                return Err(refused(format!("output `{name}` is not a float")));
            };
            match name.strip_prefix("next_") {
                Some(state) => {
                    after.insert(state.into(), value.clone());
                }
                None => action = value.iter().copied().collect(),
            }
        }
        self.states = after;
        for (value, element) in action.iter_mut().zip(&self.contract.action().elements) {
            *value = value.clamp(f64::from(element.min), f64::from(element.max));
        }
        Ok(action)
    }

    /// Returns the rows of a ring, with the missing ones in front.
    fn filled(&self, name: &str, rows: &ArrayD<f64>) -> Vec<f64> {
        let Some(state) = self.contract.states.iter().find(|state| state.name == name) else {
            return vec![];
        };
        let width = rows.len() / rows.shape()[0];
        let missing = state.rows - rows.shape()[0];
        let first: Vec<f64> = rows.iter().take(width).copied().collect();
        let stand_in = match state.fill {
            Fill::Zero => vec![0.0; width],
            Fill::First => first,
        };
        let mut all: Vec<f64> = (0..missing).flat_map(|_| stand_in.clone()).collect();
        all.extend(rows.iter());
        all
    }

    /// Returns a constant, or a value of this step.
    fn value<'v>(&'v self, id: Id, values: &'v HashMap<Id, Value<f64>>) -> Option<&'v Value<f64>> {
        self.constants.get(&id).or_else(|| values.get(&id))
    }

    fn node(&self, id: Id, values: &HashMap<Id, Value<f64>>) -> Option<Value<f64>> {
        let node = self.graph.node(id);
        let operands: Option<Vec<_>> = node
            .inputs
            .iter()
            .map(|&input| Some(self.value(input, values)?.view()))
            .collect();
        let shape: Option<Vec<usize>> = node.shape.iter().map(|dim| dim.known()).collect();
        evaluate(&node.op, &operands?, &shape?)
    }
}

fn refused(problem: String) -> CompileError {
    CompileError::Entry {
        entry: "policy/act".into(),
        problem: problem.into(),
    }
}

/// Appends a row to the rows of a ring, keeping at most `most`.
fn appended(known: Option<&ArrayD<f64>>, row: &[f64], most: usize) -> Result<ArrayD<f64>, String> {
    let row = ArrayD::from_shape_vec(IxDyn(&[1, row.len()]), row.to_vec());
    let row = row.map_err(|error| error.to_string())?;
    let Some(known) = known else {
        return Ok(row);
    };
    let all =
        concatenate(Axis(0), &[known.view(), row.view()]).map_err(|error| error.to_string())?;
    let surplus = all.shape()[0].saturating_sub(most);
    Ok(all.slice_axis(Axis(0), Slice::from(surplus..)).to_owned())
}
