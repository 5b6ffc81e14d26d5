//! The operations of a program: what each computes, on which elements, and how it is written into an image.
//!
//! A program is a list of [`Op`]s over one arena of `f32` elements. Every shape is static but one: the number of tokens
//! already in the KV cache, `P`, which only [`Attention`] sees. Every offset and length counts elements.
//!
//! Invariants, all checked once by [`Program::new_checked`](crate::program::Program::new_checked):
//! - each span lies inside its space, and is exactly as long as the shape says (strided operands: at least as long as the
//!   last element that the strides reach);
//! - what an op writes overlaps nothing that it reads, except where the op says *in place*;
//! - no length is zero.
//!
//! An op is [`OP_WORDS`] words: the opcode, the fields in the order of declaration, zeros. [`Op::decode`] refuses everything
//! that [`Op::encode`] would not write.

mod place;

use crate::codec::{Field, Reader, Writer, record, word_enum_for};

pub use lads_kernels::{Activation, BinaryKind, CacheFormat, ReduceKind, UnaryKind, WeightFormat};
pub use place::{INT_SLOTS, IntSlot, Operand, Place, Port, Space, Span, StateSpan, WeightSpan};

/// Words of an encoded op.
pub const OP_WORDS: usize = 24;

impl Field for Activation {
    const WORDS: usize = 2;
    fn put(&self, out: &mut Writer) {
        let (kind, alpha) = match *self {
            Self::None => (0, 0.0),
            Self::Relu => (1, 0.0),
            Self::LeakyRelu(alpha) => (2, alpha),
            Self::Tanh => (3, 0.0),
            Self::Sigmoid => (4, 0.0),
        };
        out.word(kind);
        alpha.put(out);
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        let kind = from.word()?;
        let alpha = f32::take(from)?;
        let plain = match kind {
            0 => Self::None,
            1 => Self::Relu,
            2 => return Some(Self::LeakyRelu(alpha)),
            3 => Self::Tanh,
            4 => Self::Sigmoid,
            _ => return None,
        };
        (alpha.to_bits() == 0).then_some(plain)
    }
}

word_enum_for!(WeightFormat { F32 = 0, F16 = 1, Bf16 = 2, Int8 = 3, Int16 = 4, });

word_enum_for!(CacheFormat { F32 = 0, F16 = 1, });

word_enum_for!(BinaryKind { Add = 0, Sub = 1, Mul = 2, Div = 3, Max = 4, Min = 5, Pow = 6, });

word_enum_for!(UnaryKind {
    Relu = 0,
    LeakyRelu = 1,
    Tanh = 2,
    Sigmoid = 3,
    Exp = 4,
    Log = 5,
    Sqrt = 6,
    Rsqrt = 7,
    Neg = 8,
    Abs = 9,
    Recip = 10,
    Erf = 11,
    Square = 12,
});

word_enum_for!(ReduceKind { Sum = 0, Mean = 1, Max = 2, Min = 3, Prod = 4, });

record! {
    /// `y = (accumulate ? y : 0) + activation(x·W + b)`; with `accumulate` the op is in place on `y`: a residual connection.
    pub struct Linear {
        /// `[m, k]`, contiguous.
        pub x: Span,
        /// How `w` is stored.
        pub format: WeightFormat,
        /// `[k, n]` in panels of 64 outputs: `lads_kernels::packed_len` elements of `format`, ordered by `lads_kernels::pack`.
        pub w: WeightSpan,
        /// `[n]`, with integers only: multiplies each output of `x·W`.
        pub scales: Option<WeightSpan>,
        /// `[n]`
        pub bias: Option<WeightSpan>,
        /// `[m, n]`, contiguous.
        pub y: Span,
        /// Rows.
        pub m: u32,
        /// Inputs.
        pub k: u32,
        /// Outputs.
        pub n: u32,
        /// Applied to `x·W + b`, before accumulation.
        pub activation: Activation,
        /// Whether `y` is added to.
        pub accumulate: bool,
    }
}

record! {
    /// `y = (x - mean) / sqrt(variance + eps) * gamma + beta`, per row, with the population variance.
    pub struct LayerNorm {
        /// `[rows, cols]`
        pub x: Span,
        /// `[rows, cols]`
        pub y: Span,
        /// `[cols]`
        pub gamma: WeightSpan,
        /// `[cols]`
        pub beta: WeightSpan,
        /// Rows.
        pub rows: u32,
        /// Columns.
        pub cols: u32,
        /// Added to the variance.
        pub eps: f32,
    }
}

record! {
    /// Causal multi-head attention over the KV cache, which it appends to.
    ///
    /// The `tokens` rows of `k` and `v` become cache rows `P..P + tokens` (one contiguous row of `heads * head_dim` per token).
    /// Then each of the last `queries` tokens attends to rows `0..=` its own:
    /// `y[i] = concat over heads of softmax(scale * q[i]·K^T)·V`. With `queries = 0` the op only records; then `q`, `y` and
    /// `scratch` are empty spans. All attentions of a program append the same number of tokens, and the caller advances `P`
    /// after the whole program ran.
    pub struct Attention {
        /// First of the `queries` rows; row `i` starts at `offset + i * q_stride`. Length `(queries - 1) * q_stride + heads * head_dim`.
        pub q: Span,
        /// Elements from one query row to the next.
        pub q_stride: u32,
        /// First of the `tokens` key rows; length `(tokens - 1) * k_stride + heads * head_dim`.
        pub k: Span,
        /// Elements from one key row to the next.
        pub k_stride: u32,
        /// First of the `tokens` value rows; length `(tokens - 1) * v_stride + heads * head_dim`.
        pub v: Span,
        /// Elements from one value row to the next.
        pub v_stride: u32,
        /// `[queries, heads * head_dim]`, contiguous.
        pub y: Span,
        /// How the cache is stored.
        pub format: CacheFormat,
        /// `[capacity / 16, heads * head_dim, 16]`, blocks of 16 tokens, the last one whole: `lads_kernels::keys_len` elements
        /// of `format`.
        pub cache_k: StateSpan,
        /// `[capacity, heads * head_dim]` elements of `format`; does not overlap `cache_k`.
        pub cache_v: StateSpan,
        /// Heads.
        pub heads: u32,
        /// Elements per head.
        pub head_dim: u32,
        /// Tokens that the op appends.
        pub tokens: u32,
        /// How many of them, the last, are also queries.
        pub queries: u32,
        /// Multiplies the scores.
        pub scale: f32,
        /// `lads_kernels::attention_scratch_len(queries, heads, capacity)` elements, overlaps nothing.
        pub scratch: Span,
    }
}

record! {
    /// `y[i] = kind(a[i], b[i])` over four dimensions. In place when `y` is exactly the span of a contiguous `a` or `b`.
    pub struct Binary {
        /// What is computed.
        pub kind: BinaryKind,
        /// First operand.
        pub a: Operand,
        /// Second operand.
        pub b: Operand,
        /// Contiguous, `dims`.
        pub y: Span,
        /// Shape of the result, padded in front with ones.
        pub dims: [u32; 4],
        /// Elements from one index to the next in each dimension of `a`; 0 broadcasts.
        pub a_strides: [u32; 4],
        /// The same for `b`.
        pub b_strides: [u32; 4],
    }
}

record! {
    /// `y[i] = kind(x[i])`. In place when `x` and `y` are the same span.
    pub struct Unary {
        /// What is computed.
        pub kind: UnaryKind,
        /// Slope of `LeakyRelu`; anything for the others.
        pub alpha: f32,
        /// The operand.
        pub x: Operand,
        /// As long as `x`.
        pub y: Span,
    }
}

record! {
    /// `y = exp(x - max) / sum(exp(x - max))`, per row.
    pub struct Softmax {
        /// `[rows, cols]`
        pub x: Span,
        /// `[rows, cols]`
        pub y: Span,
        /// Rows.
        pub rows: u32,
        /// Columns.
        pub cols: u32,
    }
}

record! {
    /// `y[o, i] = kind over a of x[o, a, i]`.
    pub struct Reduce {
        /// What is computed.
        pub kind: ReduceKind,
        /// `[outer, axis, inner]`, contiguous.
        pub x: Operand,
        /// `[outer, inner]`
        pub y: Span,
        /// Product of the dimensions before the axis.
        pub outer: u32,
        /// Length of the axis.
        pub axis: u32,
        /// Product of the dimensions after the axis.
        pub inner: u32,
    }
}

record! {
    /// `y[b, i, j] = sum over l of a[b, i, l] * b[b, l, j]`: products of two activations, or with weights that are not packed.
    pub struct MatMul {
        /// First operand.
        pub a: Operand,
        /// Second operand.
        pub b: Operand,
        /// `[batch, m, n]`, contiguous.
        pub y: Span,
        /// Independent products.
        pub batch: u32,
        /// Rows.
        pub m: u32,
        /// Inner dimension.
        pub k: u32,
        /// Columns.
        pub n: u32,
        /// Strides of `a` over batch, `m` and `k`.
        pub a_strides: [u32; 3],
        /// Strides of `b` over batch, `k` and `n`.
        pub b_strides: [u32; 3],
    }
}

record! {
    /// `y = table[index + shift]`. A row outside `0..rows` is an error when the program runs.
    pub struct GatherRow {
        /// `[rows, row_len]`
        pub table: WeightSpan,
        /// Elements of a row.
        pub row_len: u32,
        /// Rows of the table.
        pub rows: u32,
        /// Holds the index.
        pub index: IntSlot,
        /// Added to the index.
        pub shift: i32,
        /// `[row_len]`
        pub y: Span,
    }
}

record! {
    /// `y[i] = x[i]` over four dimensions, both sides strided: transposes, slices, broadcasts and the parts of a concatenation.
    pub struct Copy {
        /// From here.
        pub x: Operand,
        /// To here; elements of the span that the strides do not reach keep their value.
        pub y: Span,
        /// Shape, padded in front with ones.
        pub dims: [u32; 4],
        /// Elements from one index to the next in each dimension of `x`; 0 broadcasts.
        pub x_strides: [u32; 4],
        /// The same for `y`.
        pub y_strides: [u32; 4],
    }
}

record! {
    /// `out = ` index of the smallest element, the first of equal ones.
    pub struct ArgMin {
        /// What is searched.
        pub x: Span,
        /// Where the index goes.
        pub out: IntSlot,
    }
}

record! {
    /// `out = ` index of the largest element, the first of equal ones.
    pub struct ArgMax {
        /// What is searched.
        pub x: Span,
        /// Where the index goes.
        pub out: IntSlot,
    }
}

macro_rules! ops {
    ($($name:ident = $code:literal,)*) => {
        /// One operation of a program.
        #[derive(Debug, Clone, Copy, PartialEq)]
        #[expect(missing_docs, reason = "each variant holds the record of the same name, which is documented")]
        pub enum Op { $($name($name),)* }

        impl Op {
            /// The op as words of an image.
            pub fn encode(&self) -> [u32; OP_WORDS] {
                let mut words = [0; OP_WORDS];
                let mut out = Writer::new(&mut words);
                match self {
                    $(Self::$name(op) => {
                        const { assert!($name::WORDS < OP_WORDS, "an op and its code fit") };
                        out.word($code);
                        op.put(&mut out);
                    })*
                }
                words
            }

            /// Reads an op; `None` for words that [`encode`](Self::encode) does not write.
            pub fn decode(words: &[u32; OP_WORDS]) -> Option<Self> {
                let mut from = Reader::new(words);
                let op = Self::take(&mut from)?;
                from.rest_is_zero().then_some(op)
            }

            /// Reads an op and leaves the zeros behind it. Inlined: a run reads every op again.
            #[inline(always)]
            pub(crate) fn take(from: &mut Reader) -> Option<Self> {
                Some(match from.word()? {
                    $($code => Self::$name($name::take(from)?),)*
                    _ => return None,
                })
            }

            /// The op's name.
            pub const fn name(&self) -> &'static str {
                match self { $(Self::$name(_) => stringify!($name),)* }
            }
        }

        $(impl From<$name> for Op {
            fn from(op: $name) -> Self {
                Self::$name(op)
            }
        })*
    };
}

ops! {
    Linear = 1,
    LayerNorm = 2,
    Attention = 3,
    Binary = 4,
    Unary = 5,
    Softmax = 6,
    Reduce = 7,
    MatMul = 8,
    GatherRow = 9,
    Copy = 10,
    ArgMin = 11,
    ArgMax = 12,
}
