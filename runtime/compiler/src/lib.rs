//! Compiles an ONNX bundle to a program image.
//!
//! ```text
//! bundle ─► family ─► import ─► graph ─► fuse ─► lower ─► plan ─► verify ─► image
//! ```
//!
//! A [`Bundle`] is one ONNX file that holds a whole policy: the entry graphs, a contract and a golden episode. [`compile`] makes it
//! an [`Image`] that `lads-core` runs without allocating. Runs on the host and may allocate; what it reads may be hostile, so
//! every error is a value that names the thing and the remedy.
//!
//! Operators of the default ONNX domain that are compiled (operator sets 13 to 21); anything else is an error that names the
//! operator, the node and the entry:
//!
//! ```text
//! Abs Add ArgMax ArgMin BatchNormalization Cast Clip Concat Constant ConstantOfShape Div Dropout Erf Exp Expand Flatten Gather
//! GRU Gelu Gemm Identity LSTM LayerNormalization LeakyRelu Log LogSoftmax MatMul Max Min Mul Neg Pow Reciprocal ReduceL1 ReduceL2
//! ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Shape Sigmoid Slice Softmax Split Sqrt
//! Squeeze Sub Sum Tanh Transpose Unsqueeze
//! ```
#![forbid(unsafe_code)]

mod aligned;
mod bundle;
mod compile;
pub mod contract;
mod digest;
mod entries;
mod error;
pub mod family;
mod fuse;
mod golden;
mod graph;
mod image;
mod import;
mod lower;
pub mod onnx;
mod plan;
mod reach;
mod reference;
mod report;
mod survey;
mod tensor;
mod verify;

#[cfg(test)]
mod tests;

pub use bundle::Bundle;
pub use compile::{Options, compile, compile_with};
pub use contract::Contract;
pub use digest::sha256;
pub use error::{BundleError, CompileError, Line};
pub use golden::Golden;
pub use image::Image;
pub use lads_image::op::{CacheFormat, WeightFormat};
pub use reference::Reference;
pub use report::{CompileReport, ProgramReport};
pub use survey::{Field, Missing, Operand, Operator, Survey, Value, survey};
pub use verify::PlanFault;
