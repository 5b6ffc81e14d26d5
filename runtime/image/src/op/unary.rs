//! Unary operations, element by element.

use lads_kernels as kernels;

use super::{Operation, Work};
use crate::access::{self, Access};
use crate::check::{Checked, Checker, Fault, require};
use crate::codec::{record, word_enum_for};
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Operand, Span};

pub use lads_kernels::UnaryKind;

word_enum_for!(UnaryKind {
    Relu = 0,
    LeakyRelu = 1,
    Tanh = 2,
    Sigmoid = 3,
    Exp = 4,
    Log = 5,
    Sqrt = 6,
    Rsqrt = 7,
    Neg = 8,
    Abs = 9,
    Recip = 10,
    Erf = 11,
    Square = 12,
    Elu = 13,
    Softplus = 14,
    Mish = 15,
    Trunc = 16,
});

record! {
    /// Unary operation `y[i] = kind(x[i])`. The op is in place when `x` and `y` are the same span.
    pub struct Unary {
        /// Function to compute.
        pub kind: UnaryKind,
        /// Slope of `LeakyRelu`, factor of `Elu`; ignored for the others.
        pub alpha: f32,
        /// Operand of the function.
        pub x: Operand,
        /// Result, of the length of `x`.
        pub y: Span,
    }
}

impl Operation for Unary {
    fn check(&self, checker: &Checker) -> Checked {
        require(self.x.len == self.y.len, Fault::Shape)?;
        if self.x.arena() == Some(self.y) {
            return checker.arena(self.y);
        }
        checker.result(self.y, self.x)
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        let isa = machine.isa;
        let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
        let unary = kernels::Unary {
            kind: self.kind,
            alpha: self.alpha,
        };
        if self.x.arena() == Some(self.y) {
            unary.run_in_place(isa, y);
        } else {
            unary.run(isa, read.get(self.x)?, y);
        }
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
    use super::{Unary, UnaryKind};
    use crate::op::tests::{computed, span};

    #[test]
    fn in_place_and_beside() {
        let op = Unary {
            kind: UnaryKind::LeakyRelu,
            alpha: 0.5,
            x: span(0, 2).into(),
            y: span(2, 2),
        };
        let arena = [-4.0, 3.0, 0.0, 0.0];
        assert_eq!(computed(op, &arena, &[]), [-4.0, 3.0, -2.0, 3.0]);
        let op = Unary {
            y: span(0, 2),
            ..op
        };
        assert_eq!(computed(op, &arena, &[]), [-2.0, 3.0, 0.0, 0.0]);
    }
}
