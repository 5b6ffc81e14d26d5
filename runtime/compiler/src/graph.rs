//! The compiler's own graph: one node per value, in single assignment, built through constructors that simplify.
//!
//! Invariants:
//! - a node's operands have smaller ids than the node itself, so a graph has no cycles;
//! - equal nodes are the same node (constants excepted), so two spellings of one value compare equal by id;
//! - a node that depends on constants only is itself a constant;
//! - a reshape never follows a reshape, a transpose never a transpose, and transposes that move no element are reshapes.
//!
//! The only symbolic axis is the context length `P`, and a length is `n` or `P + n`.
//! What can fail: constructors report a shape that does not fit as text, the importer adds the node.

mod build;
mod eval;
mod images;
mod rewrite;

use std::collections::HashMap;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use lads_image::op::{BinaryKind, PoolKind, ReduceKind, UnaryKind};

use crate::tensor::{Data, Tensor};

pub(crate) use build::EMPTY;
#[cfg(test)]
pub(crate) use eval::apply;
pub(crate) use eval::{MAX_FOLDING, Value, cost, evaluate, fold};
pub(crate) use images::{ConvOp, Windows, channels_first, channels_last};
pub(crate) use rewrite::{Rewriter, topological};

/// Length of an axis: `fixed`, or `P + fixed`.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Dim {
    pub fixed: usize,
    pub past: bool,
}

impl Dim {
    pub const fn of(fixed: usize) -> Self {
        Self { fixed, past: false }
    }

    pub const fn past(fixed: usize) -> Self {
        Self { fixed, past: true }
    }

    pub fn is_one(self) -> bool {
        self == Self::of(1)
    }

    pub fn known(self) -> Option<usize> {
        (!self.past).then_some(self.fixed)
    }
}

impl fmt::Display for Dim {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match (self.past, self.fixed) {
            (false, n) => write!(f, "{n}"),
            (true, 0) => write!(f, "P"),
            (true, n) => write!(f, "P+{n}"),
        }
    }
}

impl fmt::Debug for Dim {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Formats a shape for messages: `[1, P+2, 32]`.
pub(crate) fn show(shape: &[Dim]) -> String {
    format!("{shape:?}")
}

/// Element type of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Type {
    F32,
    I64,
}

/// Identifies a node, and the value that it computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Id(u32);

/// Wrapper that makes one of the core's enums part of a hash key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Kind<T>(pub T);

impl Hash for Kind<BinaryKind> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        (self.0 as u32).hash(state);
    }
}

impl Hash for Kind<ReduceKind> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        (self.0 as u32).hash(state);
    }
}

impl Hash for Kind<PoolKind> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        (self.0 as u32).hash(state);
    }
}

impl Hash for Kind<UnaryKind> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        (self.0 as u32).hash(state);
    }
}

/// A non-linearity with its parameter, comparable bit for bit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Unary {
    pub kind: Kind<UnaryKind>,
    /// Slope of `LeakyRelu`, factor of `Elu`, as bits.
    pub alpha: u32,
}

impl Unary {
    /// Makes a non-linearity with a parameter.
    pub fn with(kind: UnaryKind, alpha: f32) -> Self {
        Self {
            kind: Kind(kind),
            alpha: alpha.to_bits(),
        }
    }

    pub fn of(kind: UnaryKind) -> Self {
        Self {
            kind: Kind(kind),
            alpha: 0,
        }
    }
}

/// Operation of a node. Floating-point attributes are kept as bits, so that nodes compare.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) enum Op {
    /// Value that the caller sets.
    Input,
    /// Constant with this number.
    Const(usize),
    /// Product over the last two axes, the others broadcast.
    MatMul,
    /// Elementwise binary operation, broadcast.
    Binary(Kind<BinaryKind>),
    /// Elementwise unary operation.
    Unary(Unary),
    /// Softmax over the last axis.
    Softmax,
    /// Reduction of one axis, which is removed.
    Reduce(Kind<ReduceKind>, usize),
    /// Layer normalisation of `x, gamma, beta` over the last axis.
    LayerNorm { eps: u32 },
    /// Reshape: the same elements in another shape.
    Reshape,
    /// Transpose: axis `i` of the result is axis `perm[i]` of the operand.
    Transpose(Vec<usize>),
    /// Slice `start..start + len` of an axis.
    Slice { axis: usize, start: usize },
    /// Concatenation of the operands along an axis.
    Concat { axis: usize },
    /// Broadcast to a larger shape.
    Expand,
    /// Addition of a constant to an integer.
    Shift(i64),
    /// Lookup in a constant `[rows, ..]` by an integer of one element; the result has shape `[..]`.
    GatherRow,
    /// Conversion of a number of one element to an integer, truncated.
    ToIndex,
    /// Conversion of an integer of one element to a number.
    FromIndex,
    /// Index of the first smallest of all elements, shape `[]`.
    ArgMin,
    /// Index of the first largest of all elements, shape `[]`.
    ArgMax,
    /// Linear layer `x·W + b` over the last axis of `x`, operands `x, W [k, n]`, then `b [n]` if
    /// `bias`, then the residual, to which the result is added, if `residual`.
    Linear {
        bias: bool,
        residual: bool,
        activation: Option<Unary>,
    },
    /// Causal attention of `q [queries, w]` over the cache of a layer after `k, v [tokens, w]` were appended; the result is `[queries, w]`.
    Attention {
        layer: usize,
        heads: usize,
        scale: u32,
    },
    /// Convolution of images `x [N, rows, columns, C]` or sequences `[N, columns, C]`: operands
    /// `x`, `W [kernel * C / groups, n]`, `b [n]`, then the padding's pixel `[C]` if `fill`, then
    /// the residual, which is added before the activation, if `residual`.
    Conv(ConvOp),
    /// Pooling of windows over images or sequences, channels last.
    Pool(Kind<PoolKind>, Windows),
    /// Resizing of images `[N, rows, columns, C]`, operands `x`, tables `[rows, 3]` and
    /// `[columns, 3]`.
    Resize,
    /// Appending of `k, v [tokens, w]` to the cache of a layer, without a result.
    Record { layer: usize, heads: usize },
}

/// One node of the graph.
#[derive(Debug, Clone)]
pub(crate) struct Node {
    pub op: Op,
    pub inputs: Vec<Id>,
    pub shape: Vec<Dim>,
    pub ty: Type,
    /// Index of the ONNX node that it came from, see [`Graph::origins`].
    pub origin: usize,
}

type Key = (Op, Vec<Id>, Vec<Dim>, Type);

/// A graph under construction; see the module.
#[derive(Debug, Default)]
pub(crate) struct Graph {
    nodes: Vec<Node>,
    consts: Vec<Arc<Tensor>>,
    seen: HashMap<Key, Id>,
    /// Operator and name of the ONNX nodes that the nodes came from.
    origins: Vec<(String, String)>,
    /// Origin of the nodes that are being built.
    current: usize,
    /// Cost of constant folding so far, see [`cost`](eval::cost).
    folded: usize,
}

impl Graph {
    /// Sets the ONNX node that the nodes built from now on come from.
    pub fn set_origin(&mut self, operator: &str, name: &str) {
        self.current = self.origins.len();
        self.origins.push((operator.into(), name.into()));
    }

    /// Returns operator and name of the ONNX node that a node came from.
    pub fn origin(&self, id: Id) -> (&str, &str) {
        self.origins
            .get(self.node(id).origin)
            .map_or(("Input", ""), |(operator, name)| (operator, name))
    }

    pub fn node(&self, id: Id) -> &Node {
        &self.nodes[id.0 as usize]
    }

    pub fn op(&self, id: Id) -> &Op {
        &self.node(id).op
    }

    pub fn shape(&self, id: Id) -> &[Dim] {
        &self.node(id).shape
    }

    pub fn ty(&self, id: Id) -> Type {
        self.node(id).ty
    }

    /// Returns the shape, if it does not depend on the context length.
    pub fn known_shape(&self, id: Id) -> Option<Vec<usize>> {
        self.shape(id).iter().map(|dim| dim.known()).collect()
    }

    /// Returns the constant of a node, if it is one.
    pub fn constant(&self, id: Id) -> Option<&Arc<Tensor>> {
        match self.node(id).op {
            Op::Const(number) => self.consts.get(number),
            _ => None,
        }
    }

    /// Returns all ids, operands before users.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = Id> + use<> {
        (0..self.nodes.len()).map(|i| Id(i as u32))
    }

    /// Adds a value that the caller sets.
    pub fn input(&mut self, name: &str, shape: &[Dim], ty: Type) -> Id {
        self.set_origin("Input", name);
        self.push(Op::Input, vec![], shape.to_vec(), ty)
    }

    /// Adds a constant.
    pub fn add_const(&mut self, tensor: Arc<Tensor>) -> Id {
        let shape = tensor.shape.iter().map(|&dim| Dim::of(dim)).collect();
        let ty = match tensor.data {
            Data::F32(_) => Type::F32,
            Data::I64(_) => Type::I64,
        };
        // The same initializer, read by several nodes, is one constant.
        let number = self
            .consts
            .iter()
            .position(|known| Arc::ptr_eq(known, &tensor))
            .unwrap_or_else(|| {
                self.consts.push(tensor);
                self.consts.len() - 1
            });
        self.add(Op::Const(number), vec![], shape, ty)
    }

    /// Returns an equal node if there is one, or adds a new one.
    fn add(&mut self, op: Op, inputs: Vec<Id>, shape: Vec<Dim>, ty: Type) -> Id {
        let key = (op, inputs, shape, ty);
        if let Some(&id) = self.seen.get(&key) {
            return id;
        }
        let (op, inputs, shape, ty) = key.clone();
        let id = self.push(op, inputs, shape, ty);
        self.seen.insert(key, id);
        id
    }

    fn push(&mut self, op: Op, inputs: Vec<Id>, shape: Vec<Dim>, ty: Type) -> Id {
        let id = Id(self.nodes.len() as u32);
        self.nodes.push(Node {
            op,
            inputs,
            shape,
            ty,
            origin: self.current,
        });
        id
    }
}
