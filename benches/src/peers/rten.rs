//! Runs rten: weights packed when the model is loaded, a pool of one thread.

use std::sync::Arc;

use rten::{Model, ModelOptions, NodeId, RunOptions, ThreadPool, Value, ValueOrView};
use rten_tensor::Tensor as RtenTensor;
use rten_tensor::prelude::{AsView, Layout};

use super::cut::{Data, Tensor};
use super::engine::{Engine, Named, Session, failed, given};
use lads_pace::BenchError;
use lads_pace::realtime::Realtime;

const NAME: &str = "rten";

/// The crate rten.
#[derive(Debug, Clone, Copy)]
pub struct Rten;

impl Engine for Rten {
    fn name(&self) -> &'static str {
        NAME
    }

    fn detail(&self) -> String {
        "0.27.0, crate rten, 1 thread, weights packed in advance, inputs borrowed".into()
    }

    fn load(&self, model: &[u8]) -> Result<Box<dyn Session>, BenchError> {
        let mut options = ModelOptions::with_all_ops();
        let model = options
            .prepack_weights(true)
            .load(model.to_vec())
            .map_err(|error| failed(NAME, error))?;
        let names = |ids: &[NodeId]| -> Vec<String> {
            let name = |&id| {
                model
                    .node_info(id)
                    .and_then(|node| node.name().map(str::to_owned))
            };
            ids.iter().map(|id| name(id).unwrap_or_default()).collect()
        };
        let (input_names, output_names) = (names(model.input_ids()), names(model.output_ids()));
        // Its thread does the work, so it has to be one of those that run before ordinary ones.
        let _granted = Realtime::scheduling();
        let pool = Arc::new(ThreadPool::with_num_threads(1));
        Ok(Box::new(Loaded {
            model,
            pool,
            input_names,
            output_names,
            inputs: vec![],
            outputs: vec![],
        }))
    }
}

struct Loaded {
    model: Model,
    pool: Arc<ThreadPool>,
    input_names: Vec<String>,
    output_names: Vec<String>,
    inputs: Vec<Value>,
    outputs: Vec<Value>,
}

/// Converts a tensor to rten's type, which has no 64-bit integers: they become 32-bit ones.
fn value(tensor: &Tensor) -> Value {
    match &tensor.data {
        Data::F32(values) => RtenTensor::from_data(&tensor.shape, values.clone()).into(),
        Data::I64(values) => RtenTensor::from_data(
            &tensor.shape,
            values.iter().map(|&x| x as i32).collect::<Vec<_>>(),
        )
        .into(),
    }
}

impl Session for Loaded {
    fn bind(&mut self, inputs: &Named) -> Result<(), BenchError> {
        self.inputs.clear();
        for wanted in &self.input_names {
            let tensor = given(inputs, wanted).map_err(|error| failed(NAME, error))?;
            self.inputs.push(value(tensor));
        }
        Ok(())
    }

    fn write(&mut self, input: usize, values: &[f32]) -> Result<(), BenchError> {
        match self.inputs.get_mut(input) {
            Some(Value::FloatTensor(bound)) => {
                for (to, from) in bound.iter_mut().zip(values) {
                    *to = *from;
                }
                Ok(())
            }
            _ => Err(failed(NAME, "no such input")),
        }
    }

    fn write_integer(&mut self, input: usize, integer: i64) -> Result<(), BenchError> {
        match self.inputs.get_mut(input) {
            Some(Value::Int32Tensor(bound)) => {
                bound.iter_mut().for_each(|to| *to = integer as i32);
                Ok(())
            }
            _ => Err(failed(NAME, "no such input")),
        }
    }

    fn call(&mut self) -> Result<(), BenchError> {
        let inputs = self
            .model
            .input_ids()
            .iter()
            .copied()
            .zip(self.inputs.iter().map(ValueOrView::from));
        let mut options = RunOptions::default();
        options.thread_pool = Some(Arc::clone(&self.pool));
        self.outputs = self
            .model
            .run(inputs.collect(), self.model.output_ids(), Some(options))
            .map_err(|error| failed(NAME, error))?;
        Ok(())
    }

    fn read(&self, output: usize, to: &mut [f32]) -> Result<(), BenchError> {
        match self.outputs.get(output) {
            Some(Value::FloatTensor(values)) => {
                for (to, from) in to.iter_mut().zip(values.iter()) {
                    *to = *from;
                }
                Ok(())
            }
            _ => Err(failed(NAME, "no such output")),
        }
    }

    fn outputs(&self) -> Result<Vec<(String, Tensor)>, BenchError> {
        let read = |value: &Value| match value {
            Value::FloatTensor(values) => Ok(Tensor {
                shape: values.shape().to_vec(),
                data: Data::F32(values.to_vec()),
            }),
            Value::Int32Tensor(values) => {
                let integers = values.iter().map(|&x| i64::from(x)).collect();
                Ok(Tensor {
                    shape: values.shape().to_vec(),
                    data: Data::I64(integers),
                })
            }
            _ => Err(failed(NAME, "an output of another type")),
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
