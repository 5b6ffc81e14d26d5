//! Depthwise convolution, each channel by itself, over an image whose border is stored.

use lads_kernels as kernels;

use super::picture::{Picture, Window, called};
use super::{Activation, Operation, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, apart, exactly};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Span, WeightSpan};

record! {
    /// Depthwise convolution `y = activation(x * w + b)`, each channel with a kernel of its own.
    pub struct Depthwise {
        /// Input image `[rows, columns, c]`, border included.
        pub x: Picture,
        /// Output image `[out rows, out columns, c]`.
        pub y: Picture,
        /// Window that moves over `x`.
        pub window: Window,
        /// Number of channels.
        pub c: u32,
        /// Weights `[kernel rows, kernel columns, c]`, the channels rounded up to sixteen:
        /// `lads_kernels::depthwise_packed_len` elements.
        pub w: WeightSpan,
        /// Bias `[c]`.
        pub bias: WeightSpan,
        /// Activation, applied last.
        pub activation: Activation,
    }
}

impl Operation for Depthwise {
    fn check(&self, checker: &Checker) -> Checked {
        self.window.check()?;
        self.x.read(checker, self.window.covered(), self.c)?;
        self.y.written(checker, self.window.out.words(), self.c)?;
        apart(self.y.at, [self.x.at])?;
        checker.weights(self.w)?;
        checker.weights(self.bias)?;
        let [rows, cols] = self.window.kernel.words();
        exactly(self.w.len, [rows, cols, self.c.div_ceil(16), 16])?;
        exactly(self.bias.len, [self.c])
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        called(|| {
            let isa = machine.isa;
            let (read, y) = Readable::cut(weights, machine.arena, self.y.at)?;
            let layer = kernels::Depthwise {
                sweep: self.window.sweep(self.x, self.y),
                c: self.c as usize,
                w: read.get(self.w.into())?,
                bias: read.get(self.bias.into())?,
                activation: self.activation,
            };
            layer.run(isa, read.get(self.x.at.into())?, y);
            Ok(())
        })
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        see(self
            .x
            .access(AccessKind::Read, self.window.covered(), self.c));
        see(self
            .y
            .access(AccessKind::Write, self.window.out.words(), self.c));
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.x.at, visit);
        access::visit_span(&mut self.y.at, visit);
    }

    fn work(&self) -> Work {
        let ([rows, cols], [down, along]) = (self.window.out.words(), self.window.kernel.words());
        Work::products([rows, cols, down, along, self.c]).with_weights([self.w, self.bias])
    }
}

#[cfg(test)]
mod tests {
    use std::vec;

    use super::super::picture::Pair;
    use super::{Activation, Depthwise, Picture, Window};
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn each_channel_has_a_kernel_of_its_own() {
        let mut weights = vec![0.0; lads_kernels::depthwise_packed_len([2, 2])];
        lads_kernels::depthwise_pack(&[1.0, 10.0, 2.0, -1.0], [2, 2], &mut weights);
        let len = weights.len() as u32;
        weights.extend([0.5, 1.0]);
        // A column of three pixels of two channels, a kernel of two rows.
        let picture = |offset, rows: u32| Picture {
            at: span(offset, 2 * rows),
            row: 2,
            pixel: 2,
        };
        let layer = Depthwise {
            x: picture(0, 3),
            y: picture(6, 2),
            window: Window {
                out: Pair { rows: 2, cols: 1 },
                kernel: Pair { rows: 2, cols: 1 },
                stride: Pair::of(1),
                dilation: Pair::of(1),
            },
            c: 2,
            w: WeightSpan { offset: 0, len },
            bias: WeightSpan {
                offset: len,
                len: 2,
            },
            activation: Activation::Clipped(6.0),
        };
        let arena = [1.0, 1.0, 2.0, 3.0, -4.0, 30.0, 0.0, 0.0, 0.0, 0.0];
        let expected = [5.5, 6.0, 0.0, 1.0];
        assert_eq!(computed(layer, &arena, &weights)[6..], expected);
    }
}
