//! Sound ops: every kind, with its operands in each of the places where they may lie.

use lads_image::op::{
    Activation, ArgMax, ArgMin, Attention, Binary, BinaryKind, CacheFormat, Copy, FromIndex,
    GatherRow, IntSlot, LayerNorm, Linear, MatMul, Op, Operand, Reduce, ReduceKind, Softmax, Span,
    StateSpan, ToIndex, Unary, UnaryKind, WeightFormat, WeightSpan,
};
use lads_kernels::{attention_scratch_len, packed_len};

use super::images::images;
use super::{SPACES, TOKENS};

pub const fn span(offset: u32, len: u32) -> Span {
    Span { offset, len }
}

pub const fn weight(offset: u32, len: u32) -> WeightSpan {
    WeightSpan { offset, len }
}

pub fn attention(queries: u32) -> Attention {
    let (heads, head_dim) = (2, 3);
    let width = heads * head_dim;
    let row = |queries| if queries == 0 { 0 } else { width };
    let scratch = attention_scratch_len(queries as usize, heads as usize, SPACES.rows) as u32;
    let strided = if queries == 0 { 0 } else { (queries - 1) * 20 };
    Attention {
        q: span(300, strided + row(queries)),
        q_stride: 20,
        k: span(6, 20 + width),
        k_stride: 20,
        v: span(12, 20 + width),
        v_stride: 20,
        y: span(400, queries * width),
        format: CacheFormat::F32,
        cache_k: StateSpan {
            offset: 4,
            len: 16 * width,
        },
        cache_v: StateSpan {
            offset: 110,
            len: 9 * width,
        },
        heads,
        head_dim,
        tokens: TOKENS,
        queries,
        scale: 0.5,
        scratch: span(450, scratch),
    }
}

/// Returns all sound ops.
#[expect(clippy::too_many_lines, reason = "one sample per op and place")]
pub fn samples() -> Vec<Op> {
    let linear = |format: WeightFormat, accumulate| {
        let words = packed_len(format, [5, 20]) * format.bytes() / 4;
        Linear {
            x: span(10, 10),
            format,
            w: weight(0, words as u32),
            scales: format.is_scaled().then_some(weight(300, 20)),
            bias: Some(weight(350, 20)),
            y: span(100, 40),
            m: 2,
            k: 5,
            n: 20,
            activation: Activation::Tanh,
            accumulate,
        }
    };
    let mut ops: Vec<Op> = vec![];
    for format in WeightFormat::ALL {
        ops.push(linear(format, false).into());
        ops.push(linear(format, true).into());
    }
    let norm = LayerNorm {
        x: span(10, 10),
        y: span(30, 10),
        gamma: weight(3, 5),
        beta: weight(9, 5),
        rows: 2,
        cols: 5,
        eps: 1e-5,
    };
    ops.push(norm.into());
    ops.extend([0, 1, 2].map(|queries| Op::from(attention(queries))));
    for format in [CacheFormat::F16, CacheFormat::Int8] {
        let exact = attention(2);
        let heads = [exact.heads, exact.head_dim].map(|count| count as usize);
        let words = format.words(SPACES.rows, heads).unwrap();
        let [keys, values] = words.map(|words| words as u32);
        let smaller = Attention {
            format,
            cache_k: StateSpan {
                len: keys,
                ..exact.cache_k
            },
            cache_v: StateSpan {
                len: values,
                ..exact.cache_v
            },
            ..exact
        };
        ops.push(smaller.into());
    }
    let (arena, weights): (Operand, Operand) = (span(10, 12).into(), weight(20, 12).into());
    for x in [arena, weights] {
        let unary = Unary {
            kind: UnaryKind::Square,
            alpha: 0.0,
            x,
            y: span(30, 12),
        };
        ops.push(unary.into());
        let reduce = Reduce {
            kind: ReduceKind::Mean,
            x,
            y: span(30, 4),
            outer: 2,
            axis: 3,
            inner: 2,
        };
        ops.push(reduce.into());
        let copy = Copy {
            x,
            y: span(30, 16),
            dims: [1, 2, 2, 3],
            x_strides: [0, 6, 1, 2],
            y_strides: [0, 8, 4, 1],
        };
        ops.push(copy.into());
        let gather = GatherRow {
            table: x,
            row_len: 3,
            rows: 4,
            index: IntSlot(2),
            shift: 1,
            y: span(30, 3),
        };
        ops.push(gather.into());
        let binary = Binary {
            kind: BinaryKind::Sub,
            a: x,
            b: span(50, 3).into(),
            y: span(30, 12),
            dims: [1, 1, 4, 3],
            a_strides: [0, 0, 3, 1],
            b_strides: [0, 0, 0, 1],
        };
        ops.push(binary.into());
        let product = MatMul {
            a: x,
            b: span(50, 12).into(),
            y: span(30, 8),
            batch: 2,
            m: 2,
            k: 3,
            n: 2,
            a_strides: [6, 3, 1],
            b_strides: [6, 1, 3],
        };
        ops.push(product.into());
    }
    let in_place = Unary {
        kind: UnaryKind::Neg,
        alpha: 0.0,
        x: arena,
        y: span(10, 12),
    };
    ops.push(in_place.into());
    let in_place = Binary {
        kind: BinaryKind::Mul,
        a: arena,
        b: weight(20, 1).into(),
        y: span(10, 12),
        dims: [1, 1, 1, 12],
        a_strides: [0, 0, 0, 1],
        b_strides: [0; 4],
    };
    ops.push(in_place.into());
    let softmax = Softmax {
        x: span(10, 12),
        y: span(30, 12),
        rows: 3,
        cols: 4,
    };
    ops.push(softmax.into());
    let (x, out) = (span(10, 12), IntSlot(7));
    ops.push(ArgMin { x, out }.into());
    ops.push(ArgMax { x, out }.into());
    let (one, index) = (span(10, 1), IntSlot(7));
    ops.push(ToIndex { x: one, out }.into());
    ops.push(
        FromIndex {
            index,
            shift: -3,
            y: one,
        }
        .into(),
    );
    ops.extend(images());
    ops
}
