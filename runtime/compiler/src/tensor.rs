//! Constant tensors: initializers and the results of constant folding.
//!
//! Invariant: the number of elements is the product of the shape.

use std::sync::Arc;

use lads_kernels::stored;

use crate::onnx::{TensorProto, data_type};

/// Largest number of elements of an initializer or a folded constant: 256 MiB of `f32`.
pub(crate) const MAX_ELEMENTS: usize = 1 << 26;

/// Largest number of axes of a value.
pub(crate) const MAX_RANK: usize = 8;

/// Elements of a constant.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Data {
    F32(Vec<f32>),
    I64(Vec<i64>),
}

/// Constant tensor.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tensor {
    pub shape: Vec<usize>,
    pub data: Data,
}

/// Returns the number of elements of a shape, if it is not beyond [`MAX_ELEMENTS`].
pub(crate) fn elements(shape: &[usize]) -> Option<usize> {
    let product = shape
        .iter()
        .try_fold(1usize, |product, &dim| product.checked_mul(dim))?;
    (product <= MAX_ELEMENTS).then_some(product)
}

/// Returns the strides of a contiguous layout.
pub(crate) fn strides(shape: &[usize]) -> Vec<usize> {
    let mut strides = vec![1; shape.len()];
    for i in (1..shape.len()).rev() {
        strides[i - 1] = strides[i] * shape[i];
    }
    strides
}

impl Tensor {
    pub fn f32(shape: &[usize], data: Vec<f32>) -> Self {
        debug_assert_eq!(shape.iter().product::<usize>(), data.len());
        Self {
            shape: shape.to_vec(),
            data: Data::F32(data),
        }
    }

    pub fn i64(shape: &[usize], data: Vec<i64>) -> Self {
        debug_assert_eq!(shape.iter().product::<usize>(), data.len());
        Self {
            shape: shape.to_vec(),
            data: Data::I64(data),
        }
    }

    pub fn scalar(value: f32) -> Self {
        Self::f32(&[], vec![value])
    }

    pub fn as_f32(&self) -> Option<&[f32]> {
        match &self.data {
            Data::F32(data) => Some(data),
            Data::I64(_) => None,
        }
    }

    pub fn as_i64(&self) -> Option<&[i64]> {
        match &self.data {
            Data::I64(data) => Some(data),
            Data::F32(_) => None,
        }
    }

    /// Returns the number of elements.
    pub fn len(&self) -> usize {
        match &self.data {
            Data::F32(data) => data.len(),
            Data::I64(data) => data.len(),
        }
    }

    /// Returns the value of all elements, if they are equal.
    pub fn uniform(&self) -> Option<f32> {
        let data = self.as_f32()?;
        let &first = data.first()?;
        data.iter()
            .all(|x| x.to_bits() == first.to_bits())
            .then_some(first)
    }

    /// Reads a tensor of a model file. The error describes the fault.
    pub fn from_proto(proto: &TensorProto) -> Result<Arc<Self>, String> {
        if proto.data_location != 0 || !proto.external_data.is_empty() {
            return Err(
                "its elements are in another file; export one file with the weights inside".into(),
            );
        }
        if proto.segment.is_some() {
            return Err("it is split into segments".into());
        }
        let shape: Option<Vec<usize>> = proto
            .dims
            .iter()
            .map(|&dim| usize::try_from(dim).ok())
            .collect();
        let (shape, len) = shape
            .filter(|shape| shape.len() <= MAX_RANK)
            .and_then(|shape| elements(&shape).map(|len| (shape, len)))
            .ok_or_else(|| format!("its shape is negative, larger than {MAX_ELEMENTS} elements or has more than {MAX_RANK} axes"))?;
        let data = elements_of(proto)?;
        let tensor = Self { shape, data };
        if tensor.len() != len {
            return Err(format!(
                "its shape {:?} needs {len} elements, it has {}",
                tensor.shape,
                tensor.len()
            ));
        }
        Ok(Arc::new(tensor))
    }
}

/// Returns the elements of a tensor: floats of all widths as `f32`, integers as `i64`, truth values
/// as 0 and 1.
fn elements_of(proto: &TensorProto) -> Result<Data, String> {
    use data_type::{
        BFLOAT16, BOOL, DOUBLE, FLOAT, FLOAT16, INT8, INT16, INT32, INT64, UINT8, name,
    };
    let raw = &proto.raw_data;
    let small = &proto.int32_data;
    // Of 16 bits, and so kept in the lower half of 32.
    let halves = || small.iter().map(|&x| x as u16);
    let (has_raw, kind) = (!raw.is_empty(), proto.data_type);
    Ok(match kind {
        FLOAT if has_raw => Data::F32(words(raw, f32::from_le_bytes)?),
        FLOAT => Data::F32(proto.float_data.clone()),
        FLOAT16 if has_raw => Data::F32(words(raw, |word| {
            stored::from_f16(u16::from_le_bytes(word))
        })?),
        FLOAT16 => Data::F32(halves().map(stored::from_f16).collect()),
        BFLOAT16 if has_raw => Data::F32(words(raw, |word| {
            stored::from_bf16(u16::from_le_bytes(word))
        })?),
        BFLOAT16 => Data::F32(halves().map(stored::from_bf16).collect()),
        DOUBLE if has_raw => singles(words(raw, f64::from_le_bytes)?)?,
        DOUBLE => singles(proto.double_data.clone())?,
        INT64 if has_raw => Data::I64(words(raw, i64::from_le_bytes)?),
        INT64 => Data::I64(proto.int64_data.clone()),
        INT32 if has_raw => Data::I64(words(raw, |word| i64::from(i32::from_le_bytes(word)))?),
        INT16 if has_raw => Data::I64(words(raw, |word| i64::from(i16::from_le_bytes(word)))?),
        UINT8 if has_raw => Data::I64(raw.iter().map(|&x| i64::from(x)).collect()),
        INT8 if has_raw => Data::I64(words(raw, |word| i64::from(i8::from_le_bytes(word)))?),
        INT32 | INT16 | UINT8 | INT8 => Data::I64(small.iter().map(|&x| i64::from(x)).collect()),
        BOOL if has_raw => Data::F32(raw.iter().map(|&x| f32::from(u8::from(x != 0))).collect()),
        BOOL => Data::F32(small.iter().map(|&x| f32::from(u8::from(x != 0))).collect()),
        other => {
            return Err(format!(
                "its elements are {}; supported are floats, bool and integers up to int64",
                name(other)
            ));
        }
    })
}

/// Rounds doubles to `f32`.
fn singles(doubles: Vec<f64>) -> Result<Data, String> {
    let lost = |x: f64| x.is_finite() && !(x as f32).is_finite();
    if let Some(x) = doubles.iter().find(|&&x| lost(x)) {
        return Err(format!("its element {x:e} is beyond 32-bit floats"));
    }
    Ok(Data::F32(doubles.into_iter().map(|x| x as f32).collect()))
}

/// Reads little-endian words.
fn words<T, const N: usize>(raw: &[u8], read: impl Fn([u8; N]) -> T) -> Result<Vec<T>, String> {
    let (words, rest) = raw.as_chunks::<N>();
    if !rest.is_empty() {
        return Err(format!(
            "it has {} bytes, which is not a whole number of elements",
            raw.len()
        ));
    }
    Ok(words.iter().copied().map(read).collect())
}
