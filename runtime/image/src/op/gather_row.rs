//! One row of a table, chosen by an integer.

use super::{Operation, Slots, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, exactly};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{IntSlot, Operand, Space, Span};

record! {
    /// `y = table[index + shift]`: a timestep's embedding, a codebook entry, the next action of a queue in the arena.
    ///
    /// A row outside `0..rows` is an error when the program runs. `y` does not overlap the table.
    pub struct GatherRow {
        /// `[rows, row_len]`
        pub table: Operand,
        /// Elements of a row.
        pub row_len: u32,
        /// Rows of the table.
        pub rows: u32,
        /// Holds the index.
        pub index: IntSlot,
        /// Added to the index.
        pub shift: i32,
        /// `[row_len]`
        pub y: Span,
    }
}

impl Operation for GatherRow {
    fn check(&self, checker: &Checker) -> Checked {
        checker.result(self.y, self.table)?;
        exactly(self.table.len, [self.rows, self.row_len])?;
        exactly(self.y.len, [self.row_len])
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let row = i64::from(machine.int(self.index)).saturating_add(i64::from(self.shift));
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        let table = read.get(self.table)?;
        let found = usize::try_from(row)
            .ok()
            .and_then(|row| table.chunks_exact(self.row_len.max(1) as usize).nth(row));
        let rows = self.rows;
        let from = found.ok_or(ExecError::Index { row, rows })?;
        y.iter_mut().zip(from).for_each(|(y, &x)| *y = x);
        Ok(())
    }

    /// Reads the whole table: which row it is, nobody knows before it runs.
    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        access::read(self.table, see);
        access::write(self.y, see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_operand(&mut self.table, visit);
        access::visit_span(&mut self.y, visit);
    }

    fn slots(&self) -> Slots {
        Slots {
            read: Some(self.index),
            written: None,
        }
    }

    fn work(&self) -> Work {
        let weights = matches!(self.table.space, Space::Weights);
        Work {
            weight_words: if weights { self.row_len.into() } else { 0 },
            ..Work::default()
        }
    }
}
