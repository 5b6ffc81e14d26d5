//! Evaluates nodes in the plainest way, on `ndarray`: with numbers of 32 bits to fold constants,
//! with 64 to check compiled programs.
//!
//! `None` means that a node is not evaluated, never that it is wrong. Every sum goes from the first element to the last, so that a folded
//! constant has the same bits wherever it is folded.

mod images;

use std::iter::{Product, Sum};
use std::sync::Arc;

use lads_image::op::{BinaryKind, ReduceKind, UnaryKind};
use ndarray::{ArrayD, ArrayViewD, Axis, CowArray, Ix3, IxDyn, NdFloat, Slice, Zip, concatenate};

use super::{Op, Unary};
use crate::tensor::{Data, Tensor};

/// Largest number of operations that folding the constants of one entry may take. The constants of
/// a policy take some hundred thousands; a small model could ask for hours and for all memory.
pub(crate) const MAX_FOLDING: usize = 1 << 26;

/// Number type that nodes are evaluated with.
pub(crate) trait Real: NdFloat + Sum + Product {
    /// Converts a number of 32 bits.
    fn exact(x: f32) -> Self;

    /// Error function.
    fn erf(self) -> Self;

    /// Converts a count or an index.
    fn of(whole: i64) -> Self;

    /// Truncates to an integer.
    fn whole(self) -> i64;
}

impl Real for f32 {
    fn exact(x: f32) -> Self {
        x
    }

    fn erf(self) -> Self {
        lads_kernels::math::erf(self)
    }

    fn of(whole: i64) -> Self {
        whole as f32
    }

    fn whole(self) -> i64 {
        self as i64
    }
}

impl Real for f64 {
    fn exact(x: f32) -> Self {
        f64::from(x)
    }

    fn erf(self) -> Self {
        libm::erf(self)
    }

    fn of(whole: i64) -> Self {
        whole as f64
    }

    fn whole(self) -> i64 {
        self as i64
    }
}

/// Value of a node.
#[derive(Debug, Clone)]
pub(crate) enum Value<T> {
    Float(ArrayD<T>),
    Int(ArrayD<i64>),
}

/// Operand of a node.
#[derive(Debug, Clone)]
pub(crate) enum View<'v, T> {
    Float(ArrayViewD<'v, T>),
    Int(ArrayViewD<'v, i64>),
}

impl<T: Real> Value<T> {
    /// Converts a constant to these numbers.
    pub fn of(tensor: &Tensor) -> Option<Self> {
        Some(match View::of(tensor)? {
            View::Float(array) => Value::Float(array.mapv(T::exact)),
            View::Int(array) => Value::Int(array.to_owned()),
        })
    }

    pub fn view(&self) -> View<'_, T> {
        match self {
            Value::Float(array) => View::Float(array.view()),
            Value::Int(array) => View::Int(array.view()),
        }
    }
}

impl Value<f32> {
    fn into_tensor(self) -> Tensor {
        fn elements<E: Clone>(array: &ArrayD<E>) -> Vec<E> {
            array.as_standard_layout().iter().cloned().collect()
        }
        match self {
            Value::Float(array) => Tensor::f32(array.shape(), elements(&array)),
            Value::Int(array) => Tensor::i64(array.shape(), elements(&array)),
        }
    }
}

impl<'v> View<'v, f32> {
    fn of(tensor: &'v Tensor) -> Option<Self> {
        let shape = IxDyn(&tensor.shape);
        Some(match &tensor.data {
            Data::F32(data) => View::Float(ArrayViewD::from_shape(shape, data).ok()?),
            Data::I64(data) => View::Int(ArrayViewD::from_shape(shape, data).ok()?),
        })
    }
}

impl<'v, T> View<'v, T> {
    fn float(&self) -> Option<&ArrayViewD<'v, T>> {
        match self {
            View::Float(array) => Some(array),
            View::Int(_) => None,
        }
    }

    fn int(&self) -> Option<&ArrayViewD<'v, i64>> {
        match self {
            View::Float(_) => None,
            View::Int(array) => Some(array),
        }
    }
}

/// Returns all operands, if they are floats.
fn floats<'v, T: Clone>(x: &[View<'v, T>]) -> Option<Vec<ArrayViewD<'v, T>>> {
    x.iter().map(|x| x.float().cloned()).collect()
}

/// Returns the number of elements that are read or made to evaluate a node.
pub(crate) fn cost(op: &Op, x: &[Arc<Tensor>], shape: &[usize]) -> usize {
    let made: usize = shape.iter().product();
    let each = match op {
        Op::MatMul => x[0].shape.last().copied().unwrap_or(1),
        Op::Reduce(_, axis) => x[0].shape.get(*axis).copied().unwrap_or(1),
        Op::Conv(_) => x[1].shape.first().copied().unwrap_or(1),
        Op::Pool(_, windows) => windows.kernel[0].saturating_mul(windows.kernel[1]),
        _ => 1,
    };
    made.saturating_mul(each)
}

/// Evaluates a node whose operands are constants. Nodes whose result has other bits at run time,
/// and indices, are not folded.
pub(crate) fn fold(op: &Op, x: &[Arc<Tensor>], shape: &[usize]) -> Option<Tensor> {
    let left = matches!(
        op,
        Op::Softmax | Op::LayerNorm { .. } | Op::ArgMin | Op::ArgMax | Op::Shift(_)
    );
    if left {
        return None;
    }
    let x: Option<Vec<View<f32>>> = x.iter().map(|tensor| View::of(tensor)).collect();
    evaluate(op, &x?, shape).map(Value::into_tensor)
}

/// Evaluates a node; `shape` is its shape.
pub(crate) fn evaluate<T: Real>(op: &Op, x: &[View<T>], shape: &[usize]) -> Option<Value<T>> {
    let float = |i: usize| x.get(i)?.float();
    let value = match op {
        Op::Reshape
        | Op::Transpose(_)
        | Op::Slice { .. }
        | Op::Expand
        | Op::Concat { .. }
        | Op::GatherRow => {
            let row = x.get(1).and_then(|index| index.int()?.first().copied());
            return match x.first()? {
                View::Float(_) => {
                    let parts = floats(x);
                    let table = float(0).cloned().map(|table| vec![table]);
                    let parts = if *op == Op::GatherRow { table } else { parts };
                    moved(op, parts?, row, shape).map(Value::Float)
                }
                View::Int(_) => {
                    let parts: Option<Vec<_>> = x.iter().map(|x| x.int().cloned()).collect();
                    moved(op, parts?, row, shape).map(Value::Int)
                }
            };
        }
        Op::Binary(kind) => return binary(kind.0, x, shape),
        Op::Shift(by) => return Some(Value::Int(x.first()?.int()?.mapv(|x| x + by))),
        Op::ToIndex => return Some(Value::Int(float(0)?.mapv(T::whole))),
        Op::ArgMin | Op::ArgMax => {
            let index = best(float(0)?, *op == Op::ArgMax);
            return Some(Value::Int(ArrayD::from_elem(IxDyn(shape), index)));
        }
        Op::FromIndex => x.first()?.int()?.mapv(T::of),
        Op::Unary(unary) => float(0)?.mapv(|x| apply(*unary, x)),
        Op::Reduce(kind, axis) => float(0)?.map_axis(Axis(*axis), |row| {
            let (len, row) = (T::of(row.len() as i64), row.iter().copied());
            match kind.0 {
                ReduceKind::Sum => row.sum(),
                ReduceKind::Mean => row.sum::<T>() / len,
                ReduceKind::Max => row.fold(T::neg_infinity(), T::max),
                ReduceKind::Min => row.fold(T::infinity(), T::min),
                ReduceKind::Prod => row.product(),
            }
        }),
        Op::MatMul => matmul(float(0)?, float(1)?, shape)?,
        Op::Conv(conv) => images::conv(conv, &floats(x)?, shape)?,
        Op::Pool(kind, windows) => images::pool(kind.0, windows, float(0)?, shape)?,
        Op::Resize => images::resize(&floats(x)?, shape)?,
        Op::Softmax => by_rows(float(0)?, |row| {
            let most = row.iter().copied().fold(T::neg_infinity(), T::max);
            for x in row.iter_mut() {
                *x = (*x - most).exp();
            }
            let sum: T = row.iter().copied().sum();
            for x in row.iter_mut() {
                *x /= sum;
            }
        }),
        Op::LayerNorm { eps } => {
            let eps = T::exact(f32::from_bits(*eps));
            let normed = by_rows(float(0)?, |row| {
                let len = T::of(row.len() as i64);
                let mean = row.iter().copied().sum::<T>() / len;
                let square = |x: &T| (*x - mean) * (*x - mean);
                let deviation = (row.iter().map(square).sum::<T>() / len + eps).sqrt();
                for x in row.iter_mut() {
                    *x = (*x - mean) / deviation;
                }
            });
            normed * float(1)?.broadcast(IxDyn(shape))? + float(2)?.broadcast(IxDyn(shape))?
        }
        // What later passes of the compiler make, and inputs.
        _ => return None,
    };
    Some(Value::Float(value))
}

/// Moves elements, all or some of them, to other places.
fn moved<E: Clone>(
    op: &Op,
    mut x: Vec<ArrayViewD<E>>,
    row: Option<i64>,
    shape: &[usize],
) -> Option<ArrayD<E>> {
    if let Op::Concat { axis } = op {
        return concatenate(Axis(*axis), &x).ok();
    }
    let x = x.swap_remove(0);
    let reshaped = |x: ArrayViewD<E>| {
        let x = x.as_standard_layout().into_owned();
        x.into_shape_with_order(IxDyn(shape)).ok()
    };
    match op {
        Op::Reshape => reshaped(x),
        Op::Transpose(perm) => Some(x.permuted_axes(IxDyn(perm)).to_owned()),
        Op::Slice { axis, start } => {
            let part = Slice::from(*start..start + shape[*axis]);
            Some(x.slice_axis(Axis(*axis), part).to_owned())
        }
        Op::Expand => Some(x.broadcast(IxDyn(shape))?.to_owned()),
        Op::GatherRow => {
            let row = usize::try_from(row?).ok()?;
            let found = (row < x.shape()[0]).then(|| x.index_axis_move(Axis(0), row))?;
            reshaped(found)
        }
        _ => None,
    }
}

fn binary<T: Real>(kind: BinaryKind, x: &[View<T>], shape: &[usize]) -> Option<Value<T>> {
    match x {
        [View::Float(a), View::Float(b)] => {
            let zipped = Zip::from(a.broadcast(IxDyn(shape))?).and(b.broadcast(IxDyn(shape))?);
            Some(Value::Float(zipped.map_collect(|&a, &b| match kind {
                BinaryKind::Add => a + b,
                BinaryKind::Sub => a - b,
                BinaryKind::Mul => a * b,
                BinaryKind::Div => a / b,
                BinaryKind::Max => a.max(b),
                BinaryKind::Min => a.min(b),
                BinaryKind::Pow => a.powf(b),
                BinaryKind::Greater => T::of(i64::from(a > b)),
                BinaryKind::Keep if b == T::zero() => T::zero(),
                BinaryKind::Keep => a,
            })))
        }
        [View::Int(a), View::Int(b)] => {
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
            let (a, b) = (a.broadcast(IxDyn(shape))?, b.broadcast(IxDyn(shape))?);
            let y: Option<Vec<i64>> = a.iter().zip(b.iter()).map(f).collect();
            Some(Value::Int(ArrayD::from_shape_vec(IxDyn(shape), y?).ok()?))
        }
        _ => None,
    }
}

/// Applies a [`Unary`] to one element.
pub(crate) fn apply<T: Real>(unary: Unary, x: T) -> T {
    let (zero, one) = (T::zero(), T::one());
    let alpha = T::exact(f32::from_bits(unary.alpha));
    let softplus = |x: T| x.max(zero) + (-x.abs()).exp().ln_1p();
    match unary.kind.0 {
        UnaryKind::Relu if x < zero => zero,
        UnaryKind::LeakyRelu if x < zero => alpha * x,
        UnaryKind::Elu if x < zero => alpha * x.exp_m1(),
        UnaryKind::Relu | UnaryKind::LeakyRelu | UnaryKind::Elu => x,
        UnaryKind::Tanh => x.tanh(),
        UnaryKind::Sigmoid => one / (one + (-x).exp()),
        UnaryKind::Exp => x.exp(),
        UnaryKind::Log => x.ln(),
        UnaryKind::Sqrt => x.sqrt(),
        UnaryKind::Rsqrt => one / x.sqrt(),
        UnaryKind::Neg => -x,
        UnaryKind::Abs => x.abs(),
        UnaryKind::Recip => one / x,
        UnaryKind::Erf => x.erf(),
        UnaryKind::Square => x * x,
        UnaryKind::Softplus => softplus(x),
        UnaryKind::Mish => x * softplus(x).tanh(),
        UnaryKind::Trunc => x.trunc(),
    }
}

/// Copies a value and changes its rows over the last axis.
fn by_rows<T: Real>(x: &ArrayViewD<T>, change: impl Fn(&mut [T])) -> ArrayD<T> {
    let mut y = x.as_standard_layout().into_owned();
    let len = y.shape().last().copied().unwrap_or(1).max(1);
    if let Some(all) = y.as_slice_mut() {
        all.chunks_exact_mut(len).for_each(change);
    }
    y
}

/// Returns the index of the first smallest or largest element.
fn best<T: Real>(x: &ArrayViewD<T>, largest: bool) -> i64 {
    let mut found = (0, T::nan());
    for (i, &value) in x.iter().enumerate() {
        let better = if largest {
            value > found.1
        } else {
            value < found.1
        };
        if i == 0 || better {
            found = (i as i64, value);
        }
    }
    found.0
}

/// Views, or copies where it has to, a tensor as a stack of matrices, broadcast over `batch`.
fn matrices<'x, T: Real>(
    x: &'x ArrayViewD<T>,
    batch: &[usize],
    [count, rows, cols]: [usize; 3],
) -> Option<CowArray<'x, T, Ix3>> {
    let wanted = [batch, &[rows, cols]].concat();
    let wide = x.broadcast(IxDyn(&wanted))?;
    // Weights lie as they are read, and are large: they are not copied.
    if let Ok(view) = wide.clone().into_shape_with_order((count, rows, cols)) {
        return Some(CowArray::from(view));
    }
    let wide = wide.as_standard_layout().into_owned();
    let owned = wide.into_shape_with_order((count, rows, cols)).ok()?;
    Some(CowArray::from(owned))
}

/// Computes products over the last two axes, the others broadcast.
fn matmul<T: Real>(a: &ArrayViewD<T>, b: &ArrayViewD<T>, shape: &[usize]) -> Option<ArrayD<T>> {
    let (batch, &[m, n]) = shape.split_last_chunk::<2>()?;
    let k = *a.shape().last()?;
    let count = batch.iter().product::<usize>();
    let (a, b) = (
        matrices(a, batch, [count, m, k])?,
        matrices(b, batch, [count, k, n])?,
    );
    let mut y = Vec::with_capacity(count * m * n);
    for (a, b) in a.outer_iter().zip(b.outer_iter()) {
        for row in a.outer_iter() {
            // Row by row of `b`: each sum still goes from the first product to the last.
            let products = row.iter().zip(b.outer_iter());
            let mut sums: Option<Vec<T>> = None;
            for (&factor, of) in products {
                match &mut sums {
                    None => sums = Some(of.iter().map(|&x| factor * x).collect()),
                    Some(sums) => {
                        for (sum, &x) in sums.iter_mut().zip(of) {
                            *sum += factor * x;
                        }
                    }
                }
            }
            y.extend(sums?);
        }
    }
    ArrayD::from_shape_vec(IxDyn(shape), y).ok()
}
