//! Sums, means and extrema along one axis.

use lads_kernels as kernels;

use super::{Operation, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, exactly};
use crate::codec::{record, word_enum_for};
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Operand, Span};

pub use lads_kernels::ReduceKind;

word_enum_for!(ReduceKind { Sum = 0, Mean = 1, Max = 2, Min = 3, Prod = 4, });

record! {
    /// Reduction `y[o, i] = kind over a of x[o, a, i]`.
    pub struct Reduce {
        /// Function to compute.
        pub kind: ReduceKind,
        /// Input `[outer, axis, inner]`, contiguous.
        pub x: Operand,
        /// Result `[outer, inner]`.
        pub y: Span,
        /// Product of the dimensions before the axis.
        pub outer: u32,
        /// Length of the axis.
        pub axis: u32,
        /// Product of the dimensions after the axis.
        pub inner: u32,
    }
}

impl Operation for Reduce {
    fn check(&self, checker: &Checker) -> Checked {
        checker.result(self.y, self.x)?;
        exactly(self.x.len, [self.outer, self.axis, self.inner])?;
        exactly(self.y.len, [self.outer, self.inner])
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        let axis = kernels::Axis {
            len: self.axis as usize,
            inner: self.inner as usize,
        };
        kernels::reduce(self.kind, read.get(self.x)?, axis, y);
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        access::read(self.x, see);
        access::write(self.y, see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_operand(&mut self.x, visit);
        access::visit_span(&mut self.y, visit);
    }

    fn work(&self) -> Work {
        Work::elements(self.x.len).with_operand(self.x)
    }
}

#[cfg(test)]
mod tests {
    use super::{Reduce, ReduceKind};
    use crate::op::tests::{computed, span};

    #[test]
    fn the_axis_in_the_middle_disappears() {
        let reduced = |kind| {
            let op = Reduce {
                kind,
                x: span(0, 8).into(),
                y: span(8, 4),
                outer: 2,
                axis: 2,
                inner: 2,
            };
            let arena = [1.0, 2.0, 3.0, 5.0, -4.0, 0.5, 2.0, 4.0, 0.0, 0.0, 0.0, 0.0];
            computed(op, &arena, &[])[8..].to_vec()
        };
        assert_eq!(reduced(ReduceKind::Sum), [4.0, 7.0, -2.0, 4.5]);
        assert_eq!(reduced(ReduceKind::Mean), [2.0, 3.5, -1.0, 2.25]);
        assert_eq!(reduced(ReduceKind::Max), [3.0, 5.0, 2.0, 4.0]);
        assert_eq!(reduced(ReduceKind::Min), [1.0, 2.0, -4.0, 0.5]);
        assert_eq!(reduced(ReduceKind::Prod), [3.0, 10.0, -8.0, 2.0]);
    }
}
