//! Layer normalisation of rows.

use lads_kernels as kernels;

use super::{Operation, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, exactly};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Span, WeightSpan};

record! {
    /// Layer normalisation `y = (x - mean) / sqrt(variance + eps) * gamma + beta`, per row, with
    /// the population variance.
    pub struct LayerNorm {
        /// Input `[rows, cols]`.
        pub x: Span,
        /// Result `[rows, cols]`.
        pub y: Span,
        /// Scale `[cols]`.
        pub gamma: WeightSpan,
        /// Shift `[cols]`.
        pub beta: WeightSpan,
        /// Number of rows.
        pub rows: u32,
        /// Number of columns.
        pub cols: u32,
        /// Constant added to the variance.
        pub eps: f32,
    }
}

impl Operation for LayerNorm {
    fn check(&self, checker: &Checker) -> Checked {
        checker.result(self.y, self.x.into())?;
        exactly(self.x.len, [self.rows, self.cols])?;
        exactly(self.y.len, [self.rows, self.cols])?;
        for weights in [self.gamma, self.beta] {
            checker.weights(weights)?;
            exactly(weights.len, [self.cols])?;
        }
        Ok(())
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let isa = machine.isa;
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        let norm = kernels::LayerNorm {
            gamma: read.get(self.gamma.into())?,
            beta: read.get(self.beta.into())?,
            eps: self.eps,
        };
        norm.run(isa, read.get(self.x.into())?, y);
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
        Work::elements(self.x.len).with_weights([self.gamma, self.beta])
    }
}

#[cfg(test)]
mod tests {
    use super::LayerNorm;
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn each_row_is_scaled_and_shifted() {
        let norm = LayerNorm {
            x: span(0, 4),
            y: span(4, 4),
            gamma: WeightSpan { offset: 0, len: 2 },
            beta: WeightSpan { offset: 2, len: 2 },
            rows: 2,
            cols: 2,
            eps: 0.0,
        };
        let arena = [1.0, 3.0, 8.0, 4.0, 0.0, 0.0, 0.0, 0.0];
        let y = &computed(norm, &arena, &[2.0, 3.0, 10.0, 20.0])[4..];
        for (y, expected) in y.iter().zip([8.0, 23.0, 12.0, 17.0]) {
            assert!((y - expected).abs() < 1e-5, "{y} against {expected}");
        }
    }
}
