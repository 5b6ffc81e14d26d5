//! Dense kernels for batch-1 policies, on slices and shapes, independent of ONNX and LADS.
//!
//! Invariants:
//! - No allocation, no `std`, no panic, and no unsafe code but in `dispatch`, `simd`, `subnormal`
//!   and the loops over weights, cache and images: a slice that is too short leaves the rest of the
//!   result unchanged. Callers that need an error check shapes beforehand; `lads-image` does so
//!   once per program.
//! - Results have the same bits on every target with IEEE 754 arithmetic, except for subnormal
//!   numbers under [`flushed`]: every sum has one fixed order (sixteen lanes, then a tree; outputs
//!   of layers and images in the order of their inputs), no multiply-add is fused, and `exp`,
//!   `tanh` and `sigmoid` are the polynomials of [`math`].
//! - Inner loops run over blocks of sixteen elements: plain Rust that compilers vectorise, or the
//!   vectors of `simd` where a control step spends its time. Those kernels are compiled once per
//!   instruction set and take an [`Isa`], which selects the one to run.
//!
//! [`mod@reference`] holds the naive twin of every kernel; `tests/twins.rs` compares them on random shapes.
//!
#![doc = include_str!("../README.md")]
#![no_std]
#![deny(unsafe_code)]
#![allow(
    clippy::inline_always,
    reason = "the loops vectorise once their bodies are inlined into the shape's caller"
)]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic
    )
)]

mod attention;
mod cache;
mod conv;
mod conv_integers;
mod depthwise;
mod dispatch;
mod elementwise;
mod ending;
mod floats;
mod image_integers;
mod integers;
mod lanes;
mod linear;
pub mod math;
mod matmul;
mod norm;
mod pool;
mod reduce;
pub mod reference;
mod resize;
mod simd;
pub mod stored;
mod strided;
mod subnormal;

pub use attention::{Attention, attention_scratch_len};
pub use cache::{Append, Cache, CacheFormat, CacheMut, Scaled, ScaledMut, keys_len};
pub use conv::{Conv, Sweep, conv_pack, conv_packed_len};
pub use conv_integers::{IntegerConv, conv_integers_len, conv_integers_pack, conv_scale};
pub use depthwise::{Depthwise, depthwise_pack, depthwise_packed_len};
pub use dispatch::Isa;
pub use elementwise::{Unary, UnaryKind, assign};
pub use image_integers::ImageIntegers;
pub use linear::{Activation, Linear, PANEL, pack, packed_len, packed_rows};
pub use matmul::MatMul;
pub use norm::{LayerNorm, softmax};
pub use pool::{Pool, PoolKind};
pub use reduce::{Axis, ReduceKind, arg_max, arg_min, reduce};
pub use resize::Resize;
pub use stored::{Panels, WeightFormat};
pub use strided::{BinaryKind, Input, StridedCopy, binary};
pub use subnormal::flushed;
