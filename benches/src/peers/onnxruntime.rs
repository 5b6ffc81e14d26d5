//! Runs ONNX Runtime through its C API: one thread, no spinning, inputs and outputs bound to memory that is allocated once.

use std::path::Path;
use std::sync::OnceLock;

use ort::environment::Environment;
use ort::memory::Allocator;
use ort::session::builder::GraphOptimizationLevel;
use ort::session::{IoBinding, Session as OrtSession};
use ort::value::{DynValue, Tensor as OrtTensor, TensorElementType};

use super::cut::{Data, Tensor};
use super::engine::{Engine, Named, Session, failed, given};
use lads_pace::BenchError;

const NAME: &str = "ONNX Runtime";

/// ONNX Runtime's environment, of which a process has one.
static ENVIRONMENT: OnceLock<Environment> = OnceLock::new();

/// The loaded library of ONNX Runtime.
#[derive(Debug)]
pub struct OnnxRuntime {
    environment: Environment,
    version: String,
}

impl OnnxRuntime {
    /// Loads the shared library of ONNX Runtime's PyPI wheel.
    pub fn new(library: &Path) -> Result<Self, BenchError> {
        if !library.is_file() {
            return Err(BenchError::new(
                library.display(),
                "there is no such file",
                "run python3 benches/setup.py, or name the library of ONNX Runtime",
            ));
        }
        let environment = if let Some(environment) = ENVIRONMENT.get() {
            environment.clone()
        } else {
            let builder = ort::init_from(library).map_err(|error| failed(NAME, error))?;
            let made = builder.with_telemetry(false).build();
            let made = made.map_err(|error| failed(NAME, error))?;
            ENVIRONMENT.get_or_init(|| made).clone()
        };
        // The wheel's version, which the set-up script leaves beside the library; the library itself only tells its commit.
        let stamp = std::fs::read_to_string(library.with_file_name("STAMP")).unwrap_or_default();
        let version = stamp.split_whitespace().next().unwrap_or("1.x").to_owned();
        Ok(Self {
            environment,
            version,
        })
    }
}

impl Engine for OnnxRuntime {
    fn name(&self) -> &'static str {
        NAME
    }

    fn detail(&self) -> String {
        let version = &self.version;
        format!("{version}, C API, 1 thread, no spinning, inputs and outputs bound")
    }

    fn load(&self, model: &[u8]) -> Result<Box<dyn Session>, BenchError> {
        let build = || -> ort::Result<OrtSession> {
            OrtSession::builder(&self.environment)?
                .with_intra_threads(1)?
                .with_inter_threads(1)?
                .with_intra_op_spinning(false)?
                .with_inter_op_spinning(false)?
                .with_optimization_level(GraphOptimizationLevel::All)?
                .commit_from_memory(model)
        };
        let session = build().map_err(|error| failed(NAME, error))?;
        Ok(Box::new(Bound {
            session,
            binding: None,
            inputs: vec![],
            outputs: vec![],
        }))
    }
}

/// A session, its binding, and the bound tensors.
struct Bound {
    session: OrtSession,
    binding: Option<IoBinding>,
    inputs: Vec<DynValue>,
    outputs: Vec<DynValue>,
}

impl Bound {
    /// Binds all inputs and outputs; the only axis that is not fixed is the rows of the past.
    fn bind_all(&mut self, inputs: &Named) -> ort::Result<()> {
        let mut binding = self.session.create_binding()?;
        self.inputs.clear();
        self.outputs.clear();
        let mut past = 0;
        for outlet in self.session.inputs() {
            let tensor = given(inputs, outlet.name()).map_err(ort::Error::new)?;
            if outlet.name().contains("past_key_values") {
                past = tensor.shape.get(2).copied().unwrap_or(0);
            }
            let shape: Vec<i64> = tensor.shape.iter().map(|&axis| axis as i64).collect();
            let value = match &tensor.data {
                Data::F32(values) => OrtTensor::from_array((shape, values.clone()))?.into_dyn(),
                Data::I64(values) => OrtTensor::from_array((shape, values.clone()))?.into_dyn(),
            };
            binding.bind_input(outlet.name(), &value)?;
            self.inputs.push(value);
        }
        for outlet in self.session.outputs() {
            let dtype = outlet.dtype();
            let shape = dtype
                .tensor_shape()
                .ok_or_else(|| ort::Error::new("an output is not a tensor"))?;
            // `present.N.key` is [1, heads, P + new, head_dim], with the past as its symbolic axis.
            let new = if outlet.name().contains("/start/") {
                1
            } else {
                2
            };
            let shape: Vec<i64> = shape
                .iter()
                .map(|&axis| if axis < 0 { (past + new) as i64 } else { axis })
                .collect();
            let integer = dtype.tensor_type() == Some(TensorElementType::Int64);
            let allocator = Allocator::default();
            let mut value = if integer {
                OrtTensor::<i64>::new(&allocator, shape)?.into_dyn()
            } else {
                OrtTensor::<f32>::new(&allocator, shape)?.into_dyn()
            };
            binding.bind_output(outlet.name(), &mut value)?;
            self.outputs.push(value);
        }
        self.binding = Some(binding);
        Ok(())
    }
}

impl Session for Bound {
    fn bind(&mut self, inputs: &Named) -> Result<(), BenchError> {
        self.bind_all(inputs).map_err(|error| failed(NAME, error))
    }

    fn write(&mut self, input: usize, values: &[f32]) -> Result<(), BenchError> {
        let value = self
            .inputs
            .get_mut(input)
            .ok_or_else(|| failed(NAME, "no such input"))?;
        let (_, bound) = value
            .try_extract_tensor_mut::<f32>()
            .map_err(|error| failed(NAME, error))?;
        bound.copy_from_slice(values);
        Ok(())
    }

    fn write_integer(&mut self, input: usize, integer: i64) -> Result<(), BenchError> {
        let value = self
            .inputs
            .get_mut(input)
            .ok_or_else(|| failed(NAME, "no such input"))?;
        let (_, bound) = value
            .try_extract_tensor_mut::<i64>()
            .map_err(|error| failed(NAME, error))?;
        bound.fill(integer);
        Ok(())
    }

    fn call(&mut self) -> Result<(), BenchError> {
        let binding = self
            .binding
            .as_ref()
            .ok_or_else(|| failed(NAME, "nothing is bound"))?;
        self.session
            .run_binding(binding)
            .map_err(|error| failed(NAME, error))?;
        Ok(())
    }

    fn read(&self, output: usize, to: &mut [f32]) -> Result<(), BenchError> {
        let value = self
            .outputs
            .get(output)
            .ok_or_else(|| failed(NAME, "no such output"))?;
        let (_, values) = value
            .try_extract_tensor::<f32>()
            .map_err(|error| failed(NAME, error))?;
        to.copy_from_slice(values);
        Ok(())
    }

    fn outputs(&self) -> Result<Vec<(String, Tensor)>, BenchError> {
        let named = self.session.outputs().iter().zip(&self.outputs);
        let read = |value: &DynValue| -> ort::Result<Tensor> {
            if let Ok((shape, values)) = value.try_extract_tensor::<f32>() {
                let shape = shape.iter().map(|&axis| axis as usize).collect();
                return Ok(Tensor {
                    shape,
                    data: Data::F32(values.to_vec()),
                });
            }
            let (shape, values) = value.try_extract_tensor::<i64>()?;
            let shape = shape.iter().map(|&axis| axis as usize).collect();
            Ok(Tensor {
                shape,
                data: Data::I64(values.to_vec()),
            })
        };
        named
            .map(|(outlet, value)| {
                let tensor = read(value).map_err(|error| failed(NAME, error))?;
                Ok((outlet.name().to_owned(), tensor))
            })
            .collect()
    }

    fn input_names(&self) -> Vec<String> {
        self.session
            .inputs()
            .iter()
            .map(|outlet| outlet.name().to_owned())
            .collect()
    }

    fn output_names(&self) -> Vec<String> {
        self.session
            .outputs()
            .iter()
            .map(|outlet| outlet.name().to_owned())
            .collect()
    }
}
