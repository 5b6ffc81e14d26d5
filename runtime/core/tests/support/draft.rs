//! A program under construction: arena is never reused, weights go into the parts of the image.

use lads_image::op::{
    self, BinaryKind, CacheFormat, IntSlot, Op, Operand, Place, Span, StateSpan, WeightSpan,
};
use lads_image::records::{self, Source, SourceKind};
use lads_kernels::{attention_scratch_len, keys_len};

use super::writer::Entry;

/// Makes the source of a port that is bound to a channel or a state.
pub const fn bound(kind: SourceKind, of: u32) -> Source {
    Source { kind, of }
}

/// Returns the number of words of a KV cache of `rows` rows.
pub fn kv_len(rows: u32, width: u32) -> u32 {
    keys_len(rows as usize, width as usize) as u32 + rows * width
}

pub struct Draft(pub Entry);

impl Draft {
    pub fn new(name: &str) -> Self {
        Self(Entry {
            name: name.into(),
            ops: Vec::new(),
            arena_len: 0,
            cache: records::NONE,
            tokens: 0,
            inputs: Vec::new(),
            outputs: Vec::new(),
        })
    }

    /// Starts a program that appends `tokens` rows to a KV cache.
    pub fn appending(name: &str, cache: u32, tokens: u32) -> Self {
        let mut draft = Self::new(name);
        (draft.0.cache, draft.0.tokens) = (cache, tokens);
        draft
    }

    pub fn finish(self) -> Entry {
        self.0
    }

    pub fn span(&mut self, len: u32) -> Span {
        let offset = self.0.arena_len;
        self.0.arena_len += len;
        Span { offset, len }
    }

    pub fn input(&mut self, source: Source, place: Place) {
        self.0.inputs.push((source, place));
    }

    pub fn channel(&mut self, channel: u32, len: u32) -> Span {
        self.input_span(bound(SourceKind::Channel, channel), len)
    }

    pub fn state(&mut self, state: u32, len: u32) -> Span {
        self.input_span(bound(SourceKind::State, state), len)
    }

    pub fn input_span(&mut self, source: Source, len: u32) -> Span {
        let span = self.span(len);
        self.input(source, Place::Span(span));
        span
    }

    /// Binds an integer to the slot of this number.
    pub fn int(&mut self, kind: SourceKind, of: u32, slot: u8) -> IntSlot {
        self.input(bound(kind, of), Place::Int(IntSlot(slot)));
        IntSlot(slot)
    }

    pub fn output(&mut self, source: Source, place: Place) {
        self.0.outputs.push((source, place));
    }

    pub fn gives_channel(&mut self, channel: u32, span: Span) {
        self.output(bound(SourceKind::Channel, channel), Place::Span(span));
    }

    pub fn gives_state(&mut self, state: u32, span: Span) {
        self.output(bound(SourceKind::State, state), Place::Span(span));
    }

    pub fn op(&mut self, op: impl Into<Op>) {
        self.0.ops.push(op.into());
    }

    /// Adds an op on two operands, element by element; an operand of one element is broadcast.
    pub fn binary(
        &mut self,
        kind: BinaryKind,
        a: impl Into<Operand>,
        b: impl Into<Operand>,
    ) -> Span {
        let (a, b) = (a.into(), b.into());
        let len = a.len.max(b.len);
        let y = self.span(len);
        let strides = |x: Operand| [0, 0, 0, u32::from(x.len > 1)];
        self.op(op::Binary {
            kind,
            a,
            b,
            y,
            dims: [1, 1, 1, len],
            a_strides: strides(a),
            b_strides: strides(b),
        });
        y
    }

    pub fn add(&mut self, a: impl Into<Operand>, b: impl Into<Operand>) -> Span {
        self.binary(BinaryKind::Add, a, b)
    }

    pub fn mul(&mut self, a: impl Into<Operand>, b: impl Into<Operand>) -> Span {
        self.binary(BinaryKind::Mul, a, b)
    }

    /// Concatenates values.
    pub fn join(&mut self, parts: &[Span]) -> Span {
        let all = self.span(parts.iter().map(|part| part.len).sum());
        let mut offset = all.offset;
        for &part in parts {
            let unit = [0, 0, 0, 1];
            self.op(op::Copy {
                x: part.into(),
                y: Span {
                    offset,
                    len: part.len,
                },
                dims: [1, 1, 1, part.len],
                x_strides: unit,
                y_strides: unit,
            });
            offset += part.len;
        }
        all
    }

    /// Copies row `index + shift` of a table.
    pub fn gather(
        &mut self,
        table: impl Into<Operand>,
        row_len: u32,
        index: IntSlot,
        shift: i32,
    ) -> Span {
        let table = table.into();
        let y = self.span(row_len);
        self.op(op::GatherRow {
            table,
            row_len,
            rows: table.len / row_len,
            index,
            shift,
            y,
        });
        y
    }

    /// Multiplies by weights, `x W`, that are stored row-major, as a product of two operands.
    pub fn product(&mut self, x: Span, w: WeightSpan) -> Span {
        let (k, n) = (x.len, w.len / x.len);
        let y = self.span(n);
        self.op(op::MatMul {
            a: x.into(),
            b: w.into(),
            y,
            batch: 1,
            m: 1,
            k,
            n,
            a_strides: [0, k, 1],
            b_strides: [0, n, 1],
        });
        y
    }

    /// Adds one head of attention in which every token is its own key, value and query, and returns
    /// the last one's result. Without `queries` it only appends to the cache.
    pub fn attend(&mut self, tokens: Span, rows: u32, queries: bool) -> Span {
        let width = tokens.len / self.0.tokens;
        let keys = keys_len(rows as usize, width as usize) as u32;
        let (mut q, mut y, mut scratch) = Default::default();
        if queries {
            q = Span {
                offset: tokens.offset + tokens.len - width,
                len: width,
            };
            y = self.span(width);
            scratch = self.span(attention_scratch_len(1, 1, rows as usize) as u32);
        }
        self.op(op::Attention {
            q,
            q_stride: width,
            k: tokens,
            k_stride: width,
            v: tokens,
            v_stride: width,
            y,
            format: CacheFormat::F32,
            cache_k: StateSpan {
                offset: 0,
                len: keys,
            },
            cache_v: StateSpan {
                offset: keys,
                len: rows * width,
            },
            heads: 1,
            head_dim: width,
            tokens: self.0.tokens,
            queries: u32::from(queries),
            scale: 1.0 / (width as f32).sqrt(),
            scratch,
        });
        y
    }
}
