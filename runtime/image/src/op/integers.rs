//! Convolution with integer weights over an image of integers, and the conversion of an image to
//! integers, which all convolutions that read it share.

use lads_kernels as kernels;

use super::linear::is_built;
use super::picture::{Pair, Picture, Window, called};
use super::{Activation, Operation, WeightFormat, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, Fault, apart, exactly, reaches, require};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Span, WeightSpan};

record! {
    /// Converts an image to 16-bit integers with one scale for all of them.
    pub struct ImageIntegers {
        /// Input image `[rows, columns, c]`, border included.
        pub x: Picture,
        /// Number of pixels.
        pub size: Pair,
        /// Number of channels.
        pub c: u32,
        /// Result: the scale in one word, then the integers, row after row, two to a word, and at least
        /// one more, which is zero.
        pub y: Span,
    }
}

impl Operation for ImageIntegers {
    fn check(&self, checker: &Checker) -> Checked {
        require(is_built(WeightFormat::Int16), Fault::LeftOut)?;
        self.x.read(checker, self.size.words(), self.c)?;
        checker.arena(self.y)?;
        apart(self.y, [self.x.at])?;
        let [rows, cols] = self.size.words();
        let integers = u64::from(rows)
            .saturating_mul(cols.into())
            .saturating_mul(self.c.into());
        // The scale, and a whole word for the one more.
        let words = (integers / 2).saturating_add(2);
        require(u64::from(self.y.len) == words, Fault::Shape)
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        called(|| {
            let isa = machine.isa;
            let (read, y) = Readable::cut(weights, machine.arena, self.y)?;
            let image = kernels::ImageIntegers {
                size: self.size.sizes(),
                c: self.c as usize,
                x_strides: self.x.strides(),
            };
            let (scale, integers) = y.split_first_mut().ok_or(ExecError::Span)?;
            // A cast of whole words to smaller numbers: it fails on no span.
            let integers = bytemuck::try_cast_slice_mut(integers).map_err(|_| ExecError::Span)?;
            *scale = image.run(isa, read.get(self.x.at.into())?, integers);
            Ok(())
        })
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        see(self.x.access(AccessKind::Read, self.size.words(), self.c));
        access::write(self.y, see);
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.x.at, visit);
        access::visit_span(&mut self.y, visit);
    }

    fn work(&self) -> Work {
        let [rows, cols] = self.size.words();
        Work::products([rows, cols, self.c])
    }
}

record! {
    /// Convolution `y = activation(x * W + b + (accumulate ? y : 0))` with integer weights; with
    /// `accumulate` the op is in place on `y`: a residual connection, inside the activation.
    pub struct IntegerConv {
        /// Input image, border included: all of the result of an [`ImageIntegers`].
        pub x: Span,
        /// Integers before the first that is read.
        pub first: u32,
        /// Integers from a row to the next.
        pub row: u32,
        /// Integers from a pixel to the next.
        pub pixel: u32,
        /// Output image `[out rows, out columns, n]`.
        pub y: Picture,
        /// Window that moves over `x`.
        pub window: Window,
        /// Number of input channels.
        pub c: u32,
        /// Number of output channels.
        pub n: u32,
        /// Storage format of `w`, an integer format.
        pub format: WeightFormat,
        /// Weights `[kernel rows, kernel columns, c, n]` in panels of 16 outputs:
        /// `lads_kernels::conv_integers_len` elements of `format`, ordered by
        /// `lads_kernels::conv_integers_pack`.
        pub w: WeightSpan,
        /// Scales of the outputs `[n]`, then the bias `[n]`.
        pub columns: WeightSpan,
        /// Activation, applied last.
        pub activation: Activation,
        /// True if the result is added to `y`.
        pub accumulate: bool,
    }
}

impl IntegerConv {
    /// Returns the number of runs of inputs that an output pixel reads, and the length of each.
    fn runs(&self) -> [u32; 2] {
        let sweep = self.window.sweep_with(self.strides(), self.y);
        sweep
            .runs(self.c as usize)
            .map(|n| u32::try_from(n).unwrap_or(u32::MAX))
    }

    fn strides(&self) -> [usize; 2] {
        [self.row, self.pixel].map(|stride| stride as usize)
    }
}

impl Operation for IntegerConv {
    fn check(&self, checker: &Checker) -> Checked {
        require(is_built(WeightFormat::Int16), Fault::LeftOut)?;
        require(self.format.is_scaled(), Fault::Shape)?;
        self.window.check()?;
        checker.arena(self.x)?;
        require(self.c != 0, Fault::Shape)?;
        // Whole pairs are read, so behind an odd run one more.
        let [runs, len] = self.runs();
        let integers = self.x.len.saturating_sub(1).saturating_mul(2);
        let [rows, cols] = self.window.covered();
        reaches(
            integers.saturating_sub(self.first),
            [rows, cols, self.c.saturating_add(len % 2)],
            [self.row, self.pixel, 1],
        )?;
        self.y.written(checker, self.window.out.words(), self.n)?;
        apart(self.y.at, [self.x])?;
        checker.weights(self.w)?;
        checker.weights(self.columns)?;
        // Blocks of sixteen outputs and pairs of inputs, four bytes to a word.
        let bytes = self.format.bytes() as u32;
        exactly(
            self.w.len,
            [self.n.div_ceil(16), runs, len.div_ceil(2), 8, bytes],
        )?;
        exactly(self.columns.len, [2, self.n])
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        called(|| {
            let isa = machine.isa;
            let (read, y) = Readable::cut(weights, machine.arena, self.y.at)?;
            // Casts of whole words to smaller numbers: they fail on no span.
            let cast = |_| ExecError::Span;
            let columns = read.get(self.columns.into())?;
            let (scales, bias) = columns
                .split_at_checked(self.n as usize)
                .ok_or(ExecError::Span)?;
            let w = read.get(self.w.into())?;
            let w = if self.format == WeightFormat::Int8 {
                kernels::Panels::Int8 {
                    panels: bytemuck::try_cast_slice(w).map_err(cast)?,
                    scales,
                }
            } else {
                kernels::Panels::Int16 {
                    panels: bytemuck::try_cast_slice(w).map_err(cast)?,
                    scales,
                }
            };
            let conv = kernels::IntegerConv {
                sweep: self.window.sweep_with(self.strides(), self.y),
                c: self.c as usize,
                n: self.n as usize,
                w,
                bias,
                activation: self.activation,
                accumulate: self.accumulate,
            };
            let (&scale, x) = read
                .get(self.x.into())?
                .split_first()
                .ok_or(ExecError::Span)?;
            let x: &[i16] = bytemuck::try_cast_slice(x).map_err(cast)?;
            let x = x.get(self.first as usize..).ok_or(ExecError::Span)?;
            conv.run(isa, x, scale, y);
            Ok(())
        })
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        // Two integers share a word, and all of them share their scale.
        see(Access::all(AccessKind::Read, self.x));
        let out = |kind| self.y.access(kind, self.window.out.words(), self.n);
        if self.accumulate {
            see(out(AccessKind::Read));
        }
        see(out(AccessKind::Write));
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.x, visit);
        access::visit_span(&mut self.y.at, visit);
    }

    fn work(&self) -> Work {
        let ([rows, cols], [down, along]) = (self.window.out.words(), self.window.kernel.words());
        Work::products([rows, cols, down, along, self.c, self.n])
            .with_weights([self.w, self.columns])
    }
}

#[cfg(test)]
mod tests {
    use std::vec;
    use std::vec::Vec;

    use lads_kernels::{conv_integers_len, conv_integers_pack};

    use super::{Activation, ImageIntegers, IntegerConv, Pair, Picture, WeightFormat, Window};
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn an_image_becomes_integers_and_a_convolution_of_them_is_exact() {
        // A row of three pixels of one channel, a kernel of two columns.
        let convert = ImageIntegers {
            x: Picture {
                at: span(0, 3),
                row: 3,
                pixel: 1,
            },
            size: Pair { rows: 1, cols: 3 },
            c: 1,
            y: span(3, 3),
        };
        let arena = [16383.0, 1.0, -2.0, 0.0, 0.0, 0.0, 10.0, -5e4];
        let arena = computed(convert, &arena, &[]);
        let words: Vec<u32> = arena[3..6].iter().map(|x| x.to_bits()).collect();
        assert_eq!(words, [1.0_f32.to_bits(), 0x0001_3fff, 0x0000_fffe]);

        let runs = [1, 2];
        let mut panels = vec![0_i16; conv_integers_len(runs, 1)];
        conv_integers_pack(&[1, -2], runs, 1, &mut panels);
        let mut weights: Vec<f32> = bytemuck::cast_slice(&panels).to_vec();
        let len = weights.len() as u32;
        weights.extend([0.5, 0.25]);
        let conv = IntegerConv {
            x: span(3, 3),
            first: 0,
            row: 3,
            pixel: 1,
            y: Picture {
                at: span(6, 2),
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
            format: WeightFormat::Int16,
            w: WeightSpan { offset: 0, len },
            columns: WeightSpan {
                offset: len,
                len: 2,
            },
            activation: Activation::Relu,
            accumulate: true,
        };
        assert_eq!(computed(conv, &arena, &weights)[6..], [8200.75, 0.0]);
        let conv = IntegerConv {
            accumulate: false,
            first: 1,
            window: Window {
                out: Pair::of(1),
                ..conv.window
            },
            y: Picture {
                at: span(6, 1),
                ..conv.y
            },
            ..conv
        };
        assert_eq!(computed(conv, &arena, &weights)[6..], [2.75, -5e4]);
    }
}
