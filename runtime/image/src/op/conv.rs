//! Convolution over an image whose border is stored: packed weights, bias, activation, residual
//! connection.

use lads_kernels as kernels;

use super::picture::{Picture, Window, called};
use super::{Operation, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, apart, exactly};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Span, WeightSpan};

pub use lads_kernels::Activation;

record! {
    /// Convolution `y = activation(x * W + b + (accumulate ? y : 0))`; with `accumulate` the op is
    /// in place on `y`: a residual connection, inside the activation.
    pub struct Conv {
        /// Input image `[rows, columns, c]`, border included.
        pub x: Picture,
        /// Output image `[out rows, out columns, n]`.
        pub y: Picture,
        /// Window that moves over `x`.
        pub window: Window,
        /// Number of input channels.
        pub c: u32,
        /// Number of output channels.
        pub n: u32,
        /// Weights `[kernel rows, kernel columns, c, n]` in panels of 16 outputs:
        /// `lads_kernels::conv_packed_len` elements, ordered by `lads_kernels::conv_pack`.
        pub w: WeightSpan,
        /// Bias `[n]`.
        pub bias: WeightSpan,
        /// Activation, applied last.
        pub activation: Activation,
        /// True if the result is added to `y`.
        pub accumulate: bool,
    }
}

impl Operation for Conv {
    fn check(&self, checker: &Checker) -> Checked {
        self.window.check()?;
        self.x.read(checker, self.window.covered(), self.c)?;
        self.y.written(checker, self.window.out.words(), self.n)?;
        apart(self.y.at, [self.x.at])?;
        checker.weights(self.w)?;
        checker.weights(self.bias)?;
        let [rows, cols] = self.window.kernel.words();
        exactly(self.w.len, [self.n.div_ceil(16), rows, cols, self.c, 16])?;
        exactly(self.bias.len, [self.n])
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        called(|| {
            let isa = machine.isa;
            let (read, y) = Readable::cut(weights, machine.arena, self.y.at)?;
            let conv = kernels::Conv {
                sweep: self.window.sweep(self.x, self.y),
                c: self.c as usize,
                n: self.n as usize,
                w: read.get(self.w.into())?,
                bias: read.get(self.bias.into())?,
                activation: self.activation,
                accumulate: self.accumulate,
            };
            conv.run(isa, read.get(self.x.at.into())?, y);
            Ok(())
        })
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        see(self
            .x
            .access(AccessKind::Read, self.window.covered(), self.c));
        let out = |kind| self.y.access(kind, self.window.out.words(), self.n);
        if self.accumulate {
            see(out(AccessKind::Read));
        }
        see(out(AccessKind::Write));
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.x.at, visit);
        access::visit_span(&mut self.y.at, visit);
    }

    fn work(&self) -> Work {
        let ([rows, cols], [down, along]) = (self.window.out.words(), self.window.kernel.words());
        Work::products([rows, cols, down, along, self.c, self.n]).with_weights([self.w, self.bias])
    }
}

#[cfg(test)]
mod tests {
    use std::vec;

    use super::super::picture::Pair;
    use super::{Activation, Conv, Picture, Window};
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn the_residual_connection_comes_before_the_activation() {
        let mut weights = vec![0.0; lads_kernels::conv_packed_len([2, 1])];
        lads_kernels::conv_pack(&[1.0, -2.0], [2, 1], &mut weights);
        let len = weights.len() as u32;
        weights.push(0.5);
        // A row of three pixels of one channel, a kernel of two columns.
        let conv = Conv {
            x: Picture {
                at: span(0, 3),
                row: 3,
                pixel: 1,
            },
            y: Picture {
                at: span(3, 2),
                row: 2,
                pixel: 1,
            },
            window: Window {
                out: Pair { rows: 1, cols: 2 },
                kernel: Pair { rows: 1, cols: 2 },
                stride: Pair::of(1),
                dilation: Pair::of(1),
            },
            c: 1,
            n: 1,
            w: WeightSpan { offset: 0, len },
            bias: WeightSpan {
                offset: len,
                len: 1,
            },
            activation: Activation::Relu,
            accumulate: true,
        };
        let arena = [3.0, 1.0, 2.0, 10.0, 1.0];
        assert_eq!(computed(conv, &arena, &weights)[3..], [11.5, 0.0]);
        let conv = Conv {
            accumulate: false,
            ..conv
        };
        assert_eq!(computed(conv, &arena, &weights)[3..], [1.5, 0.0]);
    }
}
