//! The checks of one op: spans inside their spaces, lengths as the shape says, nothing written that is also read.
//!
//! Numbers come from an image that may be hostile, so products are taken in 128 bits, where four 32-bit factors fit.

use core::cell::Cell;
use core::error::Error;
use core::fmt;

use lads_kernels::{CacheFormat, attention_scratch_len};

use crate::image::PortRecord;
use crate::op::{self, Op, Operand, Place, Space, Span, StateSpan, WeightSpan};
use crate::program::Spaces;

/// What is wrong with a program or one of its ops.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The program's record does not decode.
    Record,
    /// Words that mean no op.
    Encoding,
    /// A span reaches beyond its space, or the ops beyond their section.
    Bounds,
    /// A span is not as long as the shape says, or a dimension is zero.
    Shape,
    /// What is written overlaps what is read.
    Overlap,
    /// The KV cache cannot hold the longest context.
    Capacity,
    /// An attention appends another number of tokens than its program.
    Tokens,
    /// An integer port outside an integer slot, or the other way round.
    Port,
    /// The arena is larger than what lies in it.
    Arena,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Record => "the record does not decode",
            Self::Encoding => "unknown operation",
            Self::Bounds => "a span reaches beyond its space",
            Self::Shape => "a span is not as long as its shape",
            Self::Overlap => "the result overlaps an operand",
            Self::Capacity => "the KV cache is too small for the longest context",
            Self::Tokens => "an attention appends another number of tokens than its program",
            Self::Port => "a port lies in the wrong kind of place",
            Self::Arena => "it asks for a larger arena than it uses",
        })
    }
}

impl Error for Fault {}

type Checked = Result<(), Fault>;

fn require(condition: bool, fault: Fault) -> Checked {
    if condition { Ok(()) } else { Err(fault) }
}

/// `len` is the product of `dims`, none of which is zero.
fn exactly<const N: usize>(len: u32, dims: [u32; N]) -> Checked {
    let product: u128 = dims.into_iter().map(u128::from).product();
    require(product != 0 && product == u128::from(len), Fault::Shape)
}

/// `len` words hold exactly so many elements of a format of the cache.
fn exactly_words(len: u32, format: CacheFormat, dims: [u32; 2]) -> Checked {
    let elements: u128 = dims.into_iter().map(u128::from).product();
    let held = u128::from(len).saturating_mul(format.per_word() as u128);
    // The last word may be half empty.
    let fits = held
        .checked_sub(elements)
        .is_some_and(|spare| spare < format.per_word() as u128);
    require(elements != 0 && fits, Fault::Shape)
}

/// A strided layout stays inside `len` elements.
fn reaches<const N: usize>(len: u32, dims: [u32; N], strides: [u32; N]) -> Checked {
    let last: u128 = dims
        .into_iter()
        .zip(strides)
        .map(|(dim, stride)| u128::from(dim.saturating_sub(1)).saturating_mul(u128::from(stride)))
        .sum();
    require(last < u128::from(len), Fault::Shape)
}

/// `offset..offset + len` lies inside `0..space` and is not empty.
fn inside(offset: u32, len: u32, space: usize) -> Checked {
    let end = u64::from(offset).saturating_add(u64::from(len));
    require(len != 0 && end <= space as u64, Fault::Bounds)
}

/// Moves `end` to the end of a span that lies behind it.
fn reach(end: &Cell<u64>, offset: u32, len: u32) {
    end.set(
        end.get()
            .max(u64::from(offset).saturating_add(u64::from(len))),
    );
}

fn overlap(a: [u32; 2], b: [u32; 2]) -> bool {
    let end = |[offset, len]: [u32; 2]| u64::from(offset).saturating_add(u64::from(len));
    u64::from(a[0]) < end(b) && u64::from(b[0]) < end(a)
}

/// `y` overlaps none of the spans.
fn apart<const N: usize>(y: Span, xs: [Span; N]) -> Checked {
    let clash = xs
        .into_iter()
        .any(|x| overlap([y.offset, y.len], [x.offset, x.len]));
    require(!clash, Fault::Overlap)
}

/// The arena span of an operand that lies there.
pub(crate) fn arena_span(operand: Operand) -> Option<Span> {
    matches!(operand.space, Space::Arena).then_some(Span {
        offset: operand.offset,
        len: operand.len,
    })
}

/// Strides of a contiguous layout, the way [`op::Binary`] writes them; dimensions of length one may say anything.
pub(crate) fn is_contiguous(dims: [u32; 4], strides: [u32; 4]) -> bool {
    let mut expected = 1_u64;
    let [d0, d1, d2, d3] = dims;
    let [s0, s1, s2, s3] = strides;
    [(d3, s3), (d2, s2), (d1, s1), (d0, s0)]
        .into_iter()
        .all(|(dim, stride)| {
            let fits = dim == 1 || u64::from(stride) == expected;
            expected = expected.saturating_mul(u64::from(dim));
            fits
        })
}

/// Checks ops against the spaces of one program, and keeps how much of the spaces in memory they use.
pub(crate) struct Checker {
    pub spaces: Spaces,
    pub arena_len: u32,
    pub tokens: u32,
    arena_end: Cell<u64>,
    cache_end: Cell<u64>,
}

impl Checker {
    pub fn new(spaces: Spaces, arena_len: u32, tokens: u32) -> Self {
        Self {
            spaces,
            arena_len,
            tokens,
            arena_end: Cell::new(0),
            cache_end: Cell::new(0),
        }
    }

    /// Every element of the arena belongs to something: an image cannot ask for memory that it does not use. Returns how much
    /// of the cache is used.
    pub fn finish(&self) -> Result<u64, Fault> {
        require(
            self.arena_end.get() == u64::from(self.arena_len),
            Fault::Arena,
        )?;
        Ok(self.cache_end.get())
    }

    pub fn op(&self, op: &Op) -> Checked {
        match op {
            Op::Linear(op) => self.linear(op),
            Op::LayerNorm(op) => self.layer_norm(op),
            Op::Attention(op) => self.attention(op),
            Op::Binary(op) => self.binary(op),
            Op::Unary(op) => self.unary(op),
            Op::Softmax(op) => self.softmax(op),
            Op::Reduce(op) => self.reduce(op),
            Op::MatMul(op) => self.matmul(op),
            Op::GatherRow(op) => self.gather_row(op),
            Op::Copy(op) => self.copy(op),
            Op::ArgMin(op::ArgMin { x, .. }) | Op::ArgMax(op::ArgMax { x, .. }) => self.arena(*x),
        }
    }

    pub fn port(&self, port: &PortRecord) -> Checked {
        match port.place {
            Place::Span(span) if !port.port.is_int() => self.arena(span),
            Place::Int(_) if port.port.is_int() => Ok(()),
            _ => Err(Fault::Port),
        }
    }

    fn arena(&self, span: Span) -> Checked {
        inside(span.offset, span.len, self.arena_len as usize)?;
        reach(&self.arena_end, span.offset, span.len);
        Ok(())
    }

    fn weights(&self, span: WeightSpan) -> Checked {
        inside(span.offset, span.len, self.spaces.weights_len)
    }

    fn cache(&self, span: StateSpan) -> Checked {
        inside(span.offset, span.len, self.spaces.cache_len)?;
        reach(&self.cache_end, span.offset, span.len);
        Ok(())
    }

    fn operand(&self, operand: Operand) -> Checked {
        match operand.space {
            Space::Weights => inside(operand.offset, operand.len, self.spaces.weights_len),
            Space::Arena => self.arena(Span {
                offset: operand.offset,
                len: operand.len,
            }),
        }
    }

    /// `y` lies in the arena and apart from the operand.
    fn result(&self, y: Span, x: Operand) -> Checked {
        self.operand(x)?;
        self.arena(y)?;
        arena_span(x).map_or(Ok(()), |x| apart(y, [x]))
    }

    fn linear(&self, op: &op::Linear) -> Checked {
        self.result(op.y, op.x.into())?;
        exactly(op.x.len, [op.m, op.k])?;
        exactly(op.y.len, [op.m, op.n])?;
        self.weights(op.w)?;
        let scaled = op.format.is_scaled();
        require(op.scales.is_some() == scaled, Fault::Shape)?;
        // Blocks of sixteen outputs, and of integers of sixteen inputs, four bytes to a word.
        let [inputs, times] = if scaled {
            [op.k.div_ceil(16), 16]
        } else {
            [op.k, 1]
        };
        let bytes = op.format.bytes() as u32;
        exactly(op.w.len, [op.n.div_ceil(16), inputs, times, 4, bytes])?;
        for column in [op.scales, op.bias].into_iter().flatten() {
            self.weights(column)?;
            exactly(column.len, [op.n])?;
        }
        Ok(())
    }

    fn layer_norm(&self, op: &op::LayerNorm) -> Checked {
        self.result(op.y, op.x.into())?;
        exactly(op.x.len, [op.rows, op.cols])?;
        exactly(op.y.len, [op.rows, op.cols])?;
        for weights in [op.gamma, op.beta] {
            self.weights(weights)?;
            exactly(weights.len, [op.cols])?;
        }
        Ok(())
    }

    fn attention(&self, op: &op::Attention) -> Checked {
        require(
            op.tokens == self.tokens && op.queries <= op.tokens,
            Fault::Tokens,
        )?;
        let width = u64::from(op.heads).saturating_mul(u64::from(op.head_dim));
        let width = u32::try_from(width).map_err(|_| Fault::Shape)?;
        for (span, stride) in [(op.k, op.k_stride), (op.v, op.v_stride)] {
            self.arena(span)?;
            rows(span, op.tokens, stride, width)?;
        }
        self.cache(op.cache_k)?;
        self.cache(op.cache_v)?;
        let caches = [op.cache_k, op.cache_v].map(|span| [span.offset, span.len]);
        require(!overlap(caches[0], caches[1]), Fault::Overlap)?;
        // Elements of the values, up to one more than there are.
        let values = u64::from(op.cache_v.len).saturating_mul(op.format.per_word() as u64);
        let capacity = values.checked_div(width.into()).ok_or(Fault::Shape)?;
        let capacity = u32::try_from(capacity).map_err(|_| Fault::Shape)?;
        exactly_words(op.cache_v.len, op.format, [capacity, width])?;
        let whole = capacity.checked_next_multiple_of(16).ok_or(Fault::Shape)?;
        exactly_words(op.cache_k.len, op.format, [whole, width])?;
        let needed = (self.spaces.past_max as u64).saturating_add(u64::from(op.tokens));
        require(u64::from(capacity) >= needed, Fault::Capacity)?;
        if op.queries == 0 {
            let empty = op.q.len == 0 && op.y.len == 0 && op.scratch.len == 0;
            return require(empty, Fault::Shape);
        }
        self.arena(op.q)?;
        self.arena(op.y)?;
        self.arena(op.scratch)?;
        rows(op.q, op.queries, op.q_stride, width)?;
        exactly(op.y.len, [op.queries, width])?;
        let scratch =
            attention_scratch_len(op.queries as usize, op.heads as usize, capacity as usize);
        require(scratch as u64 == u64::from(op.scratch.len), Fault::Shape)?;
        apart(op.y, [op.q, op.k, op.v, op.scratch])?;
        apart(op.scratch, [op.q, op.k, op.v])
    }

    fn binary(&self, op: &op::Binary) -> Checked {
        exactly(op.y.len, op.dims)?;
        self.arena(op.y)?;
        for (x, strides) in [(op.a, op.a_strides), (op.b, op.b_strides)] {
            self.operand(x)?;
            reaches(x.len, op.dims, strides)?;
            let in_place = arena_span(x) == Some(op.y) && is_contiguous(op.dims, strides);
            if !in_place {
                self.result(op.y, x)?;
            }
        }
        Ok(())
    }

    fn unary(&self, op: &op::Unary) -> Checked {
        require(op.x.len == op.y.len, Fault::Shape)?;
        if arena_span(op.x) == Some(op.y) {
            return self.arena(op.y);
        }
        self.result(op.y, op.x)
    }

    fn softmax(&self, op: &op::Softmax) -> Checked {
        self.result(op.y, op.x.into())?;
        exactly(op.x.len, [op.rows, op.cols])?;
        exactly(op.y.len, [op.rows, op.cols])
    }

    fn reduce(&self, op: &op::Reduce) -> Checked {
        self.result(op.y, op.x)?;
        exactly(op.x.len, [op.outer, op.axis, op.inner])?;
        exactly(op.y.len, [op.outer, op.inner])
    }

    fn matmul(&self, op: &op::MatMul) -> Checked {
        self.result(op.y, op.a)?;
        self.result(op.y, op.b)?;
        exactly(op.y.len, [op.batch, op.m, op.n])?;
        // A product of two broadcasts could be made to take for ever.
        require(op.k != 0 && op.k <= op.a.len.max(op.b.len), Fault::Shape)?;
        reaches(op.a.len, [op.batch, op.m, op.k], op.a_strides)?;
        reaches(op.b.len, [op.batch, op.k, op.n], op.b_strides)
    }

    fn gather_row(&self, op: &op::GatherRow) -> Checked {
        self.weights(op.table)?;
        self.arena(op.y)?;
        exactly(op.table.len, [op.rows, op.row_len])?;
        exactly(op.y.len, [op.row_len])
    }

    fn copy(&self, op: &op::Copy) -> Checked {
        self.result(op.y, op.x)?;
        reaches(op.x.len, op.dims, op.x_strides)?;
        reaches(op.y.len, op.dims, op.y_strides)?;
        // Each element is written once.
        let written: u128 = op.dims.into_iter().map(u128::from).product();
        let once = op
            .dims
            .into_iter()
            .zip(op.y_strides)
            .all(|(dim, stride)| dim == 1 || stride != 0);
        require(
            written != 0 && written <= u128::from(op.y.len) && once,
            Fault::Shape,
        )
    }
}

/// A span holds `rows` rows of `width` elements that start `stride` elements apart.
fn rows(span: Span, rows: u32, stride: u32, width: u32) -> Checked {
    let len = u64::from(rows.saturating_sub(1))
        .saturating_mul(u64::from(stride))
        .saturating_add(u64::from(width));
    let apart = rows == 1 || stride >= width;
    require(
        rows != 0 && width != 0 && apart && len == u64::from(span.len),
        Fault::Shape,
    )
}
