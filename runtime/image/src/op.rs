//! The operations of a program: what each computes, on which elements, and how it is written into an image.
//!
//! A program is a list of [`Op`]s over one arena of `f32` elements. Every shape is static but one: the number of tokens
//! already in the KV cache, `P`, which only [`Attention`] sees. Every offset and length counts elements.
//!
//! Invariants, all checked once by [`Program::new_checked`](crate::Program::new_checked):
//! - each span lies inside its space, and is exactly as long as the shape says (strided operands: at least as long as the
//!   last element that the strides reach);
//! - what an op writes overlaps nothing that it reads, except where the op says *in place*;
//! - no length is zero.
//!
//! One file per operation, behind the trait [`Operation`]; the table at the end of this file says their opcodes and dispatches to
//! them. An op is [`OP_WORDS`] words: the opcode, the fields in the order of declaration, zeros. [`Op::decode`] refuses everything
//! that [`Op::encode`] would not write, and what the crate's features leave out.

mod arg;
mod attention;
mod binary;
mod border;
mod conv;
mod copy;
mod depthwise;
mod gather_row;
mod index;
mod layer_norm;
mod linear;
mod matmul;
mod picture;
mod pool;
mod reduce;
mod resize;
mod softmax;
mod unary;

use crate::access::Access;
use crate::check::{Checker, Fault, product};
use crate::codec::{Field, Reader, Writer};
use crate::machine::{ExecError, Machine};

pub use crate::place::{INT_SLOTS, IntSlot, Operand, Place, Space, Span, StateSpan, WeightSpan};
pub use arg::{ArgMax, ArgMin};
pub use attention::{Attention, CacheFormat};
pub use binary::{Binary, BinaryKind};
pub use border::Border;
pub use conv::Conv;
pub use copy::Copy;
pub use depthwise::Depthwise;
pub use gather_row::GatherRow;
pub use index::{FromIndex, ToIndex};
pub use layer_norm::LayerNorm;
pub use linear::{Activation, Linear, WeightFormat};
pub use matmul::MatMul;
pub use picture::{Pair, Picture, Window};
pub use pool::{Pool, PoolKind};
pub use reduce::{Reduce, ReduceKind};
pub use resize::Resize;
pub use softmax::Softmax;
pub use unary::{Unary, UnaryKind};

/// Words of an encoded op.
pub const OP_WORDS: usize = 24;

/// What every operation says of itself: its record is the op.
pub trait Operation: Field {
    /// Checks that spans lie inside their spaces and are as long as the shape says, and that nothing is written that is also read.
    fn check(&self, checker: &Checker) -> Result<(), Fault>;

    /// Runs the op. It was checked, so spans are not looked at again; one that is not there is [`ExecError::Span`].
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError>;

    /// Shows the elements of the arena that the op reads before it writes, then those that it writes, scratch included.
    /// The order depends on the shape alone.
    fn accesses(&self, see: &mut dyn FnMut(Access));

    /// Shows every span of the arena that is not empty, to be moved.
    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span));

    /// The integers that the op reads and writes.
    fn slots(&self) -> Slots {
        Slots::default()
    }

    /// What the op costs at the largest context.
    fn work(&self) -> Work;
}

/// The integers of an op.
#[derive(Debug, Clone, core::marker::Copy, PartialEq, Eq, Default)]
pub struct Slots {
    /// The one that it reads.
    pub read: Option<IntSlot>,
    /// The one that it writes.
    pub written: Option<IntSlot>,
}

/// What an op or a program costs. Sums and products saturate.
#[derive(Debug, Clone, core::marker::Copy, PartialEq, Eq, Default)]
pub struct Work {
    /// Multiply-adds of products; an op that goes over elements one by one counts one for each, and so does one that only moves or fills them.
    pub multiply_adds: u64,
    /// 4-byte words of weights that are read.
    pub weight_words: u64,
    /// 4-byte words of the KV cache that are read or written.
    pub state_words: u64,
}

impl Work {
    /// The work of two ops.
    #[must_use]
    pub const fn and(self, other: Self) -> Self {
        Self {
            multiply_adds: self.multiply_adds.saturating_add(other.multiply_adds),
            weight_words: self.weight_words.saturating_add(other.weight_words),
            state_words: self.state_words.saturating_add(other.state_words),
        }
    }

    fn products<const N: usize>(dims: [u32; N]) -> Self {
        Self {
            multiply_adds: product(dims),
            ..Self::default()
        }
    }

    fn elements(len: u32) -> Self {
        Self::products([len])
    }

    fn with_weights(self, spans: impl IntoIterator<Item = WeightSpan>) -> Self {
        let words = |sum: u64, span: WeightSpan| sum.saturating_add(span.len.into());
        Self {
            weight_words: spans.into_iter().fold(self.weight_words, words),
            ..self
        }
    }

    fn with_operand(self, operand: Operand) -> Self {
        match operand.space {
            Space::Weights => self.with_weights([WeightSpan {
                offset: operand.offset,
                len: operand.len,
            }]),
            Space::Arena => self,
        }
    }
}

/// The table's enum, and every dispatch to the operations.
macro_rules! ops {
    ($($name:ident = $code:literal $(if $feature:literal)?,)*) => {
        /// One operation of a program.
        #[derive(Debug, Clone, core::marker::Copy, PartialEq)]
        #[expect(missing_docs, reason = "each variant holds the record of the same name, which is documented")]
        pub enum Op { $($(#[cfg(feature = $feature)])? $name($name),)* }

        impl Op {
            /// The names of all operations, in the order of their opcodes.
            pub const NAMES: &'static [&'static str] = &[$(stringify!($name),)*];

            /// The op as words of an image.
            pub fn encode(&self) -> [u32; OP_WORDS] {
                let mut words = [0; OP_WORDS];
                let mut out = Writer::new(&mut words);
                match self {
                    $($(#[cfg(feature = $feature)])? Self::$name(op) => {
                        const { assert!($name::WORDS < OP_WORDS, "an op and its code fit") };
                        out.word($code);
                        op.put(&mut out);
                    })*
                }
                words
            }

            /// Reads an op; `None` for words that [`encode`](Self::encode) does not write.
            pub fn decode(words: &[u32; OP_WORDS]) -> Option<Self> {
                let mut from = Reader::new(words);
                let op = Self::take(&mut from)?;
                from.rest_is_zero().then_some(op)
            }

            /// Reads an op and leaves the zeros behind it. Inlined: a run reads every op again.
            #[inline(always)]
            pub(crate) fn take(from: &mut Reader) -> Option<Self> {
                Some(match from.word()? {
                    $($(#[cfg(feature = $feature)])? $code => Self::$name($name::take(from)?),)*
                    _ => return None,
                })
            }

            /// Whether words mean an op that this build was made without: see the crate's features.
            pub fn is_left_out(words: &[u32; OP_WORDS]) -> bool {
                let [code, ..] = *words;
                [$($((!cfg!(feature = $feature)).then_some($code),)?)*].contains(&Some(code))
            }

            /// The op's name.
            pub const fn name(&self) -> &'static str {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(_) => stringify!($name),)* }
            }

            /// Checks the op, see [`Operation::check`].
            pub fn check(&self, checker: &Checker) -> Result<(), Fault> {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.check(checker),)* }
            }

            /// Runs the op, see [`Operation::run`]. Inlined: it belongs to the loop over a program.
            #[inline(always)]
            pub(crate) fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.run(weights, machine),)* }
            }

            /// Shows what the op reads, then what it writes, see [`Operation::accesses`].
            pub fn accesses(&self, see: &mut dyn FnMut(Access)) {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.accesses(see),)* }
            }

            /// Shows every span of the arena that is not empty, see [`Operation::each_span`].
            pub fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.each_span(visit),)* }
            }

            /// The integers that the op reads and writes.
            pub fn slots(&self) -> Slots {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.slots(),)* }
            }

            /// What the op costs at the largest context.
            pub fn work(&self) -> Work {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.work(),)* }
            }
        }

        $($(#[cfg(feature = $feature)])? impl From<$name> for Op {
            fn from(op: $name) -> Self {
                Self::$name(op)
            }
        })*
    };
}

// A row with a feature is an op that a build without the feature does not know.
ops! {
    Linear = 1,
    LayerNorm = 2 if "layer-norm",
    Attention = 3 if "attention",
    Binary = 4,
    Unary = 5,
    Softmax = 6 if "softmax",
    Reduce = 7 if "reduce",
    MatMul = 8 if "matmul",
    GatherRow = 9,
    Copy = 10,
    ArgMin = 11 if "arg",
    ArgMax = 12 if "arg",
    ToIndex = 14,
    FromIndex = 15,
    Conv = 16 if "conv",
    Depthwise = 17 if "conv",
    Border = 18 if "conv",
    Pool = 19 if "pool",
    Resize = 20 if "resize",
}

#[cfg(test)]
pub(crate) mod tests {
    use std::vec::Vec;

    use super::{INT_SLOTS, Op};
    use crate::machine::{ExecError, Machine};
    use crate::place::Span;
    use crate::{Checker, Isa, Spaces};

    /// Checks an op and runs it on an arena and weights that are there for it alone.
    pub fn run(
        op: impl Into<Op>,
        arena: &[f32],
        weights: &[f32],
        ints: [u32; INT_SLOTS],
    ) -> Result<(Vec<f32>, [u32; INT_SLOTS]), ExecError> {
        let op = op.into();
        let spaces = Spaces {
            weights_len: weights.len(),
            cache_len: 0,
            rows: 0,
        };
        let checked = op.check(&Checker::new(spaces, arena.len() as u32, 0));
        assert_eq!(checked, Ok(()), "{op:?}");
        let mut arena = arena.to_vec();
        let mut machine = Machine {
            arena: &mut arena,
            cache: &mut [],
            ints,
            past: 0,
            isa: Isa::detect(),
        };
        op.run(weights, &mut machine)?;
        let ints = machine.ints;
        Ok((arena, ints))
    }

    /// The arena after a run that cannot fail and knows no integers.
    pub fn computed(op: impl Into<Op>, arena: &[f32], weights: &[f32]) -> Vec<f32> {
        let (arena, _) = run(op, arena, weights, [0; INT_SLOTS]).expect("the op runs");
        arena
    }

    pub const fn span(offset: u32, len: u32) -> Span {
        Span { offset, len }
    }
}
