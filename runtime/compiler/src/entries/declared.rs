//! Types and shapes of values as a graph declares them.

use crate::graph::{Dim, Type};
use crate::onnx::{TensorTypeProto, ValueInfoProto, data_type};

/// Reads the type and shape that a value declares: symbolic axes must be called `P` or `P+n`.
pub(super) fn declaration(value: &ValueInfoProto) -> Result<(Type, Vec<Dim>), String> {
    let name = &value.name;
    let tensor = value.r#type.as_ref().and_then(|ty| ty.tensor_type.as_ref());
    let tensor = tensor.ok_or_else(|| format!("{name} declares no tensor type"))?;
    let ty = elements(tensor.elem_type).ok_or_else(|| {
        format!(
            "{name} has elements of {}, which no channel and no state has",
            data_type::name(tensor.elem_type)
        )
    })?;
    let shape = shape_of(tensor).ok_or_else(|| {
        format!("{name} declares no shape that can be read (the only symbolic axis is `P`)")
    })?;
    Ok((ty, shape))
}

/// Returns the type in which the compiler reads elements of an ONNX type; `None` for one that it does
/// not read. Bytes and small integers come as numbers, which the graph casts, and so do floats of
/// other widths and truth values.
pub(crate) fn elements(elem_type: i32) -> Option<Type> {
    match elem_type {
        data_type::FLOAT
        | data_type::FLOAT16
        | data_type::BFLOAT16
        | data_type::DOUBLE
        | data_type::BOOL
        | data_type::UINT8 => Some(Type::F32),
        data_type::INT64 | data_type::INT32 => Some(Type::I64),
        _ => None,
    }
}

fn shape_of(tensor: &TensorTypeProto) -> Option<Vec<Dim>> {
    let dims = tensor.shape.as_ref()?.dim.iter();
    dims.map(|dim| match (&dim.dim_value, &dim.dim_param) {
        (Some(len), _) => usize::try_from(*len).ok().map(Dim::of),
        (None, Some(text)) => past(text),
        (None, None) => None,
    })
    .collect()
}

/// Returns the length that a symbolic axis stands for: `P`, the rows of the cache, or `P+n`.
pub(crate) fn past(name: &str) -> Option<Dim> {
    let rest = name.strip_prefix('P')?;
    let added = rest
        .trim()
        .strip_prefix('+')
        .map_or_else(|| rest.is_empty().then_some(0), |n| n.trim().parse().ok());
    added.map(Dim::past)
}
