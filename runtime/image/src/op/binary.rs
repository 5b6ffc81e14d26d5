//! Binary operations, element by element, with broadcasts.

use lads_kernels as kernels;

use super::{Operation, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, exactly, reaches};
use crate::codec::{record, word_enum_for};
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Operand, Span};

pub use lads_kernels::BinaryKind;

word_enum_for!(BinaryKind { Add = 0, Sub = 1, Mul = 2, Div = 3, Max = 4, Min = 5, Pow = 6, Greater = 7, Keep = 8, });

record! {
    /// Binary operation `y[i] = kind(a[i], b[i])` over four dimensions. The op is in place when `y`
    /// is exactly the span of a contiguous `a` or `b`.
    pub struct Binary {
        /// Function to compute.
        pub kind: BinaryKind,
        /// First operand.
        pub a: Operand,
        /// Second operand.
        pub b: Operand,
        /// Result, contiguous, of shape `dims`.
        pub y: Span,
        /// Shape of the result, padded in front with ones.
        pub dims: [u32; 4],
        /// Elements from one index to the next in each dimension of `a`; 0 broadcasts.
        pub a_strides: [u32; 4],
        /// Elements from one index to the next in each dimension of `b`; 0 broadcasts.
        pub b_strides: [u32; 4],
    }
}

impl Operation for Binary {
    fn check(&self, checker: &Checker) -> Checked {
        exactly(self.y.len, self.dims)?;
        checker.arena(self.y)?;
        for (x, strides) in [(self.a, self.a_strides), (self.b, self.b_strides)] {
            checker.operand(x)?;
            reaches(x.len, self.dims, strides)?;
            let in_place = x.arena() == Some(self.y) && is_contiguous(self.dims, strides);
            if !in_place {
                checker.result(self.y, x)?;
            }
        }
        Ok(())
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        let input = |x: Operand, strides: [u32; 4]| {
            Ok(if x.arena() == Some(self.y) {
                kernels::Input::Output
            } else {
                kernels::Input::Strided(read.get(x)?, strides.map(|s| s as usize))
            })
        };
        let (a, b) = (
            input(self.a, self.a_strides)?,
            input(self.b, self.b_strides)?,
        );
        kernels::binary(self.kind, a, b, self.dims.map(|d| d as usize), y);
        Ok(())
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        access::read_strided(self.a, self.dims, self.a_strides, see);
        access::read_strided(self.b, self.dims, self.b_strides, see);
        access::write(self.y, see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_operand(&mut self.a, visit);
        access::visit_operand(&mut self.b, visit);
        access::visit_span(&mut self.y, visit);
    }

    fn work(&self) -> Work {
        Work::elements(self.y.len)
            .with_operand(self.a)
            .with_operand(self.b)
    }
}

/// Returns whether strides are those of a contiguous layout; the strides of dimensions of length
/// one do not matter.
fn is_contiguous(dims: [u32; 4], strides: [u32; 4]) -> bool {
    let mut expected = 1_u64;
    let [d0, d1, d2, d3] = dims;
    let [s0, s1, s2, s3] = strides;
    [(d3, s3), (d2, s2), (d1, s1), (d0, s0)]
        .into_iter()
        .all(|(dim, stride)| {
            let fits = dim == 1 || u64::from(stride) == expected;
            expected = expected.saturating_mul(u64::from(dim));
            fits
        })
}

#[cfg(test)]
mod tests {
    use super::{Binary, BinaryKind, is_contiguous};
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn in_place_and_broadcast() {
        let op = Binary {
            kind: BinaryKind::Sub,
            a: WeightSpan { offset: 0, len: 2 }.into(),
            b: span(0, 4).into(),
            y: span(0, 4),
            dims: [1, 1, 2, 2],
            a_strides: [0, 0, 0, 1],
            b_strides: [0, 0, 2, 1],
        };
        let y = computed(op, &[1.0, 2.0, 3.0, 4.0], &[10.0, 20.0]);
        assert_eq!(y, [9.0, 18.0, 7.0, 16.0]);
    }

    #[test]
    fn a_dimension_of_length_one_has_any_stride() {
        assert!(is_contiguous([1, 2, 1, 3], [99, 3, 7, 1]));
        assert!(!is_contiguous([1, 2, 1, 3], [99, 4, 7, 1]));
        assert!(!is_contiguous([1, 1, 2, 2], [0, 0, 1, 2]));
    }
}
