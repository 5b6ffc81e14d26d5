//! What users would pick instead of lads, on the very same graphs.
//!
//! ONNX Runtime, tract and rten run in this process; PyTorch and OpenVINO in Python, in a worker that keeps to the same
//! protocol. Only with the cargo feature `peers`.

pub mod cut;
pub mod engine;
pub mod general;
pub mod onnxruntime;
pub mod recompute;
pub mod rten;
pub mod tract;
pub mod worker;
