//! Memory that a program runs in, and the errors of a run.
//!
//! A run checks nothing again: bounds, shapes and overlaps were checked by
//! [`Program::new_checked`](crate::Program::new_checked). Slices are still taken with `get`,
//! because this crate has no unsafe code; a missing span ends the run with [`ExecError::Span`],
//! which a checked program in memory of the right size never does.

use core::error::Error;
use core::fmt;

use lads_kernels::Isa;

use crate::place::{INT_SLOTS, IntSlot, Operand, Space, Span};

/// Reason why a run ended early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExecError {
    /// An index is outside its table: the timestep or an index is outside the range of the policy.
    Index {
        /// Row that was asked for.
        row: i64,
        /// Number of rows of the table.
        rows: u32,
    },
    /// The KV cache has no room for the tokens of another run.
    Full {
        /// Number of rows of the cache.
        rows: usize,
        /// Number of rows needed.
        needed: usize,
    },
    /// A span lies outside the memory that was given.
    Span,
}

impl fmt::Display for ExecError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Index { row, rows } => write!(f, "row {row} of a table of {rows} rows"),
            Self::Full { rows, needed } => {
                write!(f, "{needed} rows in a KV cache of {rows} rows")
            }
            Self::Span => f.write_str("a span lies outside the memory of the run"),
        }
    }
}

impl Error for ExecError {}

/// The memory that programs run in.
#[derive(Debug)]
pub struct Machine<'m> {
    /// Scratch memory, at least as many elements as the program's arena.
    pub arena: &'m mut [f32],
    /// The KV cache of the entry that runs: spans of attention are relative to it.
    pub cache: &'m mut [f32],
    /// Integer slots: timesteps and indices.
    pub ints: [u32; INT_SLOTS],
    /// Number of valid rows of `cache` before the run.
    pub past: usize,
    /// Instruction set that the kernels run on.
    pub isa: Isa,
}

impl Machine<'_> {
    /// Returns the integer in a slot.
    #[inline]
    pub fn int(&self, slot: IntSlot) -> u32 {
        self.ints.get(usize::from(slot.0)).copied().unwrap_or(0)
    }

    /// Sets the integer in a slot.
    #[inline]
    pub fn set_int(&mut self, slot: IntSlot, value: u32) {
        if let Some(int) = self.ints.get_mut(usize::from(slot.0)) {
            *int = value;
        }
    }
}

/// Memory that an op may read: the weights, and the arena without the span that the op writes.
pub(crate) struct Readable<'r> {
    weights: &'r [f32],
    below: &'r [f32],
    above: &'r [f32],
    above_start: usize,
}

impl<'r> Readable<'r> {
    /// Splits the result's span from the arena.
    #[inline]
    pub fn cut(
        weights: &'r [f32],
        arena: &'r mut [f32],
        y: Span,
    ) -> Result<(Self, &'r mut [f32]), ExecError> {
        let (below, rest) = arena
            .split_at_mut_checked(y.offset as usize)
            .ok_or(ExecError::Span)?;
        let (y_slice, above) = rest
            .split_at_mut_checked(y.len as usize)
            .ok_or(ExecError::Span)?;
        let above_start = y.range().end;
        Ok((
            Self {
                weights,
                below,
                above,
                above_start,
            },
            y_slice,
        ))
    }

    /// Returns the elements of an operand; an error if they are missing, or belong to the result.
    #[inline]
    pub fn get(&self, operand: Operand) -> Result<&'r [f32], ExecError> {
        let range = operand.range();
        let elements = match operand.space {
            Space::Weights => self.weights.get(range),
            Space::Arena if range.end <= self.below.len() => self.below.get(range),
            Space::Arena => range
                .start
                .checked_sub(self.above_start)
                .and_then(|start| self.above.get(start..start.saturating_add(range.len()))),
        };
        elements.ok_or(ExecError::Span)
    }
}
