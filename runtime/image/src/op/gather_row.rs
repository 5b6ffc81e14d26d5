//! Copies one row of a table, chosen by an integer.

use super::{Operation, Slots, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, exactly};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{IntSlot, Operand, Space, Span};

record! {
    /// Table lookup `y = table[index + shift]`: a timestep's embedding, a codebook entry, the next
    /// action of a queue in the arena.
    ///
    /// A row outside `0..rows` is an error when the program runs. `y` does not overlap the table.
    pub struct GatherRow {
        /// Table `[rows, row_len]`.
        pub table: Operand,
        /// Number of elements of a row.
        pub row_len: u32,
        /// Number of rows of the table.
        pub rows: u32,
        /// Slot that holds the index.
        pub index: IntSlot,
        /// Number added to the index.
        pub shift: i32,
        /// Result `[row_len]`.
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

    /// Reports a read of the whole table, because the row is known only at run time.
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
            ..Work::elements(self.row_len)
        }
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::GatherRow;
    use crate::machine::ExecError;
    use crate::op::tests::{run, span};
    use crate::place::{INT_SLOTS, IntSlot, Operand, WeightSpan};

    const TABLE: [f32; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];

    fn row(table: Operand, index: u32, shift: i32) -> Result<Vec<f32>, ExecError> {
        let op = GatherRow {
            table,
            row_len: 2,
            rows: 3,
            index: IntSlot(1),
            shift,
            y: span(6, 2),
        };
        let mut ints = [9; INT_SLOTS];
        ints[1] = index;
        let arena = [&TABLE[..], &[0.0; 2]].concat();
        let (arena, _) = run(op, &arena, &TABLE, ints)?;
        Ok(arena[6..].to_vec())
    }

    /// Reads rows of tables in the image, and of queues in the arena.
    #[test]
    fn rows_come_from_either_space() {
        let weights = WeightSpan { offset: 0, len: 6 };
        for table in [span(0, 6).into(), weights.into()] {
            assert_eq!(row(table, 0, 0), Ok([1.0, 2.0].into()));
            assert_eq!(row(table, 2, 0), Ok([5.0, 6.0].into()));
            assert_eq!(row(table, 2, -1), Ok([3.0, 4.0].into()));
            let beyond = |row| Err(ExecError::Index { row, rows: 3 });
            assert_eq!(row(table, 3, 0), beyond(3));
            assert_eq!(row(table, 0, -1), beyond(-1));
            assert_eq!(row(table, u32::MAX, i32::MAX), beyond(6_442_450_942));
        }
    }
}
