//! A plain policy computed in double precision, straight from its graph: what a compiled policy is compared with.
//!
//! Nothing is fused, planned or rounded to 32 bits, and `ndarray` holds the values, so that of the compiler only the reading of ONNX is
//! shared with what is compared. What can fail: the bytes are no bundle of the family `plain`, or a value has another shape than the
//! contract says.

use std::collections::HashMap;

use bytes::Bytes;
use lads_image::op::{BinaryKind, ReduceKind, UnaryKind};
use ndarray::{ArrayD, Axis, IxDyn, Slice, Zip, concatenate};

use crate::contract::{Contract, Fill, StateKind};
use crate::entries;
use crate::error::{BundleError, CompileError};
use crate::graph::{Dim, Graph, Id, Op, Unary, topological};
use crate::import::Model;
use crate::onnx;
use crate::tensor::Data;

/// A plain policy in double precision.
pub struct Reference {
    contract: Contract,
    graph: Graph,
    inputs: Vec<(String, Id)>,
    outputs: Vec<(String, Id)>,
    /// Nodes that the outputs need, operands first.
    order: Vec<Id>,
    constants: HashMap<Id, Value>,
    /// Plain states as a whole; the rows of rings that have been seen.
    states: HashMap<String, ArrayD<f64>>,
}

/// A value of the graph.
#[derive(Debug, Clone)]
enum Value {
    Float(ArrayD<f64>),
    Int(ArrayD<i64>),
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
            .filter_map(|&id| Some((id, constant(&imported.graph, id)?)))
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

    /// The contract of the policy.
    pub fn contract(&self) -> &Contract {
        &self.contract
    }

    /// Starts an episode: every state is as it was at first.
    pub fn reset(&mut self) {
        self.states.clear();
    }

    /// The action for the values of each observation channel, in the contract's order, inside the action's limits.
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
        let mut values = self.constants.clone();
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
            let integer = self.graph.ty(*id) == crate::graph::Type::I64;
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
            if values.contains_key(&id) {
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
            let Some(Value::Float(value)) = values.get(id) else {
                return Err(refused(format!("output `{name}` is no float")));
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

    /// The rows of a ring, the missing ones put in front.
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

    fn node(&self, id: Id, values: &HashMap<Id, Value>) -> Option<Value> {
        let node = self.graph.node(id);
        let x = |i: usize| values.get(node.inputs.get(i)?);
        let float = |i: usize| match x(i)? {
            Value::Float(array) => Some(array),
            Value::Int(_) => None,
        };
        let shape: Vec<usize> = node.shape.iter().map(|dim: &Dim| dim.fixed).collect();
        let y = match &node.op {
            Op::Shift(by) => match x(0)? {
                Value::Int(array) => return Some(Value::Int(array.mapv(|x| x + by))),
                Value::Float(_) => return None,
            },
            Op::ToIndex => return Some(Value::Int(float(0)?.mapv(|x| x.trunc() as i64))),
            Op::FromIndex => match x(0)? {
                Value::Int(array) => array.mapv(|x| x as f64),
                Value::Float(_) => return None,
            },
            Op::ArgMin | Op::ArgMax => {
                let largest = node.op == Op::ArgMax;
                return Some(Value::Int(ArrayD::from_elem(
                    IxDyn(&shape),
                    best(float(0)?, largest),
                )));
            }
            Op::Reshape => match x(0)? {
                Value::Int(array) => {
                    let data = array.iter().copied().collect();
                    return Some(Value::Int(
                        ArrayD::from_shape_vec(IxDyn(&shape), data).ok()?,
                    ));
                }
                Value::Float(array) => {
                    ArrayD::from_shape_vec(IxDyn(&shape), array.iter().copied().collect()).ok()?
                }
            },
            Op::Transpose(perm) => float(0)?.clone().permuted_axes(IxDyn(perm)),
            Op::Slice { axis, start } => float(0)?
                .slice_axis(Axis(*axis), Slice::from(*start..start + shape[*axis]))
                .to_owned(),
            Op::Concat { axis } => {
                let parts: Option<Vec<_>> = (0..node.inputs.len())
                    .map(|i| Some(float(i)?.view()))
                    .collect();
                concatenate(Axis(*axis), &parts?).ok()?
            }
            Op::Expand => float(0)?.broadcast(IxDyn(&shape))?.to_owned(),
            Op::Unary(unary) => float(0)?.mapv(|x| apply(*unary, x)),
            Op::Binary(kind) => {
                let (a, b) = (
                    float(0)?.broadcast(IxDyn(&shape))?,
                    float(1)?.broadcast(IxDyn(&shape))?,
                );
                Zip::from(a)
                    .and(b)
                    .map_collect(|&a, &b| binary(kind.0, a, b))
            }
            Op::Reduce(kind, axis) => float(0)?.map_axis(Axis(*axis), |row| match kind.0 {
                ReduceKind::Sum => row.sum(),
                ReduceKind::Mean => row.sum() / row.len() as f64,
                ReduceKind::Max => row.fold(f64::NEG_INFINITY, |a, &b| a.max(b)),
                ReduceKind::Min => row.fold(f64::INFINITY, |a, &b| a.min(b)),
                ReduceKind::Prod => row.product(),
            }),
            Op::MatMul => matmul(float(0)?, float(1)?, &shape)?,
            Op::Softmax => rows(float(0)?, |mut row| {
                let most = row.fold(f64::NEG_INFINITY, |a, &b| a.max(b));
                row.mapv_inplace(|x| (x - most).exp());
                let sum = row.sum();
                row.mapv_inplace(|x| x / sum);
            }),
            Op::LayerNorm { eps } => {
                let eps = f64::from(f32::from_bits(*eps));
                let mut y = rows(float(0)?, |mut row| {
                    let mean = row.sum() / row.len() as f64;
                    let var =
                        row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / row.len() as f64;
                    row.mapv_inplace(|x| (x - mean) / (var + eps).sqrt());
                });
                y = y * float(1)?.broadcast(IxDyn(&shape))?;
                y + float(2)?.broadcast(IxDyn(&shape))?
            }
            Op::GatherRow => {
                let Value::Int(index) = x(1)? else {
                    return None;
                };
                let table = float(0)?;
                let row = usize::try_from(*index.first()?).ok()?;
                let row = (row < table.shape()[0]).then(|| table.index_axis(Axis(0), row))?;
                ArrayD::from_shape_vec(IxDyn(&shape), row.iter().copied().collect()).ok()?
            }
            // What later passes of the compiler make, and inputs, which are there already.
            _ => return None,
        };
        Some(Value::Float(y))
    }
}

fn refused(problem: String) -> CompileError {
    CompileError::Entry {
        entry: "policy/act".into(),
        problem: problem.into(),
    }
}

fn constant(graph: &Graph, id: Id) -> Option<Value> {
    let tensor = graph.constant(id)?;
    let shape = IxDyn(&tensor.shape);
    Some(match &tensor.data {
        Data::F32(data) => {
            let data = data.iter().map(|&x| f64::from(x)).collect();
            Value::Float(ArrayD::from_shape_vec(shape, data).ok()?)
        }
        Data::I64(data) => Value::Int(ArrayD::from_shape_vec(shape, data.clone()).ok()?),
    })
}

/// The rows of a ring with one more, at most so many.
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

/// A copy whose rows over the last axis were changed.
fn rows(x: &ArrayD<f64>, change: impl Fn(ndarray::ArrayViewMut1<f64>)) -> ArrayD<f64> {
    let mut y = x.clone();
    let last = Axis(y.ndim().saturating_sub(1));
    y.lanes_mut(last).into_iter().for_each(change);
    y
}

/// Index of the first smallest or largest element.
fn best(x: &ArrayD<f64>, largest: bool) -> i64 {
    let better = |a: f64, b: f64| if largest { a > b } else { a < b };
    let mut found = (0, f64::NAN);
    for (i, &value) in x.iter().enumerate() {
        if i == 0 || better(value, found.1) {
            found = (i as i64, value);
        }
    }
    found.0
}

/// Products over the last two axes, the others broadcast.
fn matmul(a: &ArrayD<f64>, b: &ArrayD<f64>, shape: &[usize]) -> Option<ArrayD<f64>> {
    let (batch, &[m, n]) = shape.split_last_chunk::<2>()?;
    let k = *a.shape().last()?;
    let spread = |x: &ArrayD<f64>, rows: usize, cols: usize| {
        let wanted = [batch, &[rows, cols]].concat();
        let wide = x.broadcast(IxDyn(&wanted))?;
        let wide = wide.as_standard_layout().into_owned();
        wide.into_shape_with_order((batch.iter().product::<usize>(), rows, cols))
            .ok()
    };
    let (a, b) = (spread(a, m, k)?, spread(b, k, n)?);
    let products = a
        .outer_iter()
        .zip(b.outer_iter())
        .flat_map(|(a, b)| a.dot(&b).into_iter().collect::<Vec<f64>>());
    ArrayD::from_shape_vec(IxDyn(shape), products.collect()).ok()
}

fn binary(kind: BinaryKind, a: f64, b: f64) -> f64 {
    match kind {
        BinaryKind::Add => a + b,
        BinaryKind::Sub => a - b,
        BinaryKind::Mul => a * b,
        BinaryKind::Div => a / b,
        BinaryKind::Max => a.max(b),
        BinaryKind::Min => a.min(b),
        BinaryKind::Pow => a.powf(b),
        BinaryKind::Greater => f64::from(u8::from(a > b)),
        BinaryKind::Keep if b == 0.0 => 0.0,
        BinaryKind::Keep => a,
    }
}

fn apply(unary: Unary, x: f64) -> f64 {
    let alpha = f64::from(f32::from_bits(unary.alpha));
    match unary.kind.0 {
        UnaryKind::Relu => x.max(0.0),
        UnaryKind::LeakyRelu if x < 0.0 => alpha * x,
        UnaryKind::Tanh => x.tanh(),
        UnaryKind::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        UnaryKind::Exp => x.exp(),
        UnaryKind::Log => x.ln(),
        UnaryKind::Sqrt => x.sqrt(),
        UnaryKind::Rsqrt => 1.0 / x.sqrt(),
        UnaryKind::Neg => -x,
        UnaryKind::Abs => x.abs(),
        UnaryKind::Recip => 1.0 / x,
        UnaryKind::Erf => libm::erf(x),
        UnaryKind::Square => x * x,
        UnaryKind::Elu if x < 0.0 => alpha * x.exp_m1(),
        UnaryKind::LeakyRelu | UnaryKind::Elu => x,
        UnaryKind::Softplus => x.max(0.0) + (-x.abs()).exp().ln_1p(),
        UnaryKind::Mish => x * (x.max(0.0) + (-x.abs()).exp().ln_1p()).tanh(),
        UnaryKind::Trunc => x.trunc(),
    }
}
