//! What the checks of the ops are made of: spans inside their spaces, lengths as the shape says, nothing written that is also read.
//!
//! Numbers come from an image that may be hostile, so products are taken in 128 bits, where four 32-bit factors fit. Every check
//! ends in a [`Fault`] or in nothing; [`Checker`] also keeps how much of the arena and of the cache is used.

use core::cell::Cell;
use core::error::Error;
use core::fmt;

use crate::place::{INT_SLOTS, Operand, Place, Space, Span, StateSpan, WeightSpan};

/// The spaces that a program's spans point into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Spaces {
    /// Words of weights in the image.
    pub weights_len: usize,
    /// Words of the entry's KV state.
    pub cache_len: usize,
    /// Rows that the KV state holds: tokens of the longest context.
    pub rows: usize,
}

/// What is wrong with a program or one of its ops.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// Words that mean no op.
    Encoding,
    /// An op, or a format of its numbers, that this build was made without.
    LeftOut,
    /// A span is empty or reaches beyond its space, or an integer slot does not exist.
    Bounds,
    /// A span is not as long as the shape says, or a dimension is zero.
    Shape,
    /// What is written overlaps what is read.
    Overlap,
    /// An attention takes the KV state for one of another number of rows, or appends more rows than there are.
    Capacity,
    /// An attention appends another number of tokens than its program.
    Tokens,
    /// The arena is larger than what lies in it.
    Arena,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Encoding => "unknown operation",
            Self::LeftOut => "an operation that this build was made without",
            Self::Bounds => "a span is empty or reaches beyond its space",
            Self::Shape => "a span is not as long as its shape",
            Self::Overlap => "the result overlaps an operand",
            Self::Capacity => "an attention does not fit the rows of the KV cache",
            Self::Tokens => "an attention appends another number of tokens than its program",
            Self::Arena => "it asks for a larger arena than it uses",
        })
    }
}

impl Error for Fault {}

pub(crate) type Checked = Result<(), Fault>;

pub(crate) fn require(condition: bool, fault: Fault) -> Checked {
    if condition { Ok(()) } else { Err(fault) }
}

/// Elements of a shape; as many as can be said where there are more, which nothing that is checked has.
#[inline]
pub(crate) fn product<const N: usize>(dims: [u32; N]) -> u64 {
    dims.into_iter()
        .fold(1, |product: u64, dim| product.saturating_mul(dim.into()))
}

/// `len` is the product of `dims`, none of which is zero.
pub(crate) fn exactly<const N: usize>(len: u32, dims: [u32; N]) -> Checked {
    let product = product(dims);
    require(product != 0 && product == u64::from(len), Fault::Shape)
}

/// A strided layout stays inside `len` elements.
pub(crate) fn reaches<const N: usize>(len: u32, dims: [u32; N], strides: [u32; N]) -> Checked {
    let last = dims
        .into_iter()
        .zip(strides)
        .fold(0, |last: u64, (dim, stride)| {
            let steps = u64::from(dim.saturating_sub(1));
            last.saturating_add(steps.saturating_mul(stride.into()))
        });
    require(last < u64::from(len), Fault::Shape)
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

pub(crate) fn overlap(a: [u32; 2], b: [u32; 2]) -> bool {
    let end = |[offset, len]: [u32; 2]| u64::from(offset).saturating_add(u64::from(len));
    u64::from(a[0]) < end(b) && u64::from(b[0]) < end(a)
}

/// `y` overlaps none of the spans.
pub(crate) fn apart<const N: usize>(y: Span, xs: [Span; N]) -> Checked {
    let clash = xs
        .into_iter()
        .any(|x| overlap([y.offset, y.len], [x.offset, x.len]));
    require(!clash, Fault::Overlap)
}

/// Checks ops against the spaces of one program, and keeps how much of the spaces in memory they use.
#[derive(Debug)]
pub struct Checker {
    pub(crate) spaces: Spaces,
    pub(crate) arena_len: u32,
    pub(crate) tokens: u32,
    arena_end: Cell<u64>,
    cache_end: Cell<u64>,
}

impl Checker {
    /// Nothing is used yet of a program with this arena, whose run appends so many tokens.
    pub fn new(spaces: Spaces, arena_len: u32, tokens: u32) -> Self {
        Self {
            spaces,
            arena_len,
            tokens,
            arena_end: Cell::new(0),
            cache_end: Cell::new(0),
        }
    }

    /// The end of what is used of the cache, once every op and port was checked. Every element of the arena belongs to something:
    /// an image cannot ask for memory that it does not use.
    pub fn finish(&self) -> Result<u64, Fault> {
        require(
            self.arena_end.get() == u64::from(self.arena_len),
            Fault::Arena,
        )?;
        Ok(self.cache_end.get())
    }

    /// Checks where a value at the edge of a program lives.
    pub fn place(&self, place: Place) -> Result<(), Fault> {
        match place {
            Place::Span(span) => self.arena(span),
            Place::Int(slot) => require(usize::from(slot.0) < INT_SLOTS, Fault::Bounds),
        }
    }

    pub(crate) fn arena(&self, span: Span) -> Checked {
        inside(span.offset, span.len, self.arena_len as usize)?;
        reach(&self.arena_end, span.offset, span.len);
        Ok(())
    }

    pub(crate) fn weights(&self, span: WeightSpan) -> Checked {
        inside(span.offset, span.len, self.spaces.weights_len)
    }

    pub(crate) fn cache(&self, span: StateSpan) -> Checked {
        inside(span.offset, span.len, self.spaces.cache_len)?;
        reach(&self.cache_end, span.offset, span.len);
        Ok(())
    }

    pub(crate) fn operand(&self, operand: Operand) -> Checked {
        match operand.space {
            Space::Weights => inside(operand.offset, operand.len, self.spaces.weights_len),
            Space::Arena => self.arena(Span {
                offset: operand.offset,
                len: operand.len,
            }),
        }
    }

    /// `y` lies in the arena and apart from the operand.
    pub(crate) fn result(&self, y: Span, x: Operand) -> Checked {
        self.operand(x)?;
        self.arena(y)?;
        x.arena().map_or(Ok(()), |x| apart(y, [x]))
    }
}
