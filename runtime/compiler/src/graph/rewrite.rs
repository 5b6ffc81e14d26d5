//! Rebuilds a graph: each pass copies the needed nodes into a new graph, changing some on the way.

use std::collections::HashMap;

use super::{Graph, Id, Op};

/// Returns the nodes that the roots need, operands before users, in depth-first order. `replace`
/// maps nodes to others that are read instead.
pub(crate) fn topological(graph: &Graph, roots: &[Id], replace: &HashMap<Id, Id>) -> Vec<Id> {
    enum Visit {
        Enter(Id),
        Leave(Id),
    }
    let resolve = |id: Id| replace.get(&id).copied().unwrap_or(id);
    let mut order = vec![];
    let mut entered = std::collections::HashSet::new();
    let mut stack: Vec<Visit> = roots
        .iter()
        .rev()
        .map(|&id| Visit::Enter(resolve(id)))
        .collect();
    while let Some(visit) = stack.pop() {
        match visit {
            Visit::Leave(id) => order.push(id),
            Visit::Enter(id) => {
                if entered.insert(id) {
                    stack.push(Visit::Leave(id));
                    stack.extend(
                        graph
                            .node(id)
                            .inputs
                            .iter()
                            .rev()
                            .map(|&input| Visit::Enter(resolve(input))),
                    );
                }
            }
        }
    }
    order
}

/// Copies nodes of an old graph into a new one.
pub(crate) struct Rewriter<'g> {
    pub old: &'g Graph,
    pub new: Graph,
    copies: HashMap<Id, Id>,
    replace: HashMap<Id, Id>,
}

impl<'g> Rewriter<'g> {
    pub fn new(old: &'g Graph, replace: HashMap<Id, Id>) -> Self {
        let new = Graph {
            origins: old.origins.clone(),
            ..Graph::default()
        };
        Self {
            old,
            new,
            copies: HashMap::new(),
            replace,
        }
    }

    /// Returns the copy of an old node.
    pub fn copy_of(&self, old: Id) -> Id {
        self.copies[&self.replace.get(&old).copied().unwrap_or(old)]
    }

    /// Returns the copies of an old node's operands.
    pub fn operands(&self, old: Id) -> Vec<Id> {
        self.old
            .node(old)
            .inputs
            .iter()
            .map(|&input| self.copy_of(input))
            .collect()
    }

    /// Sets the new node that replaces an old node.
    pub fn set(&mut self, old: Id, new: Id) {
        self.copies.insert(old, new);
    }

    /// Sets the origin of the nodes built from now on to that of an old node.
    pub fn at(&mut self, old: Id) {
        self.new.current = self.old.node(old).origin;
    }

    /// Sets what replaces an old node: the new node that a pass made of it, else a copy with other
    /// operands.
    pub fn set_or_rebuild(
        &mut self,
        old: Id,
        made: Option<Id>,
        operands: &[Id],
    ) -> Result<(), String> {
        let new = match made {
            Some(new) => new,
            None => self.rebuild(old, operands)?,
        };
        self.set(old, new);
        Ok(())
    }

    /// Ends a pass over the nodes of `order`: returns the new graph, and the new node of each of them.
    pub fn finish(self, order: &[Id]) -> (Graph, HashMap<Id, Id>) {
        let copies = order.iter().map(|&id| (id, self.copy_of(id))).collect();
        (self.new, copies)
    }

    /// Rebuilds an old node with other operands.
    pub fn rebuild(&mut self, old: Id, x: &[Id]) -> Result<Id, String> {
        self.at(old);
        let node = self.old.node(old);
        let new = &mut self.new;
        Ok(match &node.op {
            Op::Input => new.push(Op::Input, vec![], node.shape.clone(), node.ty),
            Op::Const(number) => new.add_const(self.old.consts[*number].clone()),
            Op::MatMul => new.matmul(x[0], x[1])?,
            Op::Binary(kind) => new.binary(kind.0, x[0], x[1])?,
            Op::Unary(unary) => new.unary(*unary, x[0])?,
            Op::Softmax => {
                let last = new.shape(x[0]).len() - 1;
                new.softmax(x[0], last)?
            }
            Op::Reduce(kind, axis) => new.reduce(kind.0, x[0], *axis)?,
            Op::LayerNorm { eps } => new.layer_norm(x[0], x[1], x[2], f32::from_bits(*eps))?,
            Op::Reshape => new.reshape(x[0], &node.shape)?,
            Op::Transpose(perm) => new.transpose(x[0], perm)?,
            Op::Slice { axis, start } => {
                let len = node.shape[*axis].fixed;
                new.slice(x[0], *axis, *start, len)?
            }
            Op::Concat { axis } => new.concat(x, *axis)?,
            Op::Expand => new.expand(x[0], &node.shape)?,
            Op::Shift(by) => new.shift(x[0], *by)?,
            Op::GatherRow => new.gather_row(x[0], x[1])?,
            Op::ToIndex => new.index_of(x[0])?,
            Op::FromIndex => new.number_of(x[0])?,
            Op::ArgMin | Op::ArgMax => new.arg(node.op.clone(), x[0])?,
            Op::Linear { .. } => new.linear(node.op.clone(), x.to_vec())?,
            Op::Conv(conv) => new.conv(*conv, x.to_vec())?,
            Op::Pool(kind, windows) => new.pool(kind.0, *windows, x[0])?,
            Op::Resize => new.resize(x[0], x[1], x[2])?,
            Op::Attention { .. } | Op::Record { .. } => new.cached(node.op.clone(), x.to_vec()),
        })
    }
}
