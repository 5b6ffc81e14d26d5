//! Constants, and conversions between number types.

use std::sync::Arc;

use lads_image::op::UnaryKind;
use lads_kernels::stored;

use super::Operands;
use super::arithmetic::number;
use super::attributes::Attributes;
use super::logic::is_set;
use super::operators::Outputs;
use super::shapes::wanted;
use crate::graph::{Dim, Graph, Id, Type, Unary};
use crate::onnx::data_type;
use crate::tensor::{Data, MAX_ELEMENTS, Tensor};

/// Converts to another type: constants are rounded to fewer bits; computed values keep 32 bits. All
/// integer types are wide enough for what a policy counts.
pub(super) fn cast(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    use data_type::{
        BFLOAT16, BOOL, DOUBLE, FLOAT, FLOAT16, INT8, INT16, INT32, INT64, UINT8, UINT16, UINT32,
        name,
    };
    let value = x.get(0)?;
    let to = i32::try_from(a.int("to", 0)?).unwrap_or(0);
    a.only("saturate", 1)?;
    let range = match to {
        FLOAT | DOUBLE => return number(g, value).map(|y| vec![y]),
        FLOAT16 => return rounded(g, value, |x| stored::from_f16(stored::round_to_f16(x))),
        BFLOAT16 => {
            return rounded(g, value, |x| {
                stored::to_bf16(x).map_or(x, stored::from_bf16)
            });
        }
        BOOL => {
            let number = number(g, value)?;
            return is_set(g, number).map(|y| vec![y]);
        }
        UINT8 => 0..=255,
        INT8 => -128..=127,
        UINT16 => 0..=65535,
        INT16 => -32768..=32767,
        UINT32 => 0..=i64::from(u32::MAX),
        INT32 | INT64 => i64::MIN..=i64::MAX,
        _ => return Err(format!("to {} is not supported", name(to))),
    };
    let Some(tensor) = g.constant(value).cloned() else {
        if !matches!(to, INT32 | INT64) {
            return Err(format!("to {} is supported for constants only", name(to)));
        }
        return match g.ty(value) {
            Type::I64 => Ok(vec![value]),
            Type::F32 => g.unary(Unary::of(UnaryKind::Trunc), value).map(|y| vec![y]),
        };
    };
    let integers: Vec<i64> = match &tensor.data {
        Data::I64(data) => data.clone(),
        Data::F32(data) => data.iter().map(|&x| x as i64).collect(),
    };
    if let Some(beyond) = integers.iter().find(|x| !range.contains(x)) {
        return Err(format!("to {} loses bits of {beyond}", name(to)));
    }
    Ok(vec![
        g.add_const(Arc::new(Tensor::i64(&tensor.shape, integers))),
    ])
}

fn rounded(g: &mut Graph, x: Id, round: impl Fn(f32) -> f32) -> Outputs {
    let number = number(g, x)?;
    let Some(tensor) = g.constant(number) else {
        return Ok(vec![number]);
    };
    let data = tensor.as_f32().unwrap_or_default();
    let data = data.iter().map(|&x| round(x)).collect();
    let tensor = Tensor::f32(&tensor.shape, data);
    Ok(vec![g.add_const(Arc::new(tensor))])
}

/// Makes the constant `start, start + delta, ..` below `limit`.
pub(super) fn range(g: &mut Graph, x: &Operands) -> Outputs {
    let mut ends = vec![];
    for i in 0..3 {
        let tensor = g.constant(x.get(i)?).cloned();
        ends.push(
            tensor
                .filter(|tensor| tensor.len() == 1)
                .ok_or("needs three constants")?,
        );
    }
    let most = |count: f64| {
        let count = count.ceil().max(0.0);
        (count <= MAX_ELEMENTS as f64)
            .then_some(count as usize)
            .ok_or("has too many elements")
    };
    let tensor = match (&ends[0].data, &ends[1].data, &ends[2].data) {
        (Data::I64(start), Data::I64(limit), Data::I64(delta)) => {
            let (start, limit, delta) = (start[0], limit[0], delta[0]);
            let whole = (limit as f64 - start as f64) / delta as f64;
            let count = most(whole)?;
            let at = |i| start.saturating_add(delta.saturating_mul(i as i64));
            Tensor::i64(&[count], (0..count).map(at).collect())
        }
        (Data::F32(start), Data::F32(limit), Data::F32(delta)) => {
            let (start, limit, delta) = (start[0], limit[0], delta[0]);
            let count = most((f64::from(limit) - f64::from(start)) / f64::from(delta))?;
            let at = |i| start + i as f32 * delta;
            Tensor::f32(&[count], (0..count).map(at).collect())
        }
        _ => return Err("mixes numbers and integers".into()),
    };
    if tensor.len() == 0 {
        return Err("has no elements".into());
    }
    Ok(vec![g.add_const(Arc::new(tensor))])
}

/// Makes a matrix of the input's shape with ones on a diagonal.
pub(super) fn eye_like(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let shape = g.known_shape(x.get(0)?).unwrap_or_default();
    let &[rows, cols] = &shape[..] else {
        return Err("needs a matrix of static shape".into());
    };
    let diagonal = a.int("k", 0)?;
    let whole = match a.int("dtype", i64::from(data_type::FLOAT))? as i32 {
        data_type::INT32 | data_type::INT64 => true,
        data_type::FLOAT | data_type::FLOAT16 | data_type::DOUBLE | data_type::BOOL => false,
        other => return Err(format!("of {} is not supported", data_type::name(other))),
    };
    let on = |i: usize| (i % cols) as i64 == (i / cols) as i64 + diagonal;
    let all = 0..rows * cols;
    let tensor = if whole {
        Tensor::i64(&shape, all.map(|i| i64::from(on(i))).collect())
    } else {
        Tensor::f32(&shape, all.map(|i| f32::from(u8::from(on(i)))).collect())
    };
    Ok(vec![g.add_const(Arc::new(tensor))])
}

pub(super) fn constant(g: &mut Graph, a: &Attributes) -> Outputs {
    let tensor = if let Some(tensor) = a.tensor("value")? {
        tensor
    } else if let Some(values) = a.floats("value_floats")? {
        Arc::new(Tensor::f32(&[values.len()], values.to_vec()))
    } else if let Some(values) = a.ints("value_ints")? {
        Arc::new(Tensor::i64(&[values.len()], values.to_vec()))
    } else {
        let (float, int) = (
            a.float("value_float", f32::NAN)?,
            a.int("value_int", i64::MIN)?,
        );
        match (float.is_nan(), int) {
            (false, _) => Arc::new(Tensor::scalar(float)),
            (true, i64::MIN) => return Err("has no value that is supported".into()),
            (true, int) => Arc::new(Tensor::i64(&[], vec![int])),
        }
    };
    Ok(vec![g.add_const(tensor)])
}

pub(super) fn filled(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let shape = wanted(g, x.get(0)?)?;
    let shape: Option<Vec<usize>> = shape.iter().map(|&dim| usize::try_from(dim).ok()).collect();
    let shape = shape.filter(|shape| crate::tensor::elements(shape).is_some());
    let shape = shape.ok_or_else(|| format!("needs a shape of at most {MAX_ELEMENTS} elements"))?;
    let value = a
        .tensor("value")?
        .unwrap_or_else(|| Arc::new(Tensor::f32(&[1], vec![0.0])));
    let id = g.add_const(value);
    let dims: Vec<Dim> = shape.iter().map(|&dim| Dim::of(dim)).collect();
    let single = g.reshape(id, &[])?;
    g.expand(single, &dims).map(|y| vec![y])
}
