//! Operations of a program: what each computes, on which elements, and how it is encoded in an
//! image.
//!
//! A program is a list of [`Op`]s over one arena of `f32` elements. Every dimension is static but
//! one: the number of tokens already in the KV cache, `P`, which only [`Attention`] sees. Every
//! offset and length counts elements.
//!
//! Invariants, all checked once by [`Program::new_checked`](crate::Program::new_checked):
//! - each span lies inside its space, and has exactly the length of its shape (strided operands: at
//!   least as long as the last element that the strides reach);
//! - a written span overlaps none that is read, except where the op says *in place*;
//! - no length is zero.
//!
//! One file per operation, behind the trait [`Operation`]; the table at the end of this file lists
//! their opcodes and dispatches to them. An op is [`OP_WORDS`] words: the opcode, the fields in the
//! order of declaration, zeros. [`Op::decode`] refuses everything that [`Op::encode`] would not
//! write, and ops that the crate's features leave out.

mod arg;
mod attention;
mod binary;
mod border;
mod conv;
mod copy;
mod depthwise;
mod gather_row;
mod index;
mod integers;
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
pub use integers::{ImageIntegers, IntegerConv};
pub use layer_norm::LayerNorm;
pub use linear::{Activation, Linear, WeightFormat};
pub use matmul::MatMul;
pub use picture::{Pair, Picture, Window};
pub use pool::{Pool, PoolKind};
pub use reduce::{Reduce, ReduceKind};
pub use resize::Resize;
pub use softmax::Softmax;
pub use unary::{Unary, UnaryKind};

/// Number of words of an encoded op.
pub const OP_WORDS: usize = 24;

/// Behaviour of one operation: its record, check, run, memory accesses and cost.
pub trait Operation: Field {
    /// Checks that spans lie inside their spaces and have the length of the shape, and that no
    /// written span is also read.
    fn check(&self, checker: &Checker) -> Result<(), Fault>;

    /// Runs the op. The op was checked, so spans are not checked again; a missing one is
    /// [`ExecError::Span`].
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError>;

    /// Reports the arena elements that the op reads before it writes, then those that it writes,
    /// scratch included. The order depends on the shape alone.
    fn accesses(&self, see: &mut dyn FnMut(Access));

    /// Visits every span of the arena that is not empty, so that it can be moved.
    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span));

    /// Returns the integer slots that the op reads and writes.
    fn slots(&self) -> Slots {
        Slots::default()
    }

    /// Returns the cost of the op at the largest context.
    fn work(&self) -> Work;
}

/// Integer slots of an op.
#[derive(Debug, Clone, core::marker::Copy, PartialEq, Eq, Default)]
pub struct Slots {
    /// Slot that the op reads.
    pub read: Option<IntSlot>,
    /// Slot that the op writes.
    pub written: Option<IntSlot>,
}

/// Cost of an op or a program. Sums and products saturate.
#[derive(Debug, Clone, core::marker::Copy, PartialEq, Eq, Default)]
pub struct Work {
    /// Number of multiply-adds of products; an op that works element by element, copies and fills
    /// included, counts one for each.
    pub multiply_adds: u64,
    /// Number of 4-byte words of weights that are read.
    pub weight_words: u64,
    /// Number of 4-byte words of the KV cache that are read or written.
    pub state_words: u64,
}

impl Work {
    /// Adds the work of two ops.
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

/// Defines [`Op`] from the table of operations, with every dispatch to them.
macro_rules! ops {
    ($($name:ident = $code:literal $(if $feature:literal)?,)*) => {
        /// One operation of a program.
        #[derive(Debug, Clone, core::marker::Copy, PartialEq)]
        #[expect(missing_docs, reason = "each variant holds the record of the same name, which is documented")]
        pub enum Op { $($(#[cfg(feature = $feature)])? $name($name),)* }

        impl Op {
            /// Names of all operations, in the order of their opcodes.
            pub const NAMES: &'static [&'static str] = &[$(stringify!($name),)*];

            /// Encodes the op as words of an image.
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
            #[inline(never)]
            pub fn decode(words: &[u32; OP_WORDS]) -> Option<Self> {
                let mut from = Reader::new(words);
                let op = Self::take(&mut from)?;
                from.rest_is_zero().then_some(op)
            }

            /// Reads an op without the zeros after it. Inlined: a run reads every op again.
            #[inline(always)]
            pub(crate) fn take(from: &mut Reader) -> Option<Self> {
                Some(match from.word()? {
                    $($(#[cfg(feature = $feature)])? $code => Self::$name($name::take(from)?),)*
                    _ => return None,
                })
            }

            /// Returns whether words encode an op that this build leaves out: see the crate's
            /// features.
            pub fn is_left_out(words: &[u32; OP_WORDS]) -> bool {
                let [code, ..] = *words;
                [$($((!cfg!(feature = $feature)).then_some($code),)?)*].contains(&Some(code))
            }

            /// Returns the op's name.
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

            /// Reports the arena elements that the op reads, then those that it writes, see
            /// [`Operation::accesses`].
            pub fn accesses(&self, see: &mut dyn FnMut(Access)) {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.accesses(see),)* }
            }

            /// Visits every span of the arena that is not empty, see [`Operation::each_span`].
            pub fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.each_span(visit),)* }
            }

            /// Returns the integer slots that the op reads and writes.
            pub fn slots(&self) -> Slots {
                match self { $($(#[cfg(feature = $feature)])? Self::$name(op) => op.slots(),)* }
            }

            /// Returns the cost of the op at the largest context.
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
    ImageIntegers = 21 if "conv",
    IntegerConv = 22 if "conv",
}

#[cfg(test)]
pub(crate) mod tests {
    use std::vec::Vec;

    use super::{INT_SLOTS, Op};
    use crate::machine::{ExecError, Machine};
    use crate::place::Span;
    use crate::{Checker, Isa, Spaces};

    /// Checks an op and runs it on an arena and weights of its own.
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

    /// Returns the arena after a run that cannot fail and uses no integers.
    pub fn computed(op: impl Into<Op>, arena: &[f32], weights: &[f32]) -> Vec<f32> {
        let (arena, _) = run(op, arena, weights, [0; INT_SLOTS]).expect("the op runs");
        arena
    }

    pub const fn span(offset: u32, len: u32) -> Span {
        Span { offset, len }
    }
}
