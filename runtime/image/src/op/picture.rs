//! Images in the arena: the places of their pixels, and windows that move over them.

use lads_kernels as kernels;

use crate::access::{Access, AccessKind};
use crate::check::{Checked, Checker, Fault, reaches, require};
use crate::codec::{Field, Reader, Writer, record};
use crate::place::Span;

/// Two numbers, for rows and for columns, in one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    /// Number for rows, down the image.
    pub rows: u16,
    /// Number for columns, along a row.
    pub cols: u16,
}

impl Pair {
    /// Makes a pair of twice the same number.
    pub const fn of(both: u16) -> Self {
        Self {
            rows: both,
            cols: both,
        }
    }

    /// Checks that neither number is zero.
    pub(super) fn positive(self) -> Checked {
        require(self.rows != 0 && self.cols != 0, Fault::Shape)
    }

    pub(super) fn words(self) -> [u32; 2] {
        [self.rows, self.cols].map(u32::from)
    }

    pub(super) fn sizes(self) -> [usize; 2] {
        [self.rows, self.cols].map(usize::from)
    }

    /// Returns how many input pixels windows at this many places cover, gaps included.
    fn covered(self, stride: Self, kernel: Self, dilation: Self) -> [u32; 2] {
        let axis = |out: u16, stride: u16, kernel: u16, dilation: u16| {
            let steps = |n: u16, by: u16| u32::from(n.saturating_sub(1)).saturating_mul(by.into());
            steps(out, stride)
                .saturating_add(steps(kernel, dilation))
                .saturating_add(1)
        };
        [
            axis(self.rows, stride.rows, kernel.rows, dilation.rows),
            axis(self.cols, stride.cols, kernel.cols, dilation.cols),
        ]
    }
}

impl Field for Pair {
    const WORDS: usize = 1;
    fn put(&self, out: &mut Writer) {
        out.word(u32::from(self.rows) | u32::from(self.cols) << 16);
    }
    #[inline]
    fn take(from: &mut Reader) -> Option<Self> {
        let word = from.word()?;
        Some(Self {
            rows: word as u16,
            cols: (word >> 16) as u16,
        })
    }
}

record! {
    /// An image `[rows, columns, channels]` in the arena, channels side by side. Rows may be part
    /// of wider ones, and pixels part of pixels with more channels: images with a border, or groups
    /// of channels.
    pub struct Picture {
        /// Span from the first element to the last.
        pub at: Span,
        /// Elements from a row to the next.
        pub row: u32,
        /// Elements from a pixel to the next.
        pub pixel: u32,
    }
}

impl Picture {
    /// Checks that the image, which is read, lies inside its span.
    pub(super) fn read(self, checker: &Checker, [rows, cols]: [u32; 2], c: u32) -> Checked {
        checker.arena(self.at)?;
        require(rows != 0 && cols != 0 && c != 0, Fault::Shape)?;
        reaches(self.at.len, [rows, cols, c], [self.row, self.pixel, 1])
    }

    /// Checks that the image, which is written, lies inside its span, each element in a place of
    /// its own.
    pub(super) fn written(self, checker: &Checker, [rows, cols]: [u32; 2], c: u32) -> Checked {
        self.read(checker, [rows, cols], c)?;
        let wide = u64::from(cols.saturating_sub(1)).saturating_mul(self.pixel.into());
        let line = wide.saturating_add(c.into());
        require(
            (cols == 1 || self.pixel >= c) && (rows == 1 || u64::from(self.row) >= line),
            Fault::Shape,
        )
    }

    pub(super) fn access(self, kind: AccessKind, [rows, cols]: [u32; 2], c: u32) -> Access {
        Access::strided(
            kind,
            self.at,
            [1, rows, cols, c],
            [0, self.row, self.pixel, 1],
        )
    }

    pub(super) fn strides(self) -> [usize; 2] {
        [self.row, self.pixel].map(|stride| stride as usize)
    }
}

record! {
    /// Window that moves over an image whose border is stored.
    pub struct Window {
        /// Number of output pixels.
        pub out: Pair,
        /// Size of the window.
        pub kernel: Pair,
        /// Input pixels from one output pixel to the next.
        pub stride: Pair,
        /// Input pixels from one element of the window to the next.
        pub dilation: Pair,
    }
}

impl Window {
    pub(super) fn check(self) -> Checked {
        [self.out, self.kernel, self.stride, self.dilation]
            .into_iter()
            .try_for_each(Pair::positive)
    }

    /// Returns how many input pixels are read, gaps included.
    pub(super) fn covered(self) -> [u32; 2] {
        self.out.covered(self.stride, self.kernel, self.dilation)
    }

    pub(super) fn sweep(self, x: Picture, y: Picture) -> kernels::Sweep {
        self.sweep_with(x.strides(), y)
    }

    /// Returns the sweep over an input with these strides.
    pub(super) fn sweep_with(self, x_strides: [usize; 2], y: Picture) -> kernels::Sweep {
        kernels::Sweep {
            out: self.out.sizes(),
            kernel: self.kernel.sizes(),
            stride: self.stride.sizes(),
            dilation: self.dilation.sizes(),
            x_strides,
            y_strides: y.strides(),
        }
    }
}

/// Calls an operation on images out of line, so that the frame of the loop over a program does not
/// grow by its needs: beside an image, the cost of a call is negligible. Generic, so that a build
/// without the operation has none of it.
#[inline(never)]
pub(super) fn called<T>(run: impl FnOnce() -> T) -> T {
    run()
}
