//! Lowers each kind of node to an op or a view.

use lads_image::op::{
    self, Activation, ArgMax, ArgMin, Binary, BinaryKind, Copy, FromIndex, GatherRow, LayerNorm,
    Linear, MatMul, Reduce, ReduceKind, Softmax, Span, ToIndex, UnaryKind, WeightSpan,
};

use super::Lowering;
use super::view::{View, four};
use crate::graph::{Id, Op, Type, Unary};
use crate::report::LayerReport;

pub(super) type Done = Result<(), String>;

pub(super) fn product(shape: &[usize]) -> usize {
    shape.iter().product()
}

impl Lowering<'_, '_> {
    /// Lowers one node, whose operands are already lowered.
    pub(super) fn node(&mut self, id: Id) -> Done {
        let computed = matches!(self.g.op(id), Op::ArgMin | Op::ArgMax | Op::ToIndex);
        if self.g.ty(id) == Type::I64 && !computed {
            return self.integer(id);
        }
        let x = self.g.node(id).inputs.clone();
        match self.g.op(id).clone() {
            Op::Input | Op::Const(_) => Ok(()),
            Op::Reshape => self.reshape(id, x[0]),
            Op::Transpose(perm) => {
                let view = self.view(x[0])?;
                let strides = perm.iter().map(|&axis| view.strides[axis]).collect();
                self.set(id, view.with(view.offset, strides));
                Ok(())
            }
            Op::Slice { axis, start } => {
                let view = self.view(x[0])?;
                self.set(
                    id,
                    view.with(
                        view.offset + start * view.strides[axis],
                        view.strides.clone(),
                    ),
                );
                Ok(())
            }
            Op::Expand => {
                let view = self.view(x[0])?;
                let strides = view.broadcast(&self.shape(x[0])?, &self.shape(id)?);
                self.set(id, view.with(view.offset, strides));
                Ok(())
            }
            Op::Concat { axis } => self.concat(id, &x, axis),
            Op::Binary(kind) => self.binary(id, kind.0, x[0], x[1]),
            Op::Unary(unary) => self.unary(id, unary, x[0]),
            Op::Softmax => self.softmax(id, x[0]),
            Op::Reduce(kind, axis) => self.reduce(id, kind.0, x[0], axis),
            Op::LayerNorm { eps } => self.layer_norm(id, &x, f32::from_bits(eps)),
            Op::MatMul => self.matmul(id, x[0], x[1]),
            Op::GatherRow => self.gather_row(id, x[0], x[1]),
            Op::Linear {
                bias,
                residual,
                activation,
            } => self.linear(id, &x, bias, residual, activation),
            Op::Conv(conv) => self.conv(id, &x, conv),
            Op::Pool(kind, windows) => self.pool(id, x[0], kind.0, &windows),
            Op::Resize => self.resize(id, &x),
            Op::Attention { layer, scale, .. } => {
                self.attention(id, &x, layer, f32::from_bits(scale))
            }
            Op::Record { layer, .. } => self.record(x[0], x[1], layer),
            Op::ToIndex => self.arg(id, x[0], |x, out| ToIndex { x, out }.into()),
            Op::FromIndex => self.number_of(id, x[0]),
            Op::ArgMin => self.arg(id, x[0], |x, out| ArgMin { x, out }.into()),
            Op::ArgMax => self.arg(id, x[0], |x, out| ArgMax { x, out }.into()),
            Op::Shift(_) => Err("adds to a value that is not an integer".into()),
        }
    }

    /// Lowers an integer, which is a slot and a number that is added to it.
    fn integer(&mut self, id: Id) -> Done {
        let node = self.g.node(id);
        let known = |input: Id| self.ints.get(&input).copied();
        let int = match node.op {
            Op::Input => known(id),
            Op::Const(_) => return Ok(()),
            Op::Reshape => known(node.inputs[0]),
            Op::Shift(by) => {
                known(node.inputs[0]).and_then(|(slot, shift)| Some((slot, shift.checked_add(by)?)))
            }
            _ => None,
        };
        let int = int.ok_or("computes with integers, which only indices may be")?;
        self.ints.insert(id, int);
        Ok(())
    }

    fn reshape(&mut self, id: Id, x: Id) -> Done {
        let view = self.view(x)?;
        let (from, to) = (self.shape(x)?, self.shape(id)?);
        let view = if let Some(strides) = view.reshaped(&from, &to) {
            view.with(view.offset, strides)
        } else {
            let buffer = self.buffer(product(&from));
            self.copy(x, &View::contiguous(buffer, 0, &from), &from)?;
            View::contiguous(buffer, 0, &to)
        };
        self.set(id, view);
        Ok(())
    }

    /// Copies the parts that were not computed in their place.
    fn concat(&mut self, id: Id, parts: &[Id], axis: usize) -> Done {
        let shape = self.shape(id)?;
        let whole = self.allocate(id, &shape);
        let mut start = 0;
        for &part in parts {
            let part_shape = self.shape(part)?;
            let place = whole.with(
                whole.offset + start * whole.strides[axis],
                whole.strides.clone(),
            );
            let there = self.view(part)?;
            let same = there.buffer() == place.buffer()
                && there.offset == place.offset
                && there.is_contiguous(&part_shape);
            if !(same && place.is_contiguous(&part_shape)) {
                self.copy(part, &place, &part_shape)?;
            }
            start += part_shape[axis];
        }
        self.set(id, whole);
        Ok(())
    }

    /// Copies a value to a view.
    pub(super) fn copy(&mut self, x: Id, to: &View, shape: &[usize]) -> Done {
        let from = self.view(x)?;
        let (dims, [x_strides, y_strides]) =
            four(shape, [&from.strides, &to.strides]).ok_or("moves more than four axes at once")?;
        let x = self.operand(&from, from.reach(shape));
        let y = self.span(to, to.reach(shape));
        self.ops.push(
            Copy {
                x,
                y,
                dims,
                x_strides,
                y_strides,
            }
            .into(),
        );
        Ok(())
    }

    /// Returns the place of an elementwise result: the operand's own if it has no other reader,
    /// else a new one.
    fn in_place(&mut self, id: Id, operands: &[Id]) -> Result<View, String> {
        let shape = self.shape(id)?;
        if !self.placed.contains_key(&id) {
            for &x in operands {
                let view = self.view(x)?;
                let Some(buffer) = view.buffer() else {
                    continue;
                };
                let fits = self.shape(x)? == shape
                    && view.is_contiguous(&shape)
                    && self.dies_here(buffer, id);
                // Another operand in the same buffer would have to be exactly the same elements.
                let mut apart = true;
                for &other in operands {
                    let other = self.view(other)?;
                    apart &= other.buffer() != Some(buffer) || other == view;
                }
                if fits && apart {
                    return Ok(view);
                }
            }
        }
        Ok(self.allocate(id, &shape))
    }

    fn binary(&mut self, id: Id, kind: BinaryKind, a: Id, b: Id) -> Done {
        let shape = self.shape(id)?;
        let y = self.in_place(id, &[a, b])?;
        let (view_a, view_b) = (self.view(a)?, self.view(b)?);
        let strides_a = view_a.broadcast(&self.shape(a)?, &shape);
        let strides_b = view_b.broadcast(&self.shape(b)?, &shape);
        let (dims, [a_strides, b_strides, _]) = four(&shape, [&strides_a, &strides_b, &y.strides])
            .ok_or("broadcasts over more than four axes")?;
        let operand = |view: &View, strides: &[usize]| {
            self.operand(view, view.with(0, strides.to_vec()).reach(&shape))
        };
        let (a, b) = (operand(&view_a, &strides_a), operand(&view_b, &strides_b));
        let op = Binary {
            kind,
            a,
            b,
            y: self.span(&y, product(&shape)),
            dims,
            a_strides,
            b_strides,
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    fn unary(&mut self, id: Id, unary: Unary, x: Id) -> Done {
        let shape = self.shape(id)?;
        let view = self.view(x)?;
        let (y, x) = if view.is_contiguous(&shape) {
            (
                self.in_place(id, &[x])?,
                self.operand(&view, product(&shape)),
            )
        } else {
            let x = self.contiguous(x)?;
            (self.allocate(id, &shape), x.into())
        };
        let op = op::Unary {
            kind: unary.kind.0,
            alpha: f32::from_bits(unary.alpha),
            x,
            y: self.span(&y, product(&shape)),
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    fn softmax(&mut self, id: Id, x: Id) -> Done {
        let shape = self.shape(id)?;
        let x = self.contiguous(x)?;
        let y = self.allocate(id, &shape);
        let cols = shape.last().copied().unwrap_or(1);
        let op = Softmax {
            x,
            y: self.span(&y, product(&shape)),
            rows: (product(&shape) / cols) as u32,
            cols: cols as u32,
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    fn reduce(&mut self, id: Id, kind: ReduceKind, x: Id, axis: usize) -> Done {
        let (from, shape) = (self.shape(x)?, self.shape(id)?);
        let x = self.contiguous(x)?.into();
        let y = self.allocate(id, &shape);
        let (outer, inner) = (
            product(&from[..axis]) as u32,
            product(&from[axis + 1..]) as u32,
        );
        let op = Reduce {
            kind,
            x,
            y: self.span(&y, product(&shape)),
            outer,
            axis: from[axis] as u32,
            inner,
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    fn layer_norm(&mut self, id: Id, x: &[Id], eps: f32) -> Done {
        let shape = self.shape(id)?;
        let (gamma, beta) = (self.plain(x[1])?, self.plain(x[2])?);
        let x = self.contiguous(x[0])?;
        let y = self.allocate(id, &shape);
        let cols = gamma.len;
        let op = LayerNorm {
            x,
            y: self.span(&y, product(&shape)),
            gamma,
            beta,
            rows: x.len / cols,
            cols,
            eps,
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    /// Stores a constant in the weights.
    pub(super) fn plain(&mut self, id: Id) -> Result<WeightSpan, String> {
        let tensor = self
            .g
            .constant(id)
            .cloned()
            .ok_or("reads weights that are not constant")?;
        self.weights.plain(&tensor)
    }

    fn matmul(&mut self, id: Id, a: Id, b: Id) -> Done {
        let shape = self.shape(id)?;
        let (batch, last) = shape.split_at(shape.len() - 2);
        let side = |this: &mut Self, x: Id| -> Result<(View, [u32; 3], usize), String> {
            let own = this.shape(x)?;
            let (lead, matrix) = own.split_at(own.len() - 2);
            let view = this.view(x)?;
            let (lead_strides, matrix_strides) = view.strides.split_at(lead.len());
            let strides = view.with(0, lead_strides.to_vec()).broadcast(lead, batch);
            // The batch axes have to lie at one stride.
            let (dims, [strides]) =
                four(batch, [&strides]).ok_or("has more than four batch axes")?;
            if dims[..3].iter().any(|&dim| dim != 1) {
                return Err("broadcasts over several batch axes".into());
            }
            let batch_stride = strides[3];
            let reach = view.with(0, matrix_strides.to_vec()).reach(matrix)
                + (product(batch) - 1) * batch_stride as usize;
            let strides = [
                batch_stride,
                matrix_strides[0] as u32,
                matrix_strides[1] as u32,
            ];
            Ok((view, strides, reach))
        };
        let k = self.shape(a)?.last().copied().unwrap_or(1) as u32;
        let (view_a, a_strides, reach_a) = side(self, a)?;
        let (view_b, b_strides, reach_b) = side(self, b)?;
        let y = self.allocate(id, &shape);
        let op = MatMul {
            a: self.operand(&view_a, reach_a),
            b: self.operand(&view_b, reach_b),
            y: self.span(&y, product(&shape)),
            batch: product(batch) as u32,
            m: last[0] as u32,
            k,
            n: last[1] as u32,
            a_strides,
            b_strides,
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    fn gather_row(&mut self, id: Id, table: Id, index: Id) -> Done {
        let shape = self.shape(id)?;
        let rows = self.shape(table)?[0] as u32;
        let &(slot, shift) = self
            .ints
            .get(&index)
            .ok_or("looks up with an index that is not computed")?;
        let shift = i32::try_from(shift).map_err(|_| "adds too much to an index")?;
        let table = if self.g.constant(table).is_some() {
            self.plain(table)?.into()
        } else {
            self.contiguous(table)?.into()
        };
        let y = self.allocate(id, &shape);
        let op = GatherRow {
            table,
            row_len: product(&shape) as u32,
            rows,
            index: slot,
            shift,
            y: self.span(&y, product(&shape)),
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    fn number_of(&mut self, id: Id, x: Id) -> Done {
        let shape = self.shape(id)?;
        let &(index, shift) = self
            .ints
            .get(&x)
            .ok_or("reads an integer that is not computed")?;
        let shift = i32::try_from(shift).map_err(|_| "adds too much to an index")?;
        let y = self.allocate(id, &shape);
        let op = FromIndex {
            index,
            shift,
            y: self.span(&y, 1),
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    fn linear(
        &mut self,
        id: Id,
        x: &[Id],
        bias: bool,
        residual: bool,
        activation: Option<Unary>,
    ) -> Done {
        let shape = self.shape(id)?;
        let matrix = self
            .g
            .constant(x[1])
            .cloned()
            .ok_or("reads weights that are not constant")?;
        let (_, node) = self.g.origin(id);
        let packed = self.weights.packed(&matrix, node)?;
        let bias = if bias { Some(self.plain(x[2])?) } else { None };
        let rows = self.contiguous(x[0])?;
        let y = match x.last() {
            Some(&to) if residual => self.accumulator(id, x[0], to)?,
            _ => self.allocate(id, &shape),
        };
        let (k, n) = (matrix.shape[0] as u32, matrix.shape[1] as u32);
        self.layers.push(LayerReport {
            node: node.to_owned(),
            weights: matrix.shape[0] * matrix.shape[1],
            format: packed.format,
            words: packed.w.offset as usize..(packed.w.offset + packed.w.len) as usize,
        });
        let op = Linear {
            x: rows,
            format: packed.format,
            w: packed.w,
            scales: packed.scales,
            bias,
            y: self.span(&y, product(&shape)),
            m: rows.len / k,
            k,
            n,
            activation: activation.map_or(Activation::None, activation_of),
            accumulate: residual,
        };
        self.ops.push(op.into());
        self.set(id, y);
        Ok(())
    }

    /// Returns the place that a layer is added to: the residual itself if it has no other reader,
    /// else a copy.
    fn accumulator(&mut self, id: Id, x: Id, residual: Id) -> Result<View, String> {
        let shape = self.shape(id)?;
        let view = self.view(residual)?;
        if let Some(buffer) = view.buffer()
            && view.is_contiguous(&shape)
        {
            // A residual that was placed where the layer belongs has no other reader.
            let there = self
                .placed
                .get(&id)
                .map(|&place| place == (buffer, view.offset));
            let apart = self.view(x)?.buffer() != Some(buffer);
            if there.unwrap_or_else(|| apart && self.dies_here(buffer, id)) {
                return Ok(view);
            }
        }
        let y = self.allocate(id, &shape);
        self.copy(residual, &y, &shape)?;
        Ok(y)
    }

    fn arg(&mut self, id: Id, x: Id, op: impl FnOnce(Span, op::IntSlot) -> op::Op) -> Done {
        let x = self.contiguous(x)?;
        let slot = self.slot();
        self.ops.push(op(x, slot));
        self.ints.insert(id, (slot, 0));
        Ok(())
    }
}

pub(super) fn activation_of(unary: Unary) -> Activation {
    match unary.kind.0 {
        UnaryKind::Relu => Activation::Relu,
        UnaryKind::LeakyRelu => Activation::LeakyRelu(f32::from_bits(unary.alpha)),
        UnaryKind::Tanh => Activation::Tanh,
        UnaryKind::Sigmoid => Activation::Sigmoid,
        UnaryKind::Elu => Activation::Elu(f32::from_bits(unary.alpha)),
        UnaryKind::Softplus => Activation::Softplus,
        UnaryKind::Mish => Activation::Mish,
        // The fusion takes in no other.
        _ => Activation::None,
    }
}
