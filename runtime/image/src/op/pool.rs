//! Maximum and mean of windows of an image.

use lads_kernels as kernels;

use super::picture::{Pair, Picture, Window, called};
use super::{Operation, Work};
use crate::access::{self, Access, AccessKind};
use crate::check::{Checked, Checker, apart};
use crate::codec::{record, word_enum_for};
use crate::machine::{ExecError, Machine, Readable};
use crate::place::Span;

pub use lads_kernels::PoolKind;

word_enum_for!(PoolKind { Max = 0, Mean = 1, PaddedMean = 2, });

record! {
    /// Pooling `y = kind over a window of x`; windows are cut at the image's edge.
    pub struct Pool {
        /// Function to compute.
        pub kind: PoolKind,
        /// Input image `[size, c]`, without a border.
        pub x: Picture,
        /// Output image `[out, c]`.
        pub y: Picture,
        /// Size of `x`.
        pub size: Pair,
        /// Window that moves over `x` and its padding.
        pub window: Window,
        /// Number of padding rows above and padding columns to the left.
        pub before: Pair,
        /// Number of padding rows below and padding columns to the right.
        pub after: Pair,
        /// Number of channels.
        pub c: u32,
    }
}

impl Operation for Pool {
    fn check(&self, checker: &Checker) -> Checked {
        self.window.check()?;
        self.x.read(checker, self.size.words(), self.c)?;
        self.y.written(checker, self.window.out.words(), self.c)?;
        apart(self.y.at, [self.x.at])
    }

    #[inline]
    fn run(&self, weights: &[f32], machine: &mut Machine) -> Result<(), ExecError> {
        called(|| {
            let isa = machine.isa;
            let (read, y) = Readable::cut(weights, machine.arena, self.y.at)?;
            let pool = kernels::Pool {
                kind: self.kind,
                size: self.size.sizes(),
                out: self.window.out.sizes(),
                c: self.c as usize,
                kernel: self.window.kernel.sizes(),
                stride: self.window.stride.sizes(),
                dilation: self.window.dilation.sizes(),
                before: self.before.sizes(),
                after: self.after.sizes(),
                x_strides: self.x.strides(),
                y_strides: self.y.strides(),
            };
            pool.run(isa, read.get(self.x.at.into())?, y);
            Ok(())
        })
    }

    fn accesses(&self, see: &mut dyn FnMut(Access)) {
        see(self.x.access(AccessKind::Read, self.size.words(), self.c));
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
        Work::products([rows, cols, down, along, self.c])
    }
}

#[cfg(test)]
mod tests {
    use super::{Pair, Picture, Pool, PoolKind, Window};
    use crate::op::tests::{computed, span};

    #[test]
    fn windows_are_cut_at_the_edge() {
        let pooled = |kind| {
            let pool = Pool {
                kind,
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
                size: Pair { rows: 1, cols: 3 },
                window: Window {
                    out: Pair { rows: 1, cols: 2 },
                    kernel: Pair { rows: 1, cols: 3 },
                    stride: Pair::of(2),
                    dilation: Pair::of(1),
                },
                before: Pair { rows: 0, cols: 1 },
                after: Pair { rows: 0, cols: 1 },
                c: 1,
            };
            let arena = [-3.0, -1.0, -2.0, 0.0, 0.0];
            computed(pool, &arena, &[])[3..].to_vec()
        };
        assert_eq!(pooled(PoolKind::Max), [-1.0, -1.0]);
        assert_eq!(pooled(PoolKind::Mean), [-2.0, -1.5]);
        assert_eq!(pooled(PoolKind::PaddedMean), [-4.0 / 3.0, -1.0]);
    }
}
