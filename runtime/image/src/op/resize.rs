//! Resizes an image.

use lads_kernels as kernels;

use super::picture::{Pair, Picture, called};
use super::{Operation, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, apart, exactly};
use crate::codec::record;
use crate::machine::{ExecError, Machine, Readable};
use crate::place::{Span, WeightSpan};

record! {
    /// Resized image: each pixel of `y` is a mix of two rows and two columns of `x`, which tables
    /// name.
    pub struct Resize {
        /// Input image `[size, c]`.
        pub x: Picture,
        /// Output image `[out, c]`.
        pub y: Picture,
        /// Size of `x`.
        pub size: Pair,
        /// Size of `y`.
        pub out: Pair,
        /// Number of channels.
        pub c: u32,
        /// Table `[out rows, 3]` for each output row: first input row, second input row, weight of
        /// the second. Rows beyond the image mean its last row.
        pub rows: WeightSpan,
        /// Table `[out columns, 3]` for each output column: first input column, second input
        /// column, weight of the second. Columns beyond the image mean its last column.
        pub cols: WeightSpan,
    }
}

impl Operation for Resize {
    fn check(&self, checker: &Checker) -> Checked {
        self.x.read(checker, self.size.words(), self.c)?;
        self.y.written(checker, self.out.words(), self.c)?;
        apart(self.y.at, [self.x.at])?;
        for (table, len) in [self.rows, self.cols].into_iter().zip(self.out.words()) {
            checker.weights(table)?;
            exactly(table.len, [len, 3])?;
        }
        Ok(())
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        called(|| {
            let isa = machine.isa;
            let (read, y) = Readable::cut(weights, machine.arena, self.y.at)?;
            let resize = kernels::Resize {
                size: self.size.sizes(),
                c: self.c as usize,
                rows: read.get(self.rows.into())?,
                cols: read.get(self.cols.into())?,
                x_strides: self.x.strides(),
                y_strides: self.y.strides(),
            };
            resize.run(isa, read.get(self.x.at.into())?, y);
            Ok(())
        })
    }

    /// Reports a read of the whole image, because the pixels that the tables name are not examined.
    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        see(self.x.access(AccessKind::Read, self.size.words(), self.c));
        see(self.y.access(AccessKind::Write, self.out.words(), self.c));
    }

    fn each_span(&mut self, visit: &mut dyn FnMut(&mut Span)) {
        access::visit_span(&mut self.x.at, visit);
        access::visit_span(&mut self.y.at, visit);
    }

    fn work(&self) -> Work {
        let [rows, cols] = self.out.words();
        // Three mixes of two for each element.
        Work::products([rows, cols, self.c, 3]).with_weights([self.rows, self.cols])
    }
}

#[cfg(test)]
mod tests {
    use super::{Pair, Picture, Resize};
    use crate::op::tests::{computed, span};
    use crate::place::WeightSpan;

    #[test]
    fn pixels_are_mixed_and_never_read_outside() {
        let weights = [
            0.0, 0.0, 0.0, // the only row
            0.0, 1.0, 0.25, // three quarters of the first column
            9.0, -5.0, 0.0, // beyond: the last one
        ];
        let resize = Resize {
            x: Picture {
                at: span(0, 2),
                row: 2,
                pixel: 1,
            },
            y: Picture {
                at: span(2, 2),
                row: 2,
                pixel: 1,
            },
            size: Pair { rows: 1, cols: 2 },
            out: Pair { rows: 1, cols: 2 },
            c: 1,
            rows: WeightSpan { offset: 0, len: 3 },
            cols: WeightSpan { offset: 3, len: 6 },
        };
        let arena = [4.0, 8.0, 0.0, 0.0];
        assert_eq!(computed(resize, &arena, &weights)[2..], [5.0, 8.0]);
    }
}
