//! Runs tract: the context length stays symbolic, the plan is optimised once, a state is kept over all calls.

use tract_onnx::prelude::{Tensor as TractTensor, *};

use super::cut::{self, Data};
use super::engine::{Engine, Named, Session, failed, given};
use lads_pace::BenchError;

const NAME: &str = "tract";

/// The crate tract-onnx.
#[derive(Debug, Clone, Copy)]
pub struct Tract;

impl Engine for Tract {
    fn name(&self) -> &'static str {
        NAME
    }

    fn detail(&self) -> String {
        "0.23.9, crate tract-onnx, 1 thread, symbolic context length".into()
    }

    fn load(&self, model: &[u8]) -> Result<Box<dyn Session>, BenchError> {
        let (input_names, output_names) = cut::signature(model)?;
        let load = || {
            tract_onnx::onnx()
                .model_for_read(&mut &*model)?
                .into_optimized()?
                .into_runnable()?
                .spawn()
        };
        let state = load().map_err(|error| failed(NAME, format!("{error:#}")))?;
        Ok(Box::new(Loaded {
            state,
            input_names,
            output_names,
            inputs: TVec::new(),
            outputs: TVec::new(),
        }))
    }
}

struct Loaded {
    state: TypedSimpleState,
    input_names: Vec<String>,
    output_names: Vec<String>,
    inputs: TVec<TValue>,
    outputs: TVec<TValue>,
}

fn tensor(tensor: &cut::Tensor) -> Result<TractTensor, BenchError> {
    match &tensor.data {
        Data::F32(values) => TractTensor::from_shape(&tensor.shape, values),
        Data::I64(values) => TractTensor::from_shape(&tensor.shape, values),
    }
    .map_err(|error| failed(NAME, error))
}

impl Session for Loaded {
    fn bind(&mut self, inputs: &Named) -> Result<(), BenchError> {
        self.inputs.clear();
        for wanted in &self.input_names {
            let value = given(inputs, wanted).map_err(|error| failed(NAME, error))?;
            self.inputs.push(tensor(value)?.into_tvalue());
        }
        Ok(())
    }

    fn write(&mut self, input: usize, values: &[f32]) -> Result<(), BenchError> {
        let place = self
            .inputs
            .get_mut(input)
            .ok_or_else(|| failed(NAME, "no such input"))?;
        *place = TractTensor::from_shape(&[1, values.len()], values)
            .map_err(|error| failed(NAME, error))?
            .into_tvalue();
        Ok(())
    }

    fn write_integer(&mut self, input: usize, value: i64) -> Result<(), BenchError> {
        let place = self
            .inputs
            .get_mut(input)
            .ok_or_else(|| failed(NAME, "no such input"))?;
        *place = TractTensor::from_shape(&[1], &[value])
            .map_err(|error| failed(NAME, error))?
            .into_tvalue();
        Ok(())
    }

    fn call(&mut self) -> Result<(), BenchError> {
        self.outputs = self
            .state
            .run(self.inputs.clone())
            .map_err(|error| failed(NAME, format!("{error:#}")))?;
        Ok(())
    }

    fn read(&self, output: usize, to: &mut [f32]) -> Result<(), BenchError> {
        let value = self
            .outputs
            .get(output)
            .ok_or_else(|| failed(NAME, "no such output"))?;
        let view = value
            .to_plain_array_view::<f32>()
            .map_err(|error| failed(NAME, error))?;
        for (to, from) in to.iter_mut().zip(view.iter()) {
            *to = *from;
        }
        Ok(())
    }

    fn outputs(&self) -> Result<Vec<(String, cut::Tensor)>, BenchError> {
        let read = |value: &TValue| {
            let shape = value.shape().to_vec();
            if let Ok(view) = value.to_plain_array_view::<f32>() {
                return Ok(cut::Tensor {
                    shape,
                    data: Data::F32(view.iter().copied().collect()),
                });
            }
            let cast = value
                .cast_to::<i64>()
                .map_err(|error| failed(NAME, error))?;
            let view = cast
                .to_plain_array_view::<i64>()
                .map_err(|error| failed(NAME, error))?;
            Ok(cut::Tensor {
                shape,
                data: Data::I64(view.iter().copied().collect()),
            })
        };
        self.output_names
            .iter()
            .zip(&self.outputs)
            .map(|(name, value)| Ok((name.clone(), read(value)?)))
            .collect()
    }

    fn input_names(&self) -> Vec<String> {
        self.input_names.clone()
    }

    fn output_names(&self) -> Vec<String> {
        self.output_names.clone()
    }
}
