//! Tests that any op, and any words that decode, are read back from an image as they were written,
//! bit for bit.

use lads_image::op::{
    Activation, ArgMax, ArgMin, Attention, Binary, BinaryKind, CacheFormat, Copy, FromIndex,
    GatherRow, IntSlot, LayerNorm, Linear, MatMul, OP_WORDS, Op, Operand, Reduce, ReduceKind,
    Softmax, Space, Span, StateSpan, ToIndex, Unary, UnaryKind, WeightFormat, WeightSpan,
};
use proptest::prelude::*;

fn span() -> impl Strategy<Value = Span> {
    (any::<u32>(), any::<u32>()).prop_map(|(offset, len)| Span { offset, len })
}

fn weight_span() -> impl Strategy<Value = WeightSpan> {
    (any::<u32>(), any::<u32>()).prop_map(|(offset, len)| WeightSpan { offset, len })
}

fn operand() -> impl Strategy<Value = Operand> {
    (prop::sample::select(Space::ALL), any::<u32>(), any::<u32>())
        .prop_map(|(space, offset, len)| Operand { space, offset, len })
}

fn activation() -> impl Strategy<Value = Activation> {
    let plain = [
        Activation::None,
        Activation::Relu,
        Activation::Tanh,
        Activation::Sigmoid,
        Activation::Softplus,
        Activation::Mish,
    ];
    prop_oneof![
        prop::sample::select(plain.to_vec()),
        (-1.0_f32..1.0).prop_map(Activation::LeakyRelu),
        (-1.0_f32..1.0).prop_map(Activation::Elu)
    ]
}

#[expect(clippy::too_many_lines, reason = "one strategy per op")]
fn op() -> impl Strategy<Value = Op> {
    use BinaryKind::{Add, Div, Greater, Keep, Max, Min, Mul, Pow, Sub};
    use UnaryKind::{
        Abs, Elu, Erf, Exp, LeakyRelu, Log, Mish, Neg, Recip, Relu, Rsqrt, Sigmoid, Softplus, Sqrt,
        Square, Tanh, Trunc,
    };
    let dims = any::<[u32; 4]>;
    let linear = (
        span(),
        prop::sample::select(WeightFormat::ALL.to_vec()),
        weight_span(),
        [
            prop::option::of(weight_span()),
            prop::option::of(weight_span()),
        ],
        span(),
        any::<[u32; 3]>(),
        activation(),
        any::<bool>(),
    )
        .prop_map(
            |(x, format, w, [scales, bias], y, [m, k, n], activation, accumulate)| {
                Linear {
                    x,
                    format,
                    w,
                    scales,
                    bias,
                    y,
                    m,
                    k,
                    n,
                    activation,
                    accumulate,
                }
                .into()
            },
        );
    let layer_norm = (
        span(),
        span(),
        weight_span(),
        weight_span(),
        any::<[u32; 2]>(),
        -9.0_f32..9.0,
    )
        .prop_map(|(x, y, gamma, beta, [rows, cols], eps)| {
            LayerNorm {
                x,
                y,
                gamma,
                beta,
                rows,
                cols,
                eps,
            }
            .into()
        });
    let attention = (
        prop::array::uniform5(span()),
        any::<[u32; 11]>(),
        prop::sample::select(CacheFormat::ALL.to_vec()),
        -9.0_f32..9.0,
    )
        .prop_map(|(s, n, format, scale)| {
            let state = |offset, len| StateSpan { offset, len };
            Attention {
                q: s[0],
                q_stride: n[0],
                k: s[1],
                k_stride: n[1],
                v: s[2],
                v_stride: n[2],
                y: s[3],
                format,
                cache_k: state(n[3], n[4]),
                cache_v: state(n[5], n[6]),
                heads: n[7],
                head_dim: n[8],
                tokens: n[9],
                queries: n[10],
                scale,
                scratch: s[4],
            }
            .into()
        });
    let kinds = vec![Add, Sub, Mul, Div, Max, Min, Pow, Greater, Keep];
    let binary = (
        prop::sample::select(kinds),
        operand(),
        operand(),
        span(),
        dims(),
        dims(),
        dims(),
    )
        .prop_map(|(kind, a, b, y, dims, a_strides, b_strides)| {
            Binary {
                kind,
                a,
                b,
                y,
                dims,
                a_strides,
                b_strides,
            }
            .into()
        });
    let kinds = vec![
        Relu, LeakyRelu, Tanh, Sigmoid, Exp, Log, Sqrt, Rsqrt, Neg, Abs, Recip, Erf, Square, Elu,
        Softplus, Mish, Trunc,
    ];
    let unary = (
        prop::sample::select(kinds),
        -9.0_f32..9.0,
        operand(),
        span(),
    )
        .prop_map(|(kind, alpha, x, y)| Unary { kind, alpha, x, y }.into());
    let softmax = (span(), span(), any::<[u32; 2]>())
        .prop_map(|(x, y, [rows, cols])| Softmax { x, y, rows, cols }.into());
    let kinds = vec![
        ReduceKind::Sum,
        ReduceKind::Mean,
        ReduceKind::Max,
        ReduceKind::Min,
        ReduceKind::Prod,
    ];
    let reduce = (
        prop::sample::select(kinds),
        operand(),
        span(),
        any::<[u32; 3]>(),
    )
        .prop_map(|(kind, x, y, [outer, axis, inner])| {
            Reduce {
                kind,
                x,
                y,
                outer,
                axis,
                inner,
            }
            .into()
        });
    let matmul = (
        operand(),
        operand(),
        span(),
        dims(),
        any::<[u32; 3]>(),
        any::<[u32; 3]>(),
    )
        .prop_map(|(a, b, y, [batch, m, k, n], a_strides, b_strides)| {
            MatMul {
                a,
                b,
                y,
                batch,
                m,
                k,
                n,
                a_strides,
                b_strides,
            }
            .into()
        });
    let gather = (operand(), any::<[u32; 2]>(), 0_u8..8, any::<i32>(), span()).prop_map(
        |(table, [row_len, rows], slot, shift, y)| {
            GatherRow {
                table,
                row_len,
                rows,
                index: IntSlot(slot),
                shift,
                y,
            }
            .into()
        },
    );
    let copy = (operand(), span(), dims(), dims(), dims()).prop_map(
        |(x, y, dims, x_strides, y_strides)| {
            Copy {
                x,
                y,
                dims,
                x_strides,
                y_strides,
            }
            .into()
        },
    );
    let arg_min = (span(), 0_u8..8).prop_map(|(x, slot)| {
        ArgMin {
            x,
            out: IntSlot(slot),
        }
        .into()
    });
    let arg_max = (span(), 0_u8..8).prop_map(|(x, slot)| {
        ArgMax {
            x,
            out: IntSlot(slot),
        }
        .into()
    });
    let to_index = (span(), 0_u8..8).prop_map(|(x, slot)| {
        ToIndex {
            x,
            out: IntSlot(slot),
        }
        .into()
    });
    let from_index = (0_u8..8, any::<i32>(), span()).prop_map(|(slot, shift, y)| {
        FromIndex {
            index: IntSlot(slot),
            shift,
            y,
        }
        .into()
    });
    prop_oneof![
        linear, layer_norm, attention, binary, unary, softmax, reduce, matmul, gather, copy,
        arg_min, arg_max, to_index, from_index
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn an_op_is_read_as_it_was_written(op in op()) {
        prop_assert_eq!(Op::decode(&op.encode()), Some(op));
    }

    #[test]
    fn what_decodes_is_written_bit_for_bit(
        op in op(),
        edits in prop::collection::vec((0..OP_WORDS, any::<u32>()), 0..3),
    ) {
        let mut words = op.encode();
        for (at, value) in edits {
            words[at] = value;
        }
        if let Some(read) = Op::decode(&words) {
            prop_assert_eq!(read.encode(), words);
        }
    }
}
