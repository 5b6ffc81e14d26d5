//! Interface of a general runtime: it loads one ONNX model, and runs it again and again on inputs that stay where they are.

use lads_pace::BenchError;

use super::cut::Tensor;

/// Tensors with their names.
pub type Named<'t> = [(String, &'t Tensor)];

/// A general runtime.
pub trait Engine {
    /// Name of the runtime in tables.
    fn name(&self) -> &'static str;

    /// Version and settings of the runtime, for the report.
    fn detail(&self) -> String;

    /// Loads a model.
    fn load(&self, model: &[u8]) -> Result<Box<dyn Session>, BenchError>;
}

/// A loaded model.
pub trait Session {
    /// Places the inputs and, where the runtime can, the outputs in memory that all following calls use.
    fn bind(&mut self, inputs: &Named) -> Result<(), BenchError>;

    /// Overwrites a bound input of floating-point numbers, by its place among the model's inputs.
    fn write(&mut self, input: usize, values: &[f32]) -> Result<(), BenchError>;

    /// Overwrites a bound input of one integer.
    fn write_integer(&mut self, input: usize, value: i64) -> Result<(), BenchError>;

    /// Runs the model on the bound inputs.
    fn call(&mut self) -> Result<(), BenchError>;

    /// Copies an output of the last call, by its place among the model's outputs.
    fn read(&self, output: usize, to: &mut [f32]) -> Result<(), BenchError>;

    /// All outputs of the last call, by name.
    fn outputs(&self) -> Result<Vec<(String, Tensor)>, BenchError>;

    /// Names of the model's inputs, in its order.
    fn input_names(&self) -> Vec<String>;

    /// Names of the model's outputs, in its order.
    fn output_names(&self) -> Vec<String>;
}

/// Finds the tensor for an input of a model.
pub fn given<'t>(inputs: &Named<'t>, wanted: &str) -> Result<&'t Tensor, String> {
    inputs
        .iter()
        .find(|(name, _)| name == wanted)
        .map(|(_, tensor)| *tensor)
        .ok_or_else(|| format!("no value for input {wanted}"))
}

/// Makes an error of a runtime, in one line.
pub fn failed(engine: &str, error: impl std::fmt::Display) -> BenchError {
    BenchError::new(engine, error, "leave this peer out or fix its installation")
}
