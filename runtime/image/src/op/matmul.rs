//! Matrix products of two operands, batched and strided.

use lads_kernels as kernels;

use super::{Operation, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, Fault, exactly, reaches, require};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Operand, Span};

record! {
    /// Matrix product `y[b, i, j] = sum over l of a[b, i, l] * b[b, l, j]`: of two activations, or
    /// with weights that are not packed.
    pub struct MatMul {
        /// First operand.
        pub a: Operand,
        /// Second operand.
        pub b: Operand,
        /// Result `[batch, m, n]`, contiguous.
        pub y: Span,
        /// Number of independent products.
        pub batch: u32,
        /// Number of rows.
        pub m: u32,
        /// Inner dimension.
        pub k: u32,
        /// Number of columns.
        pub n: u32,
        /// Strides of `a` over batch, `m` and `k`.
        pub a_strides: [u32; 3],
        /// Strides of `b` over batch, `k` and `n`.
        pub b_strides: [u32; 3],
    }
}

impl Operation for MatMul {
    fn check(&self, checker: &Checker) -> Checked {
        checker.result(self.y, self.a)?;
        checker.result(self.y, self.b)?;
        exactly(self.y.len, [self.batch, self.m, self.n])?;
        // A product of two broadcasts could be made to take for ever.
        require(
            self.k != 0 && self.k <= self.a.len.max(self.b.len),
            Fault::Shape,
        )?;
        reaches(self.a.len, [self.batch, self.m, self.k], self.a_strides)?;
        reaches(self.b.len, [self.batch, self.k, self.n], self.b_strides)
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        let product = kernels::MatMul {
            batch: self.batch as usize,
            m: self.m as usize,
            k: self.k as usize,
            n: self.n as usize,
            a_strides: self.a_strides.map(|s| s as usize),
            b_strides: self.b_strides.map(|s| s as usize),
        };
        product.run(read.get(self.a)?, read.get(self.b)?, y);
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        let [ab, am, ak] = self.a_strides;
        let [bb, bk, bn] = self.b_strides;
        let Self { batch, m, k, n, .. } = *self;
        access::read_strided(self.a, [1, batch, m, k], [0, ab, am, ak], see);
        access::read_strided(self.b, [1, batch, k, n], [0, bb, bk, bn], see);
        access::write(self.y, see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_operand(&mut self.a, visit);
        access::visit_operand(&mut self.b, visit);
        access::visit_span(&mut self.y, visit);
    }

    fn work(&self) -> Work {
        Work::products([self.batch, self.m, self.k, self.n])
            .with_operand(self.a)
            .with_operand(self.b)
    }
}

#[cfg(test)]
mod tests {
    use super::MatMul;
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn a_product_with_a_transposed_operand() {
        let product = MatMul {
            a: span(0, 4).into(),
            b: WeightSpan { offset: 1, len: 4 }.into(),
            y: span(4, 4),
            batch: 1,
            m: 2,
            k: 2,
            n: 2,
            a_strides: [0, 2, 1],
            b_strides: [0, 1, 2],
        };
        let arena = [1.0, 2.0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0];
        let computed = computed(product, &arena, &[9.0, 1.0, 0.5, 2.0, 4.0]);
        assert_eq!(computed[4..], [2.0, 10.0, 5.0, 22.0]);
    }
}
