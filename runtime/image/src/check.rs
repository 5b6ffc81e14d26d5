//! Building blocks of the op checks: spans inside their spaces, lengths that match the shape, no
//! written element that is also read.
//!
//! Numbers come from an image that may be hostile, so products are taken in 128 bits, where four
//! 32-bit factors fit. Every check returns a [`Fault`] or nothing; [`Checker`] also tracks how much
//! of the arena and of the cache is used.

use core::cell::Cell;
use core::error::Error;
use core::fmt;

use crate::place::{INT_SLOTS, Operand, Place, Space, Span, StateSpan, WeightSpan};

/// Sizes of the spaces that a program's spans point into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Spaces {
    /// Number of 4-byte words of weights in the image.
    pub weights_len: usize,
    /// Number of 4-byte words of the entry's KV state.
    pub cache_len: usize,
    /// Number of rows that the KV state holds: tokens of the longest context.
    pub rows: usize,
}

/// Fault of a program or of one of its ops.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The words do not decode to an op.
    Encoding,
    /// The op, or a format of its numbers, was left out of this build.
    LeftOut,
    /// A span is empty or reaches beyond its space, or an integer slot does not exist.
    Bounds,
    /// A span does not have the length of the shape, or a dimension is zero.
    Shape,
    /// A written span overlaps one that is read.
    Overlap,
    /// An attention assumes another number of rows than the KV state has, or appends more rows than
    /// there are.
    Capacity,
    /// An attention appends another number of tokens than its program states.
    Tokens,
    /// The arena is larger than the spans in it need.
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

/// Returns the number of elements of a shape, `u64::MAX` where it is larger.
#[inline]
pub(crate) fn product<const N: usize>(dims: [u32; N]) -> u64 {
    dims.into_iter()
        .fold(1, |product: u64, dim| product.saturating_mul(dim.into()))
}

/// Checks that `len` is the product of `dims`, none of which is zero.
pub(crate) fn exactly<const N: usize>(len: u32, dims: [u32; N]) -> Checked {
    let product = product(dims);
    require(product != 0 && product == u64::from(len), Fault::Shape)
}

/// Checks that a strided layout stays inside `len` elements.
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

/// Checks that `offset..offset + len` lies inside `0..space` and is not empty.
fn inside(offset: u32, len: u32, space: usize) -> Checked {
    let end = u64::from(offset).saturating_add(u64::from(len));
    require(len != 0 && end <= space as u64, Fault::Bounds)
}

/// Extends `end` to cover the span `offset..offset + len`.
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

/// Checks that `y` overlaps none of the spans.
pub(crate) fn apart<const N: usize>(y: Span, xs: [Span; N]) -> Checked {
    let clash = xs
        .into_iter()
        .any(|x| overlap([y.offset, y.len], [x.offset, x.len]));
    require(!clash, Fault::Overlap)
}

/// Checks ops against the spaces of one program, and tracks how much of the spaces in memory they
/// use.
#[derive(Debug)]
pub struct Checker {
    pub(crate) spaces: Spaces,
    pub(crate) arena_len: u32,
    pub(crate) tokens: u32,
    arena_end: Cell<u64>,
    cache_end: Cell<u64>,
}

impl Checker {
    /// Makes a checker for a program with this arena, a run of which appends `tokens` tokens.
    pub fn new(spaces: Spaces, arena_len: u32, tokens: u32) -> Self {
        Self {
            spaces,
            arena_len,
            tokens,
            arena_end: Cell::new(0),
            cache_end: Cell::new(0),
        }
    }

    /// Returns the end of the used part of the cache, once every op and port was checked. Fails
    /// unless the last used element is the arena's last: an image cannot ask for memory that it
    /// does not use.
    pub fn finish(&self) -> Result<u64, Fault> {
        require(
            self.arena_end.get() == u64::from(self.arena_len),
            Fault::Arena,
        )?;
        Ok(self.cache_end.get())
    }

    /// Checks the place of a program's input or output.
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

    /// Checks that `y` lies in the arena and apart from the operand.
    pub(crate) fn result(&self, y: Span, x: Operand) -> Checked {
        self.operand(x)?;
        self.arena(y)?;
        x.arena().map_or(Ok(()), |x| apart(y, [x]))
    }
}
