//! Oracle for the meaning of an ONNX model: tract.

use std::collections::HashMap;

use prost::Message;
use tract_onnx::prelude::*;

use crate::onnx::{ModelProto, ValueInfoProto};

/// One entry, ready to run. Values go by their short names.
pub struct Oracle {
    plan: Arc<TypedRunnableModel>,
    inputs: Vec<String>,
    outputs: Vec<String>,
}

impl Oracle {
    pub fn new(bytes: &[u8]) -> Self {
        let graph = ModelProto::decode(bytes)
            .expect("a model")
            .graph
            .expect("a graph");
        let short = |value: &ValueInfoProto| {
            value
                .name
                .splitn(3, '/')
                .last()
                .expect("a name")
                .to_string()
        };
        let model = tract_onnx::onnx()
            .model_for_read(&mut &*bytes)
            .expect("tract reads the model");
        let model = model
            .into_typed()
            .expect("tract types the model")
            .into_decluttered()
            .expect("tract declutters the model");
        Self {
            plan: model.into_runnable().expect("tract runs the model"),
            inputs: graph.input.iter().map(short).collect(),
            outputs: graph.output.iter().map(short).collect(),
        }
    }

    /// Runs the entry and returns the outputs as numbers, integers too.
    pub fn run(&self, inputs: &HashMap<String, Tensor>) -> HashMap<String, Vec<f32>> {
        let inputs = self
            .inputs
            .iter()
            .map(|name| inputs[name].clone().into())
            .collect();
        let outputs = self.plan.run(inputs).expect("tract runs");
        let numbers = |value: &TValue| {
            let cast = value.cast_to::<f32>().expect("numbers");
            cast.to_plain_array_view::<f32>()
                .expect("numbers")
                .iter()
                .copied()
                .collect()
        };
        self.outputs
            .iter()
            .cloned()
            .zip(outputs.iter().map(numbers))
            .collect()
    }
}

pub fn tensor(shape: &[usize], values: &[f32]) -> Tensor {
    Tensor::from_shape(shape, values).expect("a tensor")
}

pub fn integer(value: i64) -> Tensor {
    Tensor::from_shape(&[1], &[value]).expect("a tensor")
}

/// Compares element by element, relative to numbers above one.
#[track_caller]
pub fn close(what: &str, got: &[f32], wanted: &[f32]) {
    assert_eq!(got.len(), wanted.len(), "{what}");
    for (i, (&got, &wanted)) in got.iter().zip(wanted).enumerate() {
        let bound = 1e-5 * wanted.abs().max(1.0);
        assert!(
            (got - wanted).abs() <= bound,
            "{what}: element {i} is {got}, not {wanted}"
        );
    }
}
