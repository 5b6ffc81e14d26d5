//! A program under construction, and the weights that programs share.

use lads_image::op::{self, Activation, BinaryKind, IntSlot, Op, Place, Span, WeightSpan};
use lads_kernels::{pack, packed_len};

use super::super::model::{Dense, EPS, Norm};

pub const TIMESTEP: IntSlot = IntSlot(0);

/// A dense layer in the weights.
#[derive(Clone, Copy)]
pub struct Packed {
    pub k: u32,
    pub n: u32,
    pub w: WeightSpan,
    pub b: WeightSpan,
}

/// Weights of an image, each stored once.
pub struct Pool(pub Vec<f32>);

impl Pool {
    pub fn dense(&mut self, dense: &Dense) -> Packed {
        let mut panels = vec![0.0; packed_len(op::WeightFormat::F32, [dense.k, dense.n])];
        pack(
            op::WeightFormat::F32,
            &dense.w,
            [dense.k, dense.n],
            &mut panels,
        );
        Packed {
            k: dense.k as u32,
            n: dense.n as u32,
            w: self.add(&panels),
            b: self.add(&dense.b),
        }
    }

    pub fn norm(&mut self, norm: &Norm) -> [WeightSpan; 2] {
        [self.add(&norm.gamma), self.add(&norm.beta)]
    }

    pub fn add(&mut self, values: &[f32]) -> WeightSpan {
        let offset = self.0.len() as u32;
        self.0.extend(values);
        WeightSpan {
            offset,
            len: values.len() as u32,
        }
    }
}

/// A program under construction and its ports by name; arena is never reused.
#[derive(Clone, Default)]
pub struct Draft {
    pub ops: Vec<Op>,
    pub arena_len: u32,
    pub tokens: u32,
    pub inputs: Vec<(&'static str, Place)>,
    pub outputs: Vec<(&'static str, Place)>,
}

impl Draft {
    pub fn new(tokens: usize) -> Self {
        Self {
            tokens: tokens as u32,
            ..Self::default()
        }
    }

    pub fn span(&mut self, len: u32) -> Span {
        let offset = self.arena_len;
        self.arena_len += len;
        Span { offset, len }
    }

    pub fn input(&mut self, port: &'static str, place: Place) {
        self.inputs.push((port, place));
    }

    pub fn input_span(&mut self, port: &'static str, len: usize) -> Span {
        let span = self.span(len as u32);
        self.input(port, Place::Span(span));
        span
    }

    pub fn output(&mut self, port: &'static str, place: Place) {
        self.outputs.push((port, place));
    }

    pub fn op(&mut self, op: impl Into<Op>) {
        self.ops.push(op.into());
    }

    pub fn linear(
        &mut self,
        x: Span,
        dense: Packed,
        y: Span,
        activation: Activation,
        accumulate: bool,
    ) {
        let Packed { k, n, w, b } = dense;
        self.op(op::Linear {
            x,
            format: op::WeightFormat::F32,
            w,
            scales: None,
            bias: Some(b),
            y,
            m: x.len / k,
            k,
            n,
            activation,
            accumulate,
        });
    }

    pub fn norm(&mut self, x: Span, [gamma, beta]: [WeightSpan; 2]) -> Span {
        let y = self.span(x.len);
        self.op(op::LayerNorm {
            x,
            y,
            gamma,
            beta,
            rows: x.len / gamma.len,
            cols: gamma.len,
            eps: EPS,
        });
        y
    }

    /// Adds the embedding of a timestep, `x += table[timestep + shift]`.
    pub fn add_timestep(&mut self, x: Span, table: WeightSpan, shift: i32) {
        let row = self.span(x.len);
        self.op(op::GatherRow {
            table: table.into(),
            row_len: x.len,
            rows: table.len / x.len,
            index: TIMESTEP,
            shift,
            y: row,
        });
        self.op(op::Binary {
            kind: BinaryKind::Add,
            a: x.into(),
            b: row.into(),
            y: x,
            dims: [1, 1, 1, x.len],
            a_strides: [0, 0, 0, 1],
            b_strides: [0, 0, 0, 1],
        });
    }
}
