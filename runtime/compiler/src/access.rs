//! Which elements of the arena an op reads and writes.
//!
//! [`reads`] and [`writes`] are exact: gaps between strided elements are not part of an access. The order of the elements depends
//! on the op's shape alone, so the accesses of an op before and after its spans were moved pair off.

use lads_core::op::{self, IntSlot, Op, Operand, Space, Span};

/// Strided elements: `offset + i * strides[0] + ..` for all indices below `dims`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Access {
    offset: u32,
    dims: [u32; 4],
    strides: [u32; 4],
}

impl Access {
    fn all(span: Span) -> Self {
        Self::strided(span, [1, 1, 1, span.len], [0, 0, 0, 1])
    }

    fn strided(span: Span, dims: [u32; 4], strides: [u32; 4]) -> Self {
        Self {
            offset: span.offset,
            dims,
            strides,
        }
    }

    fn rows(span: Span, rows: u32, stride: u32) -> Self {
        let width = span.len - (rows - 1) * stride;
        Self::strided(span, [1, 1, rows, width], [0, 0, stride, 1])
    }

    /// The elements, in row-major order.
    pub fn elements(self) -> impl Iterator<Item = usize> {
        let [a, b, c, d] = self.dims;
        let [sa, sb, sc, sd] = self.strides.map(|stride| stride as usize);
        (0..a as usize).flat_map(move |i| {
            (0..b as usize).flat_map(move |j| {
                (0..c as usize).flat_map(move |k| {
                    (0..d as usize)
                        .map(move |l| self.offset as usize + i * sa + j * sb + k * sc + l * sd)
                })
            })
        })
    }
}

/// The arena span of an operand that lies there.
fn arena(operand: Operand) -> Option<Span> {
    matches!(operand.space, Space::Arena).then_some(Span {
        offset: operand.offset,
        len: operand.len,
    })
}

/// What an op reads before it writes.
pub(crate) fn reads(op: &Op) -> Vec<Access> {
    let strided = |operand: Operand, dims, strides| {
        arena(operand).map(|span| Access::strided(span, dims, strides))
    };
    match op {
        Op::Linear(op) => {
            let to = op.accumulate.then(|| Access::all(op.y));
            [Some(Access::all(op.x)), to]
                .into_iter()
                .flatten()
                .collect()
        }
        Op::LayerNorm(op) => vec![Access::all(op.x)],
        Op::Attention(op) => {
            let mut all = vec![
                Access::rows(op.k, op.tokens, op.k_stride),
                Access::rows(op.v, op.tokens, op.v_stride),
            ];
            if op.queries > 0 {
                all.push(Access::rows(op.q, op.queries, op.q_stride));
            }
            all
        }
        Op::Binary(op) => [
            strided(op.a, op.dims, op.a_strides),
            strided(op.b, op.dims, op.b_strides),
        ]
        .into_iter()
        .flatten()
        .collect(),
        Op::Unary(op) => arena(op.x).map(Access::all).into_iter().collect(),
        Op::Softmax(op) => vec![Access::all(op.x)],
        Op::Reduce(op) => arena(op.x).map(Access::all).into_iter().collect(),
        Op::MatMul(op) => {
            let [ab, am, ak] = op.a_strides;
            let [bb, bk, bn] = op.b_strides;
            let a = strided(op.a, [1, op.batch, op.m, op.k], [0, ab, am, ak]);
            let b = strided(op.b, [1, op.batch, op.k, op.n], [0, bb, bk, bn]);
            [a, b].into_iter().flatten().collect()
        }
        Op::GatherRow(_) => vec![],
        Op::Copy(op) => strided(op.x, op.dims, op.x_strides).into_iter().collect(),
        Op::ArgMin(op::ArgMin { x, .. }) | Op::ArgMax(op::ArgMax { x, .. }) => {
            vec![Access::all(*x)]
        }
    }
}

/// What an op writes, scratch included.
pub(crate) fn writes(op: &Op) -> Vec<Access> {
    match op {
        Op::Linear(op) => vec![Access::all(op.y)],
        Op::LayerNorm(op) => vec![Access::all(op.y)],
        Op::Attention(op) if op.queries > 0 => vec![Access::all(op.scratch), Access::all(op.y)],
        Op::Attention(_) | Op::ArgMin(_) | Op::ArgMax(_) => vec![],
        Op::Binary(op) => vec![Access::all(op.y)],
        Op::Unary(op) => vec![Access::all(op.y)],
        Op::Softmax(op) => vec![Access::all(op.y)],
        Op::Reduce(op) => vec![Access::all(op.y)],
        Op::MatMul(op) => vec![Access::all(op.y)],
        Op::GatherRow(op) => vec![Access::all(op.y)],
        Op::Copy(op) => vec![Access::strided(op.y, op.dims, op.y_strides)],
    }
}

/// The integer that an op reads, and the one that it writes.
pub(crate) fn slots(op: &Op) -> (Option<IntSlot>, Option<IntSlot>) {
    match op {
        Op::GatherRow(op) => (Some(op.index), None),
        Op::ArgMin(op::ArgMin { out, .. }) | Op::ArgMax(op::ArgMax { out, .. }) => {
            (None, Some(*out))
        }
        _ => (None, None),
    }
}

/// Calls `f` with every span of the arena that is not empty.
pub(crate) fn each_span(op: &mut Op, f: &mut impl FnMut(&mut Span)) {
    let mut span = |span: &mut Span| {
        if span.len > 0 {
            f(span);
        }
    };
    let operand = |operand: &mut Operand, span: &mut dyn FnMut(&mut Span)| {
        if let Some(mut moved) = arena(*operand) {
            span(&mut moved);
            operand.offset = moved.offset;
        }
    };
    match op {
        Op::Linear(op) => [&mut op.x, &mut op.y].into_iter().for_each(span),
        Op::LayerNorm(op) => [&mut op.x, &mut op.y].into_iter().for_each(span),
        Op::Attention(op) => [&mut op.q, &mut op.k, &mut op.v, &mut op.y, &mut op.scratch]
            .into_iter()
            .for_each(span),
        Op::Binary(op) => {
            operand(&mut op.a, &mut span);
            operand(&mut op.b, &mut span);
            span(&mut op.y);
        }
        Op::Unary(op) => {
            operand(&mut op.x, &mut span);
            span(&mut op.y);
        }
        Op::Softmax(op) => [&mut op.x, &mut op.y].into_iter().for_each(span),
        Op::Reduce(op) => {
            operand(&mut op.x, &mut span);
            span(&mut op.y);
        }
        Op::MatMul(op) => {
            operand(&mut op.a, &mut span);
            operand(&mut op.b, &mut span);
            span(&mut op.y);
        }
        Op::GatherRow(op) => span(&mut op.y),
        Op::Copy(op) => {
            operand(&mut op.x, &mut span);
            span(&mut op.y);
        }
        Op::ArgMin(op::ArgMin { x, .. }) | Op::ArgMax(op::ArgMax { x, .. }) => span(x),
    }
}
