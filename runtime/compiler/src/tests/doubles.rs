//! Evaluates a graph in double precision, node by node as it was imported, against the same oracles
//! as compiled programs: golden steps are written from these numbers.

use std::collections::HashMap;

use ndarray::{ArrayD, IxDyn};

use crate::entries::Signature;
use crate::graph::{Type, Value, evaluate, topological};
use crate::import::Model;
use crate::onnx::ModelProto;

/// Returns the outputs of an entry for the named inputs.
pub fn outputs(
    model: &ModelProto,
    signature: &Signature,
    given: &HashMap<String, Vec<f32>>,
) -> HashMap<String, Vec<f32>> {
    let graph = model.graph.as_ref().expect("a graph");
    let entry = Model::new(model, graph).and_then(|model| model.import(signature, &HashMap::new()));
    let entry = entry.unwrap_or_else(|error| panic!("{error}"));
    let g = &entry.graph;
    let mut values = HashMap::new();
    for (name, id) in &entry.inputs {
        let shape = IxDyn(&g.known_shape(*id).expect("a known shape"));
        let numbers = given[name].iter().copied().map(f64::from).collect();
        let array = ArrayD::from_shape_vec(shape, numbers).expect("as many numbers");
        let value = match g.ty(*id) {
            Type::F32 => Value::Float(array),
            Type::I64 => Value::Int(array.mapv(|x| x as i64)),
        };
        values.insert(*id, value);
    }
    let roots: Vec<_> = entry.outputs.iter().map(|&(_, id)| id).collect();
    for id in topological(g, &roots, &HashMap::new()) {
        if values.contains_key(&id) {
            continue;
        }
        let value = if let Some(constant) = g.constant(id) {
            Value::of(constant)
        } else {
            let node = g.node(id);
            let operands: Vec<_> = node.inputs.iter().map(|id| values[id].view()).collect();
            let shape = g.known_shape(id).expect("a known shape");
            evaluate(&node.op, &operands, &shape)
        };
        let value = value.unwrap_or_else(|| panic!("{:?} is not evaluated", g.op(id)));
        values.insert(id, value);
    }
    let numbers = |value: &Value<f64>| match value {
        Value::Float(array) => array.iter().map(|&x| x as f32).collect(),
        Value::Int(array) => array.iter().map(|&x| x as f32).collect(),
    };
    let named = entry.outputs.iter();
    named
        .map(|(name, id)| (name.clone(), numbers(&values[id])))
        .collect()
}
