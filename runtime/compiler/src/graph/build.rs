//! Constructors of nodes. Each constructor checks the shapes, folds constants and simplifies; see
//! the invariants of [`graph`](super).

use std::sync::Arc;

use lads_image::op::{BinaryKind, ReduceKind};

use super::{Dim, Graph, Id, Kind, MAX_FOLDING, Op, Type, Unary, cost, fold, show};
use crate::tensor::{MAX_ELEMENTS, MAX_RANK, Tensor, elements};

/// Refusal of a slice without elements; a value has some.
pub(crate) const EMPTY: &str = "a slice is empty";

/// A node, or the reason why its operands do not fit.
type Built = Result<Id, String>;

/// Returns the shape that two shapes broadcast to, as in numpy.
pub(super) fn broadcast(a: &[Dim], b: &[Dim]) -> Result<Vec<Dim>, String> {
    let rank = a.len().max(b.len());
    let dim = |shape: &[Dim], i: usize| {
        (i + shape.len())
            .checked_sub(rank)
            .map_or(Dim::of(1), |i| shape[i])
    };
    (0..rank)
        .map(|i| match (dim(a, i), dim(b, i)) {
            (a, b) if a == b => Ok(a),
            (a, b) if b.is_one() => Ok(a),
            (a, b) if a.is_one() => Ok(b),
            _ => Err(format!(
                "shapes {} and {} do not broadcast",
                show(a),
                show(b)
            )),
        })
        .collect()
}

/// Returns the number of elements as a polynomial in `P`; `None` if it is not linear.
fn volume(shape: &[Dim]) -> Option<(usize, Vec<usize>)> {
    let mut known = 1usize;
    let mut past = vec![];
    for dim in shape {
        if dim.past {
            past.push(dim.fixed);
        } else {
            known = known.checked_mul(dim.fixed)?;
        }
    }
    past.sort_unstable();
    Some((known, past))
}

impl Graph {
    /// Returns the shape that a shape and a value broadcast to.
    pub fn broadcast(&self, shape: &[Dim], x: Id) -> Result<Vec<Dim>, String> {
        broadcast(shape, self.shape(x))
    }

    /// Folds the node if all its operands are constants, else adds it.
    pub(super) fn fold(&mut self, op: Op, inputs: Vec<Id>, shape: Vec<Dim>, ty: Type) -> Built {
        if shape.len() > MAX_RANK || shape.contains(&Dim::of(0)) {
            return Err(format!(
                "gives {}, which is empty or has more than {MAX_RANK} axes",
                show(&shape)
            ));
        }
        let operands: Option<Vec<Arc<Tensor>>> = inputs
            .iter()
            .map(|&id| self.constant(id).cloned())
            .collect();
        let known: Option<Vec<usize>> = shape.iter().map(|dim| dim.known()).collect();
        // Before anything of that size is computed.
        if known
            .as_ref()
            .is_some_and(|known| elements(known).is_none())
        {
            return Err(format!(
                "gives {}, more than {MAX_ELEMENTS} elements",
                show(&shape)
            ));
        }
        if let (Some(operands), Some(known)) = (operands, known) {
            self.folded = self.folded.saturating_add(cost(&op, &operands, &known));
            if self.folded > MAX_FOLDING {
                return Err(format!(
                    "computes with constants alone, and with the entry's others that takes more than {MAX_FOLDING} operations"
                ));
            }
            if let Some(tensor) = fold(&op, &operands, &known) {
                return Ok(self.add_const(Arc::new(tensor)));
            }
        }
        Ok(self.add(op, inputs, shape, ty))
    }

    pub(super) fn floats(&self, ids: &[Id]) -> Result<(), String> {
        if ids.iter().all(|&id| self.ty(id) == Type::F32) {
            Ok(())
        } else {
            Err("it computes with integers, which only indices may be".into())
        }
    }

    fn axis_len(&self, x: Id, axis: usize) -> Result<Dim, String> {
        self.shape(x)
            .get(axis)
            .copied()
            .ok_or_else(|| format!("axis {axis} of {} does not exist", show(self.shape(x))))
    }

    /// Adds an elementwise binary operation with broadcast.
    pub fn binary(&mut self, kind: BinaryKind, a: Id, b: Id) -> Built {
        let shape = broadcast(self.shape(a), self.shape(b))?;
        if self.ty(a) == Type::I64 && self.ty(b) == Type::I64 {
            return self.integers(kind, a, b, shape);
        }
        self.floats(&[a, b])?;
        let neutral = |id: Id| {
            let value = self.constant(id).and_then(|tensor| tensor.uniform());
            match kind {
                BinaryKind::Add | BinaryKind::Sub => value == Some(0.0),
                BinaryKind::Mul | BinaryKind::Div => value == Some(1.0),
                _ => false,
            }
        };
        if neutral(b) && self.shape(a) == shape {
            return Ok(a);
        }
        let commutes = matches!(kind, BinaryKind::Add | BinaryKind::Mul);
        if commutes && neutral(a) && self.shape(b) == shape {
            return Ok(b);
        }
        self.fold(Op::Binary(Kind(kind)), vec![a, b], shape, Type::F32)
    }

    /// Builds sums and differences of an integer and a constant as shifts; of constants, as
    /// constants.
    fn integers(&mut self, kind: BinaryKind, a: Id, b: Id, shape: Vec<Dim>) -> Built {
        let single = |graph: &Self, id: Id| match graph.constant(id)?.as_i64()? {
            &[value] => Some(value),
            _ => None,
        };
        let shifted = match (kind, single(self, a), single(self, b)) {
            (BinaryKind::Add, None, Some(by)) => Some((a, by)),
            (BinaryKind::Add, Some(by), None) => Some((b, by)),
            (BinaryKind::Sub, None, Some(by)) => by.checked_neg().map(|by| (a, by)),
            _ => None,
        };
        if let Some((x, by)) = shifted
            && self.constant(x).is_none()
        {
            let x = self.reshape(x, &shape)?;
            return self.shift(x, by);
        }
        let id = self.fold(Op::Binary(Kind(kind)), vec![a, b], shape, Type::I64)?;
        if self.constant(id).is_none() {
            return Err("it computes with integers that are not constant; only an index plus or minus a constant is supported".into());
        }
        Ok(id)
    }

    pub(super) fn shift(&mut self, x: Id, by: i64) -> Built {
        let (x, by) = match *self.op(x) {
            Op::Shift(inner) => (
                self.node(x).inputs[0],
                inner.checked_add(by).ok_or("the index overflows")?,
            ),
            _ => (x, by),
        };
        if by == 0 {
            return Ok(x);
        }
        let shape = self.shape(x).to_vec();
        Ok(self.add(Op::Shift(by), vec![x], shape, Type::I64))
    }

    /// Adds an elementwise unary operation.
    pub fn unary(&mut self, unary: Unary, x: Id) -> Built {
        self.floats(&[x])?;
        let shape = self.shape(x).to_vec();
        self.fold(Op::Unary(unary), vec![x], shape, Type::F32)
    }

    /// Adds a product over the last two axes.
    pub fn matmul(&mut self, a: Id, b: Id) -> Built {
        self.floats(&[a, b])?;
        let (sa, sb) = (self.shape(a).to_vec(), self.shape(b).to_vec());
        let (&[ref batch_a @ .., m, ka], &[ref batch_b @ .., kb, n]) = (&sa[..], &sb[..]) else {
            return Err(format!(
                "a product of {} and {} is not supported",
                show(&sa),
                show(&sb)
            ));
        };
        if ka != kb {
            return Err(format!(
                "shapes {} and {} do not multiply",
                show(&sa),
                show(&sb)
            ));
        }
        let mut shape = broadcast(batch_a, batch_b)?;
        shape.extend([m, n]);
        self.fold(Op::MatMul, vec![a, b], shape, Type::F32)
    }

    /// Adds a softmax, `exp(x) / sum(exp(x))`, over an axis.
    pub fn softmax(&mut self, x: Id, axis: usize) -> Built {
        self.floats(&[x])?;
        self.axis_len(x, axis)?;
        let rank = self.shape(x).len();
        let mut perm: Vec<usize> = (0..rank).collect();
        perm.swap(axis, rank - 1);
        let turned = self.transpose(x, &perm)?;
        let shape = self.shape(turned).to_vec();
        let y = self.fold(Op::Softmax, vec![turned], shape, Type::F32)?;
        self.transpose(y, &perm)
    }

    /// Adds a reduction of one axis, which is removed.
    pub fn reduce(&mut self, kind: ReduceKind, x: Id, axis: usize) -> Built {
        self.floats(&[x])?;
        self.axis_len(x, axis)?;
        let mut shape = self.shape(x).to_vec();
        shape.remove(axis);
        self.fold(Op::Reduce(Kind(kind), axis), vec![x], shape, Type::F32)
    }

    /// Adds a layer norm over the last axis; `gamma` and `beta` are constants of its length.
    pub fn layer_norm(&mut self, x: Id, gamma: Id, beta: Id, eps: f32) -> Built {
        self.floats(&[x, gamma, beta])?;
        let shape = self.shape(x).to_vec();
        let cols = *shape.last().ok_or("a scalar has no axis to normalise")?;
        for id in [gamma, beta] {
            if self.constant(id).is_none() || self.shape(id) != [cols] {
                return Err(format!(
                    "scale and bias must be constants of shape [{cols}]"
                ));
            }
        }
        let op = Op::LayerNorm { eps: eps.to_bits() };
        Ok(self.add(op, vec![x, gamma, beta], shape, Type::F32))
    }

    /// Adds a reshape: the same elements in another shape.
    pub fn reshape(&mut self, x: Id, shape: &[Dim]) -> Built {
        let x = match self.op(x) {
            Op::Reshape => self.node(x).inputs[0],
            _ => x,
        };
        if self.shape(x) == shape {
            return Ok(x);
        }
        let same = volume(self.shape(x)).is_some() && volume(self.shape(x)) == volume(shape);
        if !same {
            return Err(format!(
                "{} does not reshape to {}",
                show(self.shape(x)),
                show(shape)
            ));
        }
        let ty = self.ty(x);
        self.fold(Op::Reshape, vec![x], shape.to_vec(), ty)
    }

    /// Adds a transpose: axis `i` of the result is axis `perm[i]` of `x`.
    pub fn transpose(&mut self, x: Id, perm: &[usize]) -> Built {
        let rank = self.shape(x).len();
        let mut sorted = perm.to_vec();
        sorted.sort_unstable();
        if !sorted.into_iter().eq(0..rank) {
            return Err(format!(
                "{perm:?} is not a permutation of the axes of {}",
                show(self.shape(x))
            ));
        }
        let (x, perm) = match self.op(x) {
            Op::Transpose(inner) => {
                let perm = perm.iter().map(|&axis| inner[axis]).collect();
                (self.node(x).inputs[0], perm)
            }
            _ => (x, perm.to_vec()),
        };
        let shape: Vec<Dim> = perm.iter().map(|&axis| self.shape(x)[axis]).collect();
        let moved: Vec<usize> = perm
            .iter()
            .copied()
            .filter(|&axis| !self.shape(x)[axis].is_one())
            .collect();
        if moved.is_sorted() {
            return self.reshape(x, &shape);
        }
        let ty = self.ty(x);
        self.fold(Op::Transpose(perm), vec![x], shape, ty)
    }

    /// Adds a slice `start..start + len` of an axis.
    pub fn slice(&mut self, x: Id, axis: usize, start: usize, len: usize) -> Built {
        let whole = self.axis_len(x, axis)?;
        if len == 0 {
            return Err(EMPTY.into());
        }
        if whole == Dim::of(len) && start == 0 {
            return Ok(x);
        }
        let fits = whole
            .known()
            .is_some_and(|whole| start.checked_add(len).is_some_and(|end| end <= whole));
        if !fits {
            return Err(format!(
                "slice {start}..{} of axis {axis} of {}",
                start.saturating_add(len),
                show(self.shape(x))
            ));
        }
        if let Op::Slice {
            axis: inner,
            start: before,
        } = *self.op(x)
            && inner == axis
        {
            return self.slice(self.node(x).inputs[0], axis, before + start, len);
        }
        if let Op::Concat { axis: inner } = *self.op(x)
            && inner == axis
            && let Some((part, start)) = self.part_of(x, axis, start, len)
        {
            return self.slice(part, axis, start, len);
        }
        let mut shape = self.shape(x).to_vec();
        shape[axis] = Dim::of(len);
        let ty = self.ty(x);
        self.fold(Op::Slice { axis, start }, vec![x], shape, ty)
    }

    /// Returns the operand of a concatenation that holds a slice as a whole, and the slice's start
    /// in it.
    fn part_of(&self, concat: Id, axis: usize, start: usize, len: usize) -> Option<(Id, usize)> {
        let mut at = 0;
        for &part in &self.node(concat).inputs {
            let part_len = self.shape(part)[axis].known()?;
            if (at..=at + part_len).contains(&start) && start + len <= at + part_len {
                return Some((part, start - at));
            }
            at += part_len;
        }
        None
    }

    /// Adds a concatenation of the parts along an axis.
    pub fn concat(&mut self, parts: &[Id], axis: usize) -> Built {
        let &[first, ref rest @ ..] = parts else {
            return Err("nothing to concatenate".into());
        };
        let mut shape = self.shape(first).to_vec();
        let ty = self.ty(first);
        self.axis_len(first, axis)?;
        for &part in rest {
            let other = self.shape(part);
            let fits = other.len() == shape.len()
                && (0..shape.len()).all(|i| i == axis || shape[i] == other[i]);
            let sum = self.axis_len(part, axis)?;
            if !fits || self.ty(part) != ty || (sum.past && shape[axis].past) {
                return Err(format!(
                    "{} and {} do not concatenate along axis {axis}",
                    show(&shape),
                    show(other)
                ));
            }
            shape[axis].fixed += sum.fixed;
            shape[axis].past |= sum.past;
        }
        if rest.is_empty() {
            return Ok(first);
        }
        self.fold(Op::Concat { axis }, parts.to_vec(), shape, ty)
    }

    /// Adds a broadcast to a larger shape.
    pub fn expand(&mut self, x: Id, shape: &[Dim]) -> Built {
        let shape = broadcast(self.shape(x), shape)?;
        if self.shape(x) == shape {
            return Ok(x);
        }
        let ty = self.ty(x);
        self.fold(Op::Expand, vec![x], shape, ty)
    }

    /// Adds a lookup of rows of `table` along its first axis, by an integer of one element.
    pub fn gather_row(&mut self, table: Id, index: Id) -> Built {
        let shape = self.shape(table).to_vec();
        if shape.is_empty() || self.known_shape(table).is_none() {
            return Err("the table that is looked up must have rows of known length".into());
        }
        if self.ty(index) != Type::I64 || self.shape(index).iter().any(|dim| !dim.is_one()) {
            return Err(format!(
                "the index must be one integer, not {}",
                show(self.shape(index))
            ));
        }
        let ty = self.ty(table);
        self.fold(Op::GatherRow, vec![table, index], shape[1..].to_vec(), ty)
    }

    /// Adds a conversion of one number to an integer, truncated.
    pub fn index_of(&mut self, x: Id) -> Built {
        self.floats(&[x])?;
        let shape = self.shape(x).to_vec();
        if shape.iter().any(|dim| !dim.is_one()) {
            return Err(format!(
                "makes {} integers at once, one is supported",
                show(&shape)
            ));
        }
        self.fold(Op::ToIndex, vec![x], shape, Type::I64)
    }

    /// Adds a conversion of one integer to a number.
    pub fn number_of(&mut self, x: Id) -> Built {
        let shape = self.shape(x).to_vec();
        if self.ty(x) != Type::I64 || shape.iter().any(|dim| !dim.is_one()) {
            return Err(format!("reads {} as one integer", show(self.shape(x))));
        }
        self.fold(Op::FromIndex, vec![x], shape, Type::F32)
    }

    /// Adds the index of the first smallest or largest of all elements.
    pub fn arg(&mut self, op: Op, x: Id) -> Built {
        self.floats(&[x])?;
        self.fold(op, vec![x], vec![], Type::I64)
    }

    /// Adds a fused linear layer; see [`Op::Linear`].
    pub fn linear(&mut self, op: Op, inputs: Vec<Id>) -> Built {
        let mut shape = self.shape(inputs[0]).to_vec();
        let n = self.axis_len(inputs[1], 1)?;
        *shape.last_mut().ok_or("a scalar is not a row")? = n;
        Ok(self.add(op, inputs, shape, Type::F32))
    }

    /// Adds [`Op::Attention`] or [`Op::Record`]; the result has the shape of the first operand.
    pub fn cached(&mut self, op: Op, inputs: Vec<Id>) -> Id {
        let shape = self.shape(inputs[0]).to_vec();
        self.add(op, inputs, shape, Type::F32)
    }
}
