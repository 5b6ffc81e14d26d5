//! ONNX bundle to program image.
#![forbid(unsafe_code)]
