//! Strided copies: transposes, slices, broadcasts, concatenations.

use lads_kernels as kernels;

use super::{Operation, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, Fault, product, reaches, require};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Operand, Span};

record! {
    /// Strided copy `y[i] = x[i]` over four dimensions, both sides strided: transposes, slices,
    /// broadcasts and the parts of a concatenation.
    pub struct Copy {
        /// Operand to copy from.
        pub x: Operand,
        /// Span to copy to; elements of the span that the strides do not reach keep their value.
        pub y: Span,
        /// Shape of the copy, padded in front with ones.
        pub dims: [u32; 4],
        /// Elements from one index to the next in each dimension of `x`; 0 broadcasts.
        pub x_strides: [u32; 4],
        /// Elements from one index to the next in each dimension of `y`.
        pub y_strides: [u32; 4],
    }
}

impl Operation for Copy {
    fn check(&self, checker: &Checker) -> Checked {
        checker.result(self.y, self.x)?;
        reaches(self.x.len, self.dims, self.x_strides)?;
        reaches(self.y.len, self.dims, self.y_strides)?;
        // Each element is written once.
        let written = product(self.dims);
        let once = self
            .dims
            .into_iter()
            .zip(self.y_strides)
            .all(|(dim, stride)| dim == 1 || stride != 0);
        require(
            written != 0 && written <= u64::from(self.y.len) && once,
            Fault::Shape,
        )
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        let copy = kernels::StridedCopy {
            dims: self.dims.map(|d| d as usize),
            x_strides: self.x_strides.map(|s| s as usize),
            y_strides: self.y_strides.map(|s| s as usize),
        };
        copy.run(read.get(self.x)?, y);
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        access::read_strided(self.x, self.dims, self.x_strides, see);
        see(Access::strided(
            AccessKind::Write,
            self.y,
            self.dims,
            self.y_strides,
        ));
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_operand(&mut self.x, visit);
        access::visit_span(&mut self.y, visit);
    }

    fn work(&self) -> Work {
        Work::products(self.dims).with_operand(self.x)
    }
}

#[cfg(test)]
mod tests {
    use super::Copy;
    use crate::op::tests::{computed, span};

    #[test]
    fn what_the_strides_do_not_reach_stays() {
        let transposed = Copy {
            x: span(0, 4).into(),
            y: span(4, 5),
            dims: [1, 1, 2, 2],
            x_strides: [0, 0, 1, 2],
            y_strides: [0, 0, 3, 1],
        };
        let arena = [1.0, 2.0, 3.0, 4.0, 0.0, 0.0, 9.0, 0.0, 0.0];
        let expected = [1.0, 2.0, 3.0, 4.0, 1.0, 3.0, 9.0, 2.0, 4.0];
        assert_eq!(computed(transposed, &arena, &[]), expected);
    }
}
