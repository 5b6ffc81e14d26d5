//! Lowers a graph to ops: every value gets a place, every computing node its op.
//!
//! The arena is virtual here: each buffer has addresses of its own, so nothing overlaps by construction; the memory plan then
//! moves the buffers together. Reshapes, transposes, slices and broadcasts are views and cost nothing where the op that reads
//! them takes strides; the parts of a concatenation are computed where they belong.
//!
//! Two kinds of nodes work in place: a residual connection and an elementwise op whose operand has
//! no later reader.

mod cached;
mod compute;
mod convolutions;
mod images;
mod view;
mod weights;

use std::collections::{HashMap, HashSet};

use lads_image::op::{self, CacheFormat, IntSlot, Operand, Place, Space, Span, StateSpan};

use crate::contract::Network;
use crate::error::CompileError;
use crate::fuse::Fused;
use crate::graph::{Graph, Id, Op, Type, topological};
use crate::report::LayerReport;

use view::View;
pub(crate) use weights::Weights;

/// Size of the largest virtual arena, in elements: 2 GiB.
const MAX_VIRTUAL: u32 = 1 << 29;

/// A program over a virtual arena.
#[derive(Debug, Clone)]
pub(crate) struct Lowered {
    pub ops: Vec<op::Op>,
    /// Spans of the virtual arena that move as a whole; together they cover every span of every op.
    pub buffers: Vec<Span>,
    pub inputs: Vec<(String, Place)>,
    pub outputs: Vec<(String, Place)>,
    pub tokens: usize,
    pub layers: Vec<LayerReport>,
}

/// Layout of a KV cache: for each layer keys, in whole blocks of sixteen tokens, then values,
/// `[capacity, heads * head_dim]`, each followed by its scales, if the format has any.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cache {
    pub format: CacheFormat,
    pub capacity: usize,
    layers: usize,
    heads: usize,
    head_dim: usize,
}

impl Cache {
    /// Makes a cache with room for `capacity` rows.
    pub fn new(network: Network, capacity: usize, format: CacheFormat) -> Self {
        Self {
            format,
            capacity,
            layers: network.layers,
            heads: network.heads,
            head_dim: network.head_dim,
        }
    }

    /// The cache of an entry without one.
    pub const NONE: Self = Self {
        format: CacheFormat::F32,
        capacity: 0,
        layers: 0,
        heads: 0,
        head_dim: 0,
    };

    /// Returns the number of words of one layer's keys and of its values.
    fn words(&self) -> Option<[usize; 2]> {
        self.format
            .words(self.capacity, [self.heads, self.head_dim])
    }

    /// Returns the number of words of all layers.
    pub fn len(&self) -> Option<u32> {
        let [keys, values] = self.words()?;
        let layer = values.checked_add(keys)?;
        u32::try_from(layer.checked_mul(self.layers)?).ok()
    }

    pub(crate) fn spans(&self, layer: usize) -> [StateSpan; 2] {
        // Of a cache whose length was asked for, and fits 32 bits.
        let [keys, values] = self.words().unwrap_or_default().map(|words| words as u32);
        let offset = layer as u32 * (keys + values);
        [
            StateSpan { offset, len: keys },
            StateSpan {
                offset: offset + keys,
                len: values,
            },
        ]
    }
}

/// Lowers an entry to ops.
pub(crate) fn lower(
    entry: &str,
    fused: &Fused,
    cache: Cache,
    weights: &mut Weights<'_>,
) -> Result<Lowered, CompileError> {
    let order = topological(&fused.graph, &fused.roots(), &HashMap::new());
    let mut lowering = Lowering::new(fused, &order, cache, weights);
    lowering.place_concatenations(&order);
    lowering.place_residuals(&order);
    lowering.plan_borders(&order);
    lowering.inputs(&order, fused);
    for &id in &order {
        lowering.node(id).map_err(|problem| {
            let (operator, node) = fused.graph.origin(id);
            CompileError::Operator {
                entry: entry.into(),
                operator: operator.into(),
                node: node.into(),
                problem: problem.into(),
            }
        })?;
        for &input in &fused.graph.node(id).inputs {
            if let Some(pending) = lowering.pending.get_mut(&input) {
                *pending -= 1;
            }
        }
    }
    lowering
        .outputs(fused)
        .map_err(|problem| CompileError::Entry {
            entry: entry.into(),
            problem: problem.into(),
        })?;
    if lowering.end > MAX_VIRTUAL {
        return Err(CompileError::TooLarge {
            what: format!("the working memory of {entry}").into(),
        });
    }
    let Lowering {
        ops,
        buffers,
        input_ports,
        output_ports,
        layers,
        ..
    } = lowering;
    Ok(Lowered {
        ops,
        buffers,
        inputs: input_ports,
        outputs: output_ports,
        tokens: fused.tokens,
        layers,
    })
}

/// Returns whether an input or output belongs to the KV cache, which attention reads and appends to
/// by itself.
fn is_cache(name: &str) -> bool {
    name.starts_with("past_key_values.") || name.starts_with("present.")
}

/// State of lowering an entry to ops.
struct Lowering<'a, 's> {
    g: &'a Graph,
    weights: &'a mut Weights<'s>,
    cache: Cache,
    ops: Vec<op::Op>,
    buffers: Vec<Span>,
    /// End of the virtual arena; saturates.
    end: u32,
    views: HashMap<Id, View>,
    /// Slot of each integer, and the number that is added to it.
    ints: HashMap<Id, (IntSlot, i64)>,
    slots: u8,
    /// Number of remaining uses; an output counts as one that never happens.
    pending: HashMap<Id, usize>,
    /// Nodes whose views lie in each buffer.
    residents: Vec<Vec<Id>>,
    /// Values that are computed inside a concatenation: buffer and offset.
    placed: HashMap<Id, (usize, usize)>,
    /// Border that the readers of an image need: rows above, columns to the left, rows below and
    /// columns to the right.
    wanted: HashMap<Id, [usize; 4]>,
    /// Borders that the images have.
    borders: HashMap<Id, [usize; 4]>,
    /// Images that were converted to integers.
    integers: HashMap<Id, convolutions::Integers>,
    input_ports: Vec<(String, Place)>,
    output_ports: Vec<(String, Place)>,
    /// Dense layers and convolutions, in their order.
    layers: Vec<LayerReport>,
}

impl<'a, 's> Lowering<'a, 's> {
    fn new(fused: &'a Fused, order: &[Id], cache: Cache, weights: &'a mut Weights<'s>) -> Self {
        let mut pending: HashMap<Id, usize> = HashMap::new();
        let uses = order
            .iter()
            .flat_map(|&id| fused.graph.node(id).inputs.iter().copied());
        for id in uses.chain(fused.outputs.iter().map(|&(_, id)| id)) {
            *pending.entry(id).or_default() += 1;
        }
        Self {
            g: &fused.graph,
            weights,
            cache,
            ops: vec![],
            buffers: vec![],
            end: 0,
            views: HashMap::new(),
            ints: HashMap::new(),
            slots: 0,
            pending,
            residents: vec![],
            placed: HashMap::new(),
            wanted: HashMap::new(),
            borders: HashMap::new(),
            integers: HashMap::new(),
            input_ports: vec![],
            output_ports: vec![],
            layers: vec![],
        }
    }

    /// Allocates a buffer of its own.
    fn buffer(&mut self, len: usize) -> usize {
        let len = u32::try_from(len).unwrap_or(u32::MAX);
        self.buffers.push(Span {
            offset: self.end,
            len,
        });
        self.residents.push(vec![]);
        self.end = self.end.saturating_add(len);
        self.buffers.len() - 1
    }

    /// Returns the shape of a value; all shapes are static at this stage.
    fn shape(&self, id: Id) -> Result<Vec<usize>, String> {
        self.g
            .known_shape(id)
            .ok_or_else(|| "depends on the context length".into())
    }

    /// Decides which values are computed inside the buffer of a concatenation.
    fn place_concatenations(&mut self, order: &[Id]) {
        for &id in order {
            let (Op::Concat { axis }, Type::F32) = (self.g.op(id), self.g.ty(id)) else {
                continue;
            };
            let Ok(shape) = self.shape(id) else { continue };
            // The parts lie one after the other only if the axis is the first that is longer than one.
            if shape[..*axis].iter().any(|&dim| dim != 1) || self.placed.contains_key(&id) {
                continue;
            }
            let buffer = self.buffer(shape.iter().product());
            self.placed.insert(id, (buffer, 0));
            let mut offset = 0;
            for &part in &self.g.node(id).inputs {
                let len: usize = self.shape(part).map_or(0, |shape| shape.iter().product());
                let mut source = part;
                while *self.g.op(source) == Op::Reshape {
                    source = self.g.node(source).inputs[0];
                }
                if self.computes(source) {
                    self.placed.entry(source).or_insert((buffer, offset));
                }
                offset += len;
            }
        }
    }

    /// Places a residual that only its layer reads where the layer's result goes, so that the layer
    /// is added in place.
    fn place_residuals(&mut self, order: &[Id]) {
        // Users first, so that a chain of residuals shares one place.
        for &id in order.iter().rev() {
            let (Op::Linear { residual: true, .. }, Some(&place)) =
                (self.g.op(id), self.placed.get(&id))
            else {
                continue;
            };
            let Some(mut source) = self.g.node(id).inputs.last().copied() else {
                continue;
            };
            let mut alone = self.pending.get(&source) == Some(&1);
            while *self.g.op(source) == Op::Reshape {
                source = self.g.node(source).inputs[0];
                alone &= self.pending.get(&source) == Some(&1);
            }
            if alone && self.computes(source) && *self.g.op(source) != Op::Input {
                self.placed.entry(source).or_insert(place);
            }
        }
    }

    /// Returns whether a value is written by an op of its own or by the caller, and so can be
    /// written anywhere.
    fn computes(&self, id: Id) -> bool {
        let moves = matches!(
            self.g.op(id),
            Op::Const(_)
                | Op::Reshape
                | Op::Transpose(_)
                | Op::Slice { .. }
                | Op::Expand
                | Op::Concat { .. }
                | Op::Record { .. }
        );
        !moves && self.g.ty(id) == Type::F32
    }

    /// Gives a value a place: inside a concatenation, or a buffer of its own.
    fn allocate(&mut self, id: Id, shape: &[usize]) -> View {
        let (buffer, offset) = match self.placed.get(&id) {
            Some(&place) => place,
            None => (self.buffer(shape.iter().product()), 0),
        };
        View::contiguous(buffer, offset, shape)
    }

    /// Sets the view of a value.
    fn set(&mut self, id: Id, view: View) {
        if let Some(buffer) = view.buffer() {
            self.residents[buffer].push(id);
        }
        self.views.insert(id, view);
    }

    /// Returns true if no later node reads the buffer, except for the node that is being lowered.
    fn dies_here(&self, buffer: usize, at: Id) -> bool {
        let reads = |id: Id| {
            self.g
                .node(at)
                .inputs
                .iter()
                .filter(|&&input| input == id)
                .count()
        };
        self.residents[buffer]
            .iter()
            .all(|&id| self.pending.get(&id).copied().unwrap_or(0) <= reads(id))
    }

    fn inputs(&mut self, order: &[Id], fused: &Fused) {
        let needed: HashSet<Id> = order.iter().copied().collect();
        for (name, id) in &fused.inputs {
            if is_cache(name) || !needed.contains(id) {
                continue;
            }
            let place = if self.g.ty(*id) == Type::I64 {
                let slot = self.slot();
                self.ints.insert(*id, (slot, 0));
                Place::Int(slot)
            } else {
                let shape = self.g.known_shape(*id).unwrap_or_default();
                let view = self.allocate(*id, &shape);
                let place = Place::Span(self.span(&view, shape.iter().product()));
                self.set(*id, view);
                place
            };
            self.input_ports.push((name.clone(), place));
        }
    }

    fn slot(&mut self) -> IntSlot {
        self.slots += 1;
        IntSlot(self.slots - 1)
    }

    fn outputs(&mut self, fused: &Fused) -> Result<(), String> {
        for (name, id) in &fused.outputs {
            if is_cache(name) {
                continue;
            }
            let place = if self.g.ty(*id) == Type::I64 {
                match self.ints.get(id) {
                    Some(&(slot, 0)) => Place::Int(slot),
                    _ => {
                        return Err(format!(
                            "output {name} is not an index that an operation computes"
                        ));
                    }
                }
            } else {
                // A value that is an input or a constant is copied, so that outputs are the program's own.
                let computed = self
                    .views
                    .get(id)
                    .is_some_and(|view| view.buffer().is_some())
                    && *self.g.op(*id) != Op::Input;
                let span = if computed {
                    self.contiguous(*id)?
                } else {
                    self.copied(*id)?
                };
                Place::Span(span)
            };
            self.output_ports.push((name.clone(), place));
        }
        if usize::from(self.slots) > op::INT_SLOTS {
            return Err(format!("more than {} indices are computed", op::INT_SLOTS));
        }
        Ok(())
    }

    /// Returns the `len` elements of the arena from the first of a view.
    fn span(&self, view: &View, len: usize) -> Span {
        let base = view
            .buffer()
            .map_or(0, |buffer| self.buffers[buffer].offset);
        Span {
            offset: base.saturating_add(view.offset as u32),
            len: len as u32,
        }
    }

    /// Returns the view of a value; constants are put into the weights.
    fn view(&mut self, id: Id) -> Result<View, String> {
        if let Some(view) = self.views.get(&id) {
            return Ok(view.clone());
        }
        let tensor = self
            .g
            .constant(id)
            .cloned()
            .ok_or("reads a value that was not computed")?;
        let shape = self.shape(id)?;
        if shape.contains(&0) {
            return Err("reads an empty constant".into());
        }
        let span = self.weights.plain(&tensor)?;
        let view = View::weights(span.offset as usize, &shape);
        self.views.insert(id, view.clone());
        Ok(view)
    }

    /// Returns an operand of `len` elements from the first of a view.
    fn operand(&self, view: &View, len: usize) -> Operand {
        match view.buffer() {
            Some(_) => self.span(view, len).into(),
            None => Operand {
                space: Space::Weights,
                offset: view.offset as u32,
                len: len as u32,
            },
        }
    }

    /// Returns a value as contiguous elements of the arena, copied if necessary.
    fn contiguous(&mut self, id: Id) -> Result<Span, String> {
        let shape = self.shape(id)?;
        let view = self.view(id)?;
        if view.buffer().is_some() && view.is_contiguous(&shape) {
            return Ok(self.span(&view, shape.iter().product()));
        }
        self.copied(id)
    }

    /// Copies a value to a contiguous buffer of its own.
    fn copied(&mut self, id: Id) -> Result<Span, String> {
        let shape = self.shape(id)?;
        let buffer = self.buffer(shape.iter().product());
        let to = View::contiguous(buffer, 0, &shape);
        self.copy(id, &to, &shape)?;
        Ok(self.span(&to, shape.iter().product()))
    }
}
