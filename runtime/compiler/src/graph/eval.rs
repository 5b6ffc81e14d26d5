//! What a node computes, in the plainest way: folds constants. `None` means that the node cannot be folded, never that it is wrong.

use std::sync::Arc;

use lads_image::op::{BinaryKind, ReduceKind, UnaryKind};

use super::{Op, Unary};
use crate::tensor::{Data, Tensor, strides};

/// The most operations that folding the constants of one entry may take. A policy's take some hundred thousands; a small model could
/// ask for hours and for all memory.
pub(crate) const MAX_FOLDING: usize = 1 << 26;

/// How many elements are read or made to evaluate a node.
pub(crate) fn cost(op: &Op, x: &[Arc<Tensor>], shape: &[usize]) -> usize {
    let made: usize = shape.iter().product();
    let each = match op {
        Op::MatMul => x[0].shape.last().copied().unwrap_or(1),
        Op::Reduce(_, axis) => x[0].shape.get(*axis).copied().unwrap_or(1),
        _ => 1,
    };
    made.saturating_mul(each)
}

/// The value of a node whose operands are constants; `shape` is its shape.
pub(crate) fn evaluate(op: &Op, x: &[Arc<Tensor>], shape: &[usize]) -> Option<Tensor> {
    match op {
        Op::Reshape => Some(Tensor {
            shape: shape.to_vec(),
            data: x[0].data.clone(),
        }),
        Op::Transpose(perm) => {
            let from = strides(&x[0].shape);
            let turned: Vec<usize> = perm.iter().map(|&axis| from[axis]).collect();
            Some(gathered(&x[0], shape, &turned, 0))
        }
        Op::Slice { axis, start } => {
            let from = strides(&x[0].shape);
            Some(gathered(&x[0], shape, &from, start * from[*axis]))
        }
        Op::Expand => Some(gathered(
            &x[0],
            shape,
            &broadcast_strides(&x[0].shape, shape),
            0,
        )),
        Op::Concat { axis } => concat(x, *axis, shape),
        Op::Binary(kind) => binary(kind.0, &x[0], &x[1], shape),
        Op::Unary(unary) => {
            let y = x[0].as_f32()?.iter().map(|&x| apply(*unary, x)).collect();
            Some(Tensor::f32(shape, y))
        }
        Op::Reduce(kind, axis) => reduce(kind.0, &x[0], *axis, shape),
        Op::MatMul => matmul(&x[0], &x[1], shape),
        Op::ToIndex => {
            let integers = x[0].as_f32()?.iter().map(|&x| x as i64).collect();
            Some(Tensor::i64(shape, integers))
        }
        Op::FromIndex => {
            let numbers = x[0].as_i64()?.iter().map(|&x| x as f32).collect();
            Some(Tensor::f32(shape, numbers))
        }
        Op::GatherRow => {
            let &[index] = x[1].as_i64()? else {
                return None;
            };
            let rows = *x[0].shape.first()?;
            let index = usize::try_from(index).ok().filter(|&index| index < rows)?;
            Some(gathered(
                &x[0],
                shape,
                &strides(&x[0].shape)[1..],
                index * strides(&x[0].shape)[0],
            ))
        }
        _ => None,
    }
}

/// Calls `f` with the offset of each element, in row-major order of `shape`.
fn each(shape: &[usize], strides: &[usize], offset: usize, f: &mut impl FnMut(usize)) {
    match (shape, strides) {
        (&[dim, ref shape @ ..], &[stride, ref strides @ ..]) => {
            for i in 0..dim {
                each(shape, strides, offset + i * stride, f);
            }
        }
        _ => f(offset),
    }
}

fn gathered(x: &Tensor, shape: &[usize], strides: &[usize], offset: usize) -> Tensor {
    fn pick<T: Copy>(x: &[T], shape: &[usize], strides: &[usize], offset: usize) -> Vec<T> {
        let mut y = Vec::with_capacity(shape.iter().product());
        each(shape, strides, offset, &mut |at| y.push(x[at]));
        y
    }
    let data = match &x.data {
        Data::F32(x) => Data::F32(pick(x, shape, strides, offset)),
        Data::I64(x) => Data::I64(pick(x, shape, strides, offset)),
    };
    Tensor {
        shape: shape.to_vec(),
        data,
    }
}

/// Strides of `from` when read with shape `to`: 0 where it broadcasts.
fn broadcast_strides(from: &[usize], to: &[usize]) -> Vec<usize> {
    let own = strides(from);
    let missing = to.len() - from.len();
    (0..to.len())
        .map(|i| {
            i.checked_sub(missing)
                .map_or(0, |i| if from[i] == 1 { 0 } else { own[i] })
        })
        .collect()
}

fn concat(parts: &[Arc<Tensor>], axis: usize, shape: &[usize]) -> Option<Tensor> {
    let outer: usize = shape[..axis].iter().product();
    let chunk = |x: &Tensor| x.shape[axis..].iter().product::<usize>();
    let data = if matches!(parts[0].data, Data::F32(_)) {
        let mut y = vec![];
        for o in 0..outer {
            for part in parts {
                y.extend_from_slice(part.as_f32()?.get(o * chunk(part)..(o + 1) * chunk(part))?);
            }
        }
        Data::F32(y)
    } else {
        let mut y = vec![];
        for o in 0..outer {
            for part in parts {
                y.extend_from_slice(part.as_i64()?.get(o * chunk(part)..(o + 1) * chunk(part))?);
            }
        }
        Data::I64(y)
    };
    Some(Tensor {
        shape: shape.to_vec(),
        data,
    })
}

fn binary(kind: BinaryKind, a: &Tensor, b: &Tensor, shape: &[usize]) -> Option<Tensor> {
    let a = gathered(a, shape, &broadcast_strides(&a.shape, shape), 0);
    let b = gathered(b, shape, &broadcast_strides(&b.shape, shape), 0);
    match (&a.data, &b.data) {
        (Data::F32(a), Data::F32(b)) => {
            let f = |(&a, &b): (&f32, &f32)| match kind {
                BinaryKind::Add => a + b,
                BinaryKind::Sub => a - b,
                BinaryKind::Mul => a * b,
                BinaryKind::Div => a / b,
                BinaryKind::Max => a.max(b),
                BinaryKind::Min => a.min(b),
                BinaryKind::Pow => a.powf(b),
                BinaryKind::Greater => f32::from(u8::from(a > b)),
                BinaryKind::Keep if b == 0.0 => 0.0,
                BinaryKind::Keep => a,
            };
            Some(Tensor::f32(shape, a.iter().zip(b).map(f).collect()))
        }
        (Data::I64(a), Data::I64(b)) => {
            let f = |(&a, &b): (&i64, &i64)| match kind {
                BinaryKind::Add => a.checked_add(b),
                BinaryKind::Sub => a.checked_sub(b),
                BinaryKind::Mul => a.checked_mul(b),
                BinaryKind::Div => a.checked_div(b),
                BinaryKind::Max => Some(a.max(b)),
                BinaryKind::Min => Some(a.min(b)),
                BinaryKind::Greater => Some(i64::from(a > b)),
                BinaryKind::Pow | BinaryKind::Keep => None,
            };
            let y: Option<Vec<i64>> = a.iter().zip(b).map(f).collect();
            Some(Tensor::i64(shape, y?))
        }
        _ => None,
    }
}

/// One element of a [`Unary`].
pub(crate) fn apply(unary: Unary, x: f32) -> f32 {
    match unary.kind.0 {
        UnaryKind::Relu => x.max(0.0),
        UnaryKind::LeakyRelu => {
            if x < 0.0 {
                f32::from_bits(unary.alpha) * x
            } else {
                x
            }
        }
        UnaryKind::Tanh => x.tanh(),
        UnaryKind::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        UnaryKind::Exp => x.exp(),
        UnaryKind::Log => x.ln(),
        UnaryKind::Sqrt => x.sqrt(),
        UnaryKind::Rsqrt => 1.0 / x.sqrt(),
        UnaryKind::Neg => -x,
        UnaryKind::Abs => x.abs(),
        UnaryKind::Recip => 1.0 / x,
        UnaryKind::Erf => lads_kernels::math::erf(x),
        UnaryKind::Square => x * x,
        UnaryKind::Elu if x < 0.0 => f32::from_bits(unary.alpha) * x.exp_m1(),
        UnaryKind::Elu => x,
        UnaryKind::Softplus => x.max(0.0) + (-x.abs()).exp().ln_1p(),
        UnaryKind::Mish => x * (x.max(0.0) + (-x.abs()).exp().ln_1p()).tanh(),
        UnaryKind::Trunc => x.trunc(),
    }
}

fn reduce(kind: ReduceKind, x: &Tensor, axis: usize, shape: &[usize]) -> Option<Tensor> {
    let data = x.as_f32()?;
    let len = x.shape[axis];
    let inner: usize = x.shape[axis + 1..].iter().product();
    let outer: usize = x.shape[..axis].iter().product();
    let mut y = Vec::with_capacity(outer * inner);
    for o in 0..outer {
        for i in 0..inner {
            let row = (0..len).map(|a| data[(o * len + a) * inner + i]);
            y.push(match kind {
                ReduceKind::Sum => row.sum(),
                ReduceKind::Mean => row.sum::<f32>() / len as f32,
                ReduceKind::Max => row.fold(f32::NEG_INFINITY, f32::max),
                ReduceKind::Min => row.fold(f32::INFINITY, f32::min),
                ReduceKind::Prod => row.product(),
            });
        }
    }
    Some(Tensor::f32(shape, y))
}

fn matmul(a: &Tensor, b: &Tensor, shape: &[usize]) -> Option<Tensor> {
    let (batch, &[m, n]) = shape.split_last_chunk::<2>()?;
    let k = *a.shape.last()?;
    let (da, db) = (a.as_f32()?, b.as_f32()?);
    let matrices = |x: &Tensor, rows: usize, cols: usize| {
        let mut offsets = vec![];
        let lead = &x.shape[..x.shape.len() - 2];
        let steps: Vec<usize> = broadcast_strides(lead, batch)
            .iter()
            .map(|stride| stride * rows * cols)
            .collect();
        each(batch, &steps, 0, &mut |at| offsets.push(at));
        offsets
    };
    let mut y = Vec::with_capacity(shape.iter().product());
    for (a, b) in matrices(a, m, k).into_iter().zip(matrices(b, k, n)) {
        for i in 0..m {
            for j in 0..n {
                y.push((0..k).map(|l| da[a + i * k + l] * db[b + l * n + j]).sum());
            }
        }
    }
    Some(Tensor::f32(shape, y))
}
