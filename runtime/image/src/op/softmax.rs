//! Softmax of rows.

use lads_kernels as kernels;

use super::{Operation, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, exactly};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::Span;

record! {
    /// Softmax `y = exp(x - max) / sum(exp(x - max))`, per row.
    pub struct Softmax {
        /// Input `[rows, cols]`.
        pub x: Span,
        /// Result `[rows, cols]`.
        pub y: Span,
        /// Number of rows.
        pub rows: u32,
        /// Number of columns.
        pub cols: u32,
    }
}

impl Operation for Softmax {
    fn check(&self, checker: &Checker) -> Checked {
        checker.result(self.y, self.x.into())?;
        exactly(self.x.len, [self.rows, self.cols])?;
        exactly(self.y.len, [self.rows, self.cols])
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let isa = machine.isa;
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        kernels::softmax(isa, read.get(self.x.into())?, self.cols as usize, y);
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        access::read(self.x.into(), see);
        access::write(self.y, see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.x, visit);
        access::visit_span(&mut self.y, visit);
    }

    fn work(&self) -> Work {
        Work::elements(self.x.len)
    }
}

#[cfg(test)]
mod tests {
    use super::Softmax;
    use crate::op::tests::{computed, span};

    #[test]
    fn each_row_sums_to_one() {
        let softmax = Softmax {
            x: span(0, 4),
            y: span(4, 4),
            rows: 2,
            cols: 2,
        };
        let arena = [3.0, 3.0, 0.0, 3.0_f32.ln(), 0.0, 0.0, 0.0, 0.0];
        let y = &computed(softmax, &arena, &[])[4..];
        for (y, expected) in y.iter().zip([0.5, 0.5, 0.25, 0.75]) {
            assert!((y - expected).abs() < 1e-6, "{y} against {expected}");
        }
    }
}
