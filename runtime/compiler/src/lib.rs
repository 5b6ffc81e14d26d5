//! Compiles an ONNX bundle to a program image.
//!
//! ```text
//! bundle ─► family ─► import ─► graph ─► fuse ─► lower ─► plan ─► verify ─► image
//! ```
//!
//! A [`Bundle`] is one ONNX file that holds a whole policy: the entry graphs, a contract and a
//! golden episode. [`compile`] turns it into an [`Image`] that `lads-core` runs without allocating.
//! The crate runs on the host and may allocate; its input may be hostile, so every error is a value
//! that names the thing and the remedy.
//!
//! Operators of the default ONNX domain that are compiled (operator sets 7 to 28, each by the rules
//! of its set); anything else is an error that names the operator, the node and the entry:
//!
//! ```text
//! Abs Add And ArgMax ArgMin AveragePool BatchNormalization Cast Celu Clip Concat ConcatFromSequence Constant ConstantOfShape Conv
//! Div Dropout Einsum Elu Equal Erf Exp Expand EyeLike Flatten GRU Gather GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool
//! Greater GreaterOrEqual GroupNormalization HardSigmoid HardSwish Identity InstanceNormalization LSTM LayerNormalization LeakyRelu
//! Less LessOrEqual Log LogSoftmax MatMul Max MaxPool Min Mish Mul Neg Not Or PRelu Pad Pow RMSNormalization Range Reciprocal
//! ReduceL1 ReduceL2 ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Resize ScatterND Selu
//! SequenceAt SequenceConstruct SequenceEmpty SequenceInsert SequenceLength Shape Sigmoid Size Slice Softmax Softplus Softsign
//! Split SplitToSequence Sqrt Squeeze Sub Sum Swish Tanh ThresholdedRelu Tile Transpose Unsqueeze Where Xor
//! ```
//!
//! A program computes with 32-bit floats, whatever width the file's numbers have: constants are
//! rounded as the file states, computed values keep 32 bits. Integers are indices, or whole numbers
//! exact up to 2^24; truth values are numbers that are 0 or 1. Shapes are static. GRU and LSTM over
//! several steps are unrolled, 512 at most.
//!
#![doc = include_str!("../README.md")]
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
mod storage;
mod survey;
mod tensor;
mod verify;

#[cfg(test)]
mod tests;

pub use bundle::Bundle;
pub use compile::{Options, compile, compile_with, words};
pub use contract::Contract;
pub use digest::sha256;
pub use error::{BundleError, CompileError, Line};
pub use golden::Golden;
pub use image::Image;
pub use import::OPSETS;
pub use lads_image::op::{CacheFormat, WeightFormat};
pub use reference::Reference;
pub use report::{CompileReport, LayerReport, ProgramReport};
pub use storage::{Evidence, Formats, Storage, Tuned, named};
pub use survey::{Field, Missing, Operand, Operator, Survey, Value, survey};
pub use verify::PlanFault;
