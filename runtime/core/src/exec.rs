//! Runs a checked program.
//!
//! Blind: bounds, shapes and overlaps were checked by [`Program::new_checked`]. Slices are still taken with `get`, because this
//! crate has no unsafe code; a span that is not there would end the run with [`ExecError::Span`], which a checked program in
//! a workspace of the right size never does.

use core::error::Error;
use core::fmt;
use core::ops::Range;

use lads_kernels as kernels;
use lads_kernels::Isa;

use crate::check::arena_span;
use crate::image::PortRecord;
use crate::op::{
    self, CacheFormat, INT_SLOTS, IntSlot, Op, Operand, Place, Port, Space, Span, StateSpan,
    WeightFormat, WeightSpan,
};
use crate::program::Program;

/// Why a run ended early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExecError {
    /// A table has no row of this index: the timestep or an index is outside what the policy was made for.
    Index {
        /// The row that was asked for.
        row: i64,
        /// Rows of the table.
        rows: u32,
    },
    /// A span lies outside the memory that was given.
    Span,
}

impl fmt::Display for ExecError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Index { row, rows } => write!(f, "row {row} of a table of {rows} rows"),
            Self::Span => f.write_str("a span lies outside the memory of the run"),
        }
    }
}

impl Error for ExecError {}

/// What a caller can set before a run.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Inputs<'i> {
    pub observation: &'i [f32],
    pub action: &'i [f32],
    /// Shorter than the port: the rest is zero.
    pub words: &'i [f32],
    pub plan: &'i [f32],
    pub timestep: u32,
    pub plan_index: u32,
}

impl<'i> Inputs<'i> {
    fn slice(&self, port: Port) -> &'i [f32] {
        match port {
            Port::Observation | Port::Observations => self.observation,
            Port::Action | Port::Actions => self.action,
            Port::Words => self.words,
            Port::Plan => self.plan,
            _ => &[],
        }
    }

    fn int(&self, port: Port) -> u32 {
        match port {
            Port::Timestep => self.timestep,
            Port::PlanIndex => self.plan_index,
            _ => 0,
        }
    }
}

impl Program<'_> {
    /// Runs a program on its own, without a policy around it and without KV cache: for those who test compilers and kernels.
    /// `arena` has at least [`arena_len`](Self::arena_len) elements; the outputs lie where [`outputs`](Self::outputs) says, those
    /// that are integers in the slots that are returned. Of the inputs, [`Port::Observation`], [`Port::Action`], [`Port::Plan`]
    /// and [`Port::Words`] can be set.
    pub fn run(
        &self,
        isa: Isa,
        weights: &[f32],
        arena: &mut [f32],
        inputs: &[(Port, &[f32])],
    ) -> Result<[u32; INT_SLOTS], ExecError> {
        let of = |port: Port| {
            let found = inputs.iter().find(|(known, _)| *known == port);
            found.map_or(&[][..], |(_, values)| values)
        };
        let inputs = Inputs {
            observation: of(Port::Observation),
            action: of(Port::Action),
            words: of(Port::Words),
            plan: of(Port::Plan),
            ..Inputs::default()
        };
        let mut machine = Machine {
            arena,
            cache: &mut [],
            ints: [0; INT_SLOTS],
            isa,
        };
        machine.run(self, weights, 0, &inputs)?;
        Ok(machine.ints)
    }
}

/// The memory that programs run in.
#[derive(Debug)]
pub(crate) struct Machine<'m> {
    pub arena: &'m mut [f32],
    pub cache: &'m mut [f32],
    pub ints: [u32; INT_SLOTS],
    /// What the kernels run on.
    pub isa: Isa,
}

impl Machine<'_> {
    /// Sets the inputs and runs the ops, with `past` tokens in the cache and subnormal numbers taken as zero.
    pub fn run(
        &mut self,
        program: &Program,
        weights: &[f32],
        past: usize,
        inputs: &Inputs,
    ) -> Result<(), ExecError> {
        kernels::flushed(|| {
            for PortRecord { port, place } in program.inputs() {
                match place {
                    Place::Span(span) => {
                        let to = self.arena.get_mut(range(span)).ok_or(ExecError::Span)?;
                        let from = inputs.slice(port);
                        kernels::assign(to, from);
                        to.get_mut(from.len()..).unwrap_or(&mut []).fill(0.0);
                    }
                    Place::Int(slot) => self.set(slot, inputs.int(port)),
                }
            }
            program.ops().try_for_each(|op| self.op(&op, weights, past))
        })
    }

    /// An output of the last run; empty when the program has none of this name.
    pub fn output(&self, program: &Program, port: Port) -> &[f32] {
        program
            .output_span(port)
            .and_then(|span| self.arena.get(range(span)))
            .unwrap_or(&[])
    }

    /// An integer output of the last run.
    pub fn output_int(&self, program: &Program, port: Port) -> Option<u32> {
        match program.output(port)? {
            Place::Int(slot) => self.ints.get(usize::from(slot.0)).copied(),
            Place::Span(_) => None,
        }
    }

    fn set(&mut self, slot: IntSlot, value: u32) {
        if let Some(int) = self.ints.get_mut(usize::from(slot.0)) {
            *int = value;
        }
    }

    fn op(&mut self, op: &Op, weights: &[f32], past: usize) -> Result<(), ExecError> {
        let span = match op {
            Op::Linear(op) => linear(op, self.isa, weights, self.arena),
            Op::LayerNorm(op) => layer_norm(op, self.isa, weights, self.arena),
            Op::Attention(op) => attention(op, self.isa, past, self.arena, self.cache),
            Op::Binary(op) => binary(op, weights, self.arena),
            Op::Unary(op) => unary(op, self.isa, weights, self.arena),
            Op::Softmax(op) => softmax(op, self.isa, self.arena),
            Op::Reduce(op) => reduce(op, weights, self.arena),
            Op::MatMul(op) => matmul(op, weights, self.arena),
            Op::Copy(op) => copy(op, weights, self.arena),
            Op::GatherRow(op) => return self.gather_row(op, weights),
            Op::ArgMin(op) => self
                .arena
                .get(range(op.x))
                .map(kernels::arg_min)
                .map(|i| self.set(op.out, i as u32)),
            Op::ArgMax(op) => self
                .arena
                .get(range(op.x))
                .map(kernels::arg_max)
                .map(|i| self.set(op.out, i as u32)),
        };
        span.ok_or(ExecError::Span)
    }

    fn gather_row(&mut self, op: &op::GatherRow, weights: &[f32]) -> Result<(), ExecError> {
        let index = self.ints.get(usize::from(op.index.0)).copied().unwrap_or(0);
        let row = i64::from(index).saturating_add(i64::from(op.shift));
        let found = usize::try_from(row).ok().and_then(|row| {
            let table = weights.get(weight_range(op.table))?;
            table.chunks_exact(op.row_len.max(1) as usize).nth(row)
        });
        let from = found.ok_or(ExecError::Index { row, rows: op.rows })?;
        let y = self.arena.get_mut(range(op.y)).ok_or(ExecError::Span)?;
        y.iter_mut().zip(from).for_each(|(y, &x)| *y = x);
        Ok(())
    }
}

fn range(span: Span) -> Range<usize> {
    let start = span.offset as usize;
    start..start.saturating_add(span.len as usize)
}

fn weight_range(span: WeightSpan) -> Range<usize> {
    range(Span {
        offset: span.offset,
        len: span.len,
    })
}

fn state_range(span: StateSpan) -> Range<usize> {
    range(Span {
        offset: span.offset,
        len: span.len,
    })
}

/// What an op reads: the weights, and the arena without the span that the op writes.
struct Readable<'r> {
    weights: &'r [f32],
    below: &'r [f32],
    above: &'r [f32],
    above_start: usize,
}

impl<'r> Readable<'r> {
    /// Cuts the result out of the arena.
    fn cut(weights: &'r [f32], arena: &'r mut [f32], y: Span) -> Option<(Self, &'r mut [f32])> {
        let (below, rest) = arena.split_at_mut_checked(y.offset as usize)?;
        let (y_slice, above) = rest.split_at_mut_checked(y.len as usize)?;
        let above_start = range(y).end;
        Some((
            Self {
                weights,
                below,
                above,
                above_start,
            },
            y_slice,
        ))
    }

    fn get(&self, operand: Operand) -> Option<&'r [f32]> {
        let range = range(Span {
            offset: operand.offset,
            len: operand.len,
        });
        match operand.space {
            Space::Weights => self.weights.get(range),
            Space::Arena if range.end <= self.below.len() => self.below.get(range),
            Space::Arena => {
                let start = range.start.checked_sub(self.above_start)?;
                self.above.get(start..start.saturating_add(range.len()))
            }
        }
    }
}

fn linear(op: &op::Linear, isa: Isa, weights: &[f32], arena: &mut [f32]) -> Option<()> {
    let (read, y) = Readable::cut(weights, arena, op.y)?;
    let bias = op
        .bias
        .map_or(Some(&[][..]), |bias| read.get(bias.into()))?;
    let w = read.get(op.w.into())?;
    // Casts of whole words to smaller numbers: they fail on no span.
    let w = match op.format {
        WeightFormat::F32 => kernels::Panels::F32(w),
        WeightFormat::F16 => kernels::Panels::F16(bytemuck::try_cast_slice(w).ok()?),
        WeightFormat::Bf16 => kernels::Panels::Bf16(bytemuck::try_cast_slice(w).ok()?),
        WeightFormat::Int8 => kernels::Panels::Int8 {
            panels: bytemuck::try_cast_slice(w).ok()?,
            scales: read.get(op.scales?.into())?,
        },
        WeightFormat::Int16 => kernels::Panels::Int16 {
            panels: bytemuck::try_cast_slice(w).ok()?,
            scales: read.get(op.scales?.into())?,
        },
    };
    let layer = kernels::Linear {
        k: op.k as usize,
        n: op.n as usize,
        w,
        bias,
        activation: op.activation,
        accumulate: op.accumulate,
    };
    layer.run(isa, read.get(op.x.into())?, y);
    Some(())
}

fn layer_norm(op: &op::LayerNorm, isa: Isa, weights: &[f32], arena: &mut [f32]) -> Option<()> {
    let (read, y) = Readable::cut(weights, arena, op.y)?;
    let norm = kernels::LayerNorm {
        gamma: read.get(op.gamma.into())?,
        beta: read.get(op.beta.into())?,
        eps: op.eps,
    };
    norm.run(isa, read.get(op.x.into())?, y);
    Some(())
}

fn attention(
    op: &op::Attention,
    isa: Isa,
    past: usize,
    arena: &mut [f32],
    cache: &mut [f32],
) -> Option<()> {
    let (heads, head_dim) = (op.heads as usize, op.head_dim as usize);
    let width = heads.checked_mul(head_dim)?;
    let [keys, values] = cache
        .get_disjoint_mut([state_range(op.cache_k), state_range(op.cache_v)])
        .ok()?;
    // Casts of whole words to smaller numbers: they fail on no span.
    let mut cache = match op.format {
        CacheFormat::F32 => kernels::CacheMut::F32 { keys, values },
        CacheFormat::F16 => kernels::CacheMut::F16 {
            keys: bytemuck::try_cast_slice_mut(keys).ok()?,
            values: bytemuck::try_cast_slice_mut(values).ok()?,
        },
    };
    let append = kernels::Append {
        k: arena.get(range(op.k))?,
        k_stride: op.k_stride as usize,
        v: arena.get(range(op.v))?,
        v_stride: op.v_stride as usize,
        width,
        first: past,
    };
    append.run(isa, &mut cache);
    if op.queries == 0 {
        return Some(());
    }
    let [q, y, scratch] = arena
        .get_disjoint_mut([range(op.q), range(op.y), range(op.scratch)])
        .ok()?;
    let attention = kernels::Attention {
        heads,
        head_dim,
        scale: op.scale,
        q_stride: op.q_stride as usize,
        visible: past
            .saturating_add(op.tokens as usize)
            .saturating_sub(op.queries as usize)
            .saturating_add(1),
        cache: cache.as_ref(),
    };
    attention.run(isa, q, y, scratch);
    Some(())
}

fn binary(op: &op::Binary, weights: &[f32], arena: &mut [f32]) -> Option<()> {
    let (read, y) = Readable::cut(weights, arena, op.y)?;
    let input = |x: Operand, strides: [u32; 4]| {
        if arena_span(x) == Some(op.y) {
            Some(kernels::Input::Output)
        } else {
            Some(kernels::Input::Strided(
                read.get(x)?,
                strides.map(|s| s as usize),
            ))
        }
    };
    let (a, b) = (input(op.a, op.a_strides)?, input(op.b, op.b_strides)?);
    kernels::binary(op.kind, a, b, op.dims.map(|d| d as usize), y);
    Some(())
}

fn unary(op: &op::Unary, isa: Isa, weights: &[f32], arena: &mut [f32]) -> Option<()> {
    let (read, y) = Readable::cut(weights, arena, op.y)?;
    let unary = kernels::Unary {
        kind: op.kind,
        alpha: op.alpha,
    };
    if arena_span(op.x) == Some(op.y) {
        unary.run_in_place(isa, y);
    } else {
        unary.run(isa, read.get(op.x)?, y);
    }
    Some(())
}

fn softmax(op: &op::Softmax, isa: Isa, arena: &mut [f32]) -> Option<()> {
    let (read, y) = Readable::cut(&[], arena, op.y)?;
    kernels::softmax(isa, read.get(op.x.into())?, op.cols as usize, y);
    Some(())
}

fn reduce(op: &op::Reduce, weights: &[f32], arena: &mut [f32]) -> Option<()> {
    let (read, y) = Readable::cut(weights, arena, op.y)?;
    let axis = kernels::Axis {
        len: op.axis as usize,
        inner: op.inner as usize,
    };
    kernels::reduce(op.kind, read.get(op.x)?, axis, y);
    Some(())
}

fn matmul(op: &op::MatMul, weights: &[f32], arena: &mut [f32]) -> Option<()> {
    let (read, y) = Readable::cut(weights, arena, op.y)?;
    let product = kernels::MatMul {
        batch: op.batch as usize,
        m: op.m as usize,
        k: op.k as usize,
        n: op.n as usize,
        a_strides: op.a_strides.map(|s| s as usize),
        b_strides: op.b_strides.map(|s| s as usize),
    };
    product.run(read.get(op.a)?, read.get(op.b)?, y);
    Some(())
}

fn copy(op: &op::Copy, weights: &[f32], arena: &mut [f32]) -> Option<()> {
    let (read, y) = Readable::cut(weights, arena, op.y)?;
    let copy = kernels::StridedCopy {
        dims: op.dims.map(|d| d as usize),
        x_strides: op.x_strides.map(|s| s as usize),
        y_strides: op.y_strides.map(|s| s as usize),
    };
    copy.run(read.get(op.x)?, y);
    Some(())
}
