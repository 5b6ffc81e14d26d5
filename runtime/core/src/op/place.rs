//! Where the values of a program live: spans of the three spaces, integer slots, and the ports at a program's edge.

use crate::codec::{Field, Reader, Writer, record, word_enum};

/// How many integer slots a program has.
pub const INT_SLOTS: usize = 8;

record! {
    /// Elements `offset..offset + len` of the arena.
    #[derive(Eq, Default)]
    pub struct Span {
        /// First element.
        pub offset: u32,
        /// Number of elements.
        pub len: u32,
    }
}

record! {
    /// 4-byte words `offset..offset + len` of the weights: as many `f32` elements, or more of a smaller format.
    #[derive(Eq, Hash, Default)]
    pub struct WeightSpan {
        /// First word.
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
        /// First word.
        pub offset: u32,
        /// Number of words.
        pub len: u32,
    }
}

word_enum! {
    /// Where an operand that is only read lies.
    pub enum Space {
        /// In the image.
        Weights = 0,
        /// In the workspace.
        Arena = 1,
    }
}

record! {
    /// Elements `offset..offset + len` of either space, read only.
    #[derive(Eq)]
    pub struct Operand {
        /// The space.
        pub space: Space,
        /// First element.
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

/// One of the [`INT_SLOTS`] integers of a program: a timestep, an index. Set by the caller or
/// by [`ArgMin`](super::ArgMin) and [`ArgMax`](super::ArgMax).
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

word_enum! {
    /// What a value at the edge of a program is.
    pub enum Port {
        /// `[1, O]`, raw units.
        Observation = 0,
        /// `[1, A]`: the previous action as an input, the action as an output.
        Action = 1,
        /// `[L, E]` word embeddings, zero-padded to the contract's longest instruction.
        Words = 2,
        /// Integer: timestep in the context.
        Timestep = 3,
        /// `[1, D]`: a codebook entry.
        Plan = 4,
        /// Integer: which codebook entry.
        PlanIndex = 5,
        /// `[1, M]`: one score per codebook entry.
        Logits = 6,
        /// `[1, D]`: what the trajectory encoder gives before it is replaced by the nearest entry.
        Latent = 7,
        /// `[H, O]`: the observations of one horizon.
        Observations = 8,
        /// `[H, A]`: the actions of one horizon.
        Actions = 9,
        /// Integer: which of the contract's instructions.
        InstructionId = 10,
    }
}

impl Port {
    /// True for a port that is an integer and lives in an [`IntSlot`].
    pub const fn is_int(self) -> bool {
        matches!(self, Self::Timestep | Self::PlanIndex | Self::InstructionId)
    }
}

/// Where a value at the edge of a program lives while the program runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// In the arena.
    Span(Span),
    /// In an integer slot.
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
