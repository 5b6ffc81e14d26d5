//! Places of a program's values: spans of the three spaces and integer slots.
//!
//! Every offset and length counts elements, 4-byte words where elements are smaller. A span that
//! was read from an image is not trusted; [`Program::new_checked`](crate::Program::new_checked)
//! checks that it lies inside its space.

use core::ops::Range;

use crate::codec::{Field, Reader, Writer, record, word_enum};

/// Number of integer slots of a program.
pub const INT_SLOTS: usize = 8;

record! {
    /// Elements `offset..offset + len` of the arena.
    #[derive(Eq, Default)]
    pub struct Span {
        /// Offset of the first element.
        pub offset: u32,
        /// Number of elements.
        pub len: u32,
    }
}

record! {
    /// 4-byte words `offset..offset + len` of the weights: as many `f32` elements, or more of a smaller format.
    #[derive(Eq, Hash, Default)]
    pub struct WeightSpan {
        /// Offset of the first word.
        pub offset: u32,
        /// Number of words.
        pub len: u32,
    }
}

record! {
    /// 4-byte words `offset..offset + len` of the state that survives a step, the KV cache: as many `f32` elements, or more of a
    /// smaller format.
    #[derive(Eq, Default)]
    pub struct StateSpan {
        /// Offset of the first word.
        pub offset: u32,
        /// Number of words.
        pub len: u32,
    }
}

word_enum! {
    /// Space that holds an operand that is only read.
    pub enum Space {
        /// Weights in the image.
        Weights = 0,
        /// Arena in the workspace.
        Arena = 1,
    }
}

record! {
    /// Elements `offset..offset + len` of the weights or of the arena, read only.
    #[derive(Eq)]
    pub struct Operand {
        /// Space of the operand.
        pub space: Space,
        /// Offset of the first element.
        pub offset: u32,
        /// Number of elements.
        pub len: u32,
    }
}

impl From<Span> for Operand {
    fn from(span: Span) -> Self {
        Self {
            space: Space::Arena,
            offset: span.offset,
            len: span.len,
        }
    }
}

impl From<WeightSpan> for Operand {
    fn from(span: WeightSpan) -> Self {
        Self {
            space: Space::Weights,
            offset: span.offset,
            len: span.len,
        }
    }
}

impl Operand {
    /// Returns the span of an operand that lies in the arena.
    #[inline]
    pub fn arena(self) -> Option<Span> {
        matches!(self.space, Space::Arena).then_some(Span {
            offset: self.offset,
            len: self.len,
        })
    }
}

#[inline]
fn range(offset: u32, len: u32) -> Range<usize> {
    let start = offset as usize;
    start..start.saturating_add(len as usize)
}

/// Implements `range` for a kind of span.
macro_rules! ranges {
    ($($name:ident)*) => {
        $(impl $name {
            /// Returns the indices of the span in the slice of its space.
            #[inline]
            pub fn range(self) -> Range<usize> {
                range(self.offset, self.len)
            }
        })*
    };
}

ranges! { Span WeightSpan StateSpan Operand }

/// One of the [`INT_SLOTS`] integers of a program: a timestep, an index. It is set by the caller or
/// by [`ArgMin`](crate::op::ArgMin) and [`ArgMax`](crate::op::ArgMax).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IntSlot(pub u8);

impl Field for IntSlot {
    const WORDS: usize = 1;
    fn put(&self, out: &mut Writer) {
        out.word(u32::from(self.0));
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        u8::try_from(from.word()?)
            .ok()
            .filter(|&slot| usize::from(slot) < INT_SLOTS)
            .map(Self)
    }
}

/// Place of a program's input or output while the program runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// A span of the arena.
    Span(Span),
    /// An integer slot.
    Int(IntSlot),
}

impl Field for Place {
    const WORDS: usize = 3;
    fn put(&self, out: &mut Writer) {
        match self {
            Self::Span(span) => {
                out.word(0);
                span.put(out);
            }
            Self::Int(slot) => {
                out.word(1);
                slot.put(out);
                out.word(0);
            }
        }
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        match from.word()? {
            0 => Span::take(from).map(Self::Span),
            1 => {
                let slot = IntSlot::take(from)?;
                (from.word()? == 0).then_some(Self::Int(slot))
            }
            _ => None,
        }
    }
}
