//! Images in the graph, `[N, rows, columns, C]`, and sequences, `[N, columns, C]`: windows that move over them.
//!
//! Channels come last, as the kernels want them. ONNX has them second: [`channels_last`] and
//! [`channels_first`] transpose.

use lads_image::op::PoolKind;

use super::{Dim, Graph, Id, Kind, Op, Type, Unary, show};
use crate::tensor::{MAX_ELEMENTS, elements};

/// Geometry of a window that moves over an image: rows, then columns; a sequence has one row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Windows {
    pub out: [usize; 2],
    pub kernel: [usize; 2],
    pub stride: [usize; 2],
    pub dilation: [usize; 2],
    /// Padding: rows above, columns to the left.
    pub before: [usize; 2],
    /// Padding: rows below, columns to the right.
    pub after: [usize; 2],
}

impl Windows {
    /// Returns the padding in ONNX order: the rows and columns before, then those after the image.
    pub fn pads(&self) -> [usize; 4] {
        let ([top, left], [bottom, right]) = (self.before, self.after);
        [top, left, bottom, right]
    }

    /// Limits the padding to the part that some window reaches.
    pub fn reached(&self, size: [usize; 2]) -> Self {
        let axis = |i: usize| {
            let covered =
                (self.out[i] - 1) * self.stride[i] + (self.kernel[i] - 1) * self.dilation[i] + 1;
            covered.saturating_sub(self.before[i] + size[i])
        };
        Self {
            after: [axis(0), axis(1)],
            ..*self
        }
    }

    /// Returns the pixel of an image of this size that element `at` of the window at `out` reads;
    /// `None` in the padding.
    pub fn pixel(&self, size: [usize; 2], out: [usize; 2], at: [usize; 2]) -> Option<[usize; 2]> {
        let axis = |i: usize| {
            let from_padding = out[i] * self.stride[i] + at[i] * self.dilation[i];
            let place = from_padding.checked_sub(self.before[i])?;
            (place < size[i]).then_some(place)
        };
        Some([axis(0)?, axis(1)?])
    }
}

/// A convolution with the nodes fused into it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct ConvOp {
    pub windows: Windows,
    pub groups: usize,
    /// True if the padding has a pixel of its own; else it is zeros.
    pub fill: bool,
    pub residual: bool,
    pub activation: Option<Unary>,
    /// Upper bound of the result after `Relu`, as bits.
    pub bound: Option<u32>,
}

/// Transposes a value with its channels last to ONNX' order of axes, `[N, C, ..]`.
pub(crate) fn channels_first(g: &mut Graph, x: Id) -> Result<Id, String> {
    let rank = g.shape(x).len();
    let perm: Vec<usize> = [0, rank - 1].into_iter().chain(1..rank - 1).collect();
    g.transpose(x, &perm)
}

/// Transposes `[N, C, ..]` so that the channels come last.
pub(crate) fn channels_last(g: &mut Graph, x: Id) -> Result<Id, String> {
    let rank = g.shape(x).len();
    let perm: Vec<usize> = [0].into_iter().chain(2..rank).chain([1]).collect();
    g.transpose(x, &perm)
}

impl Graph {
    /// Returns the shape of windows' results: that of `x` with other rows, columns and channels.
    fn windowed(&self, x: Id, out: [usize; 2], channels: Dim) -> Result<Vec<Dim>, String> {
        let mut shape = self.shape(x).to_vec();
        if !(3..=4).contains(&shape.len()) || self.known_shape(x).is_none() {
            return Err(format!(
                "supports images and sequences of known size only, not {}",
                show(&shape)
            ));
        }
        let last = shape.len() - 1;
        for (dim, out) in shape[..last].iter_mut().rev().zip([out[1], out[0]]) {
            *dim = Dim::of(out);
        }
        shape[0] = self.shape(x)[0];
        shape[last] = channels;
        let lens: Vec<usize> = shape.iter().map(|dim| dim.fixed).collect();
        if elements(&lens).is_none() {
            return Err(format!(
                "gives {}, more than {MAX_ELEMENTS} elements",
                show(&shape)
            ));
        }
        Ok(shape)
    }

    /// Adds a convolution, [`Op::Conv`].
    pub fn conv(&mut self, conv: ConvOp, inputs: Vec<Id>) -> Result<Id, String> {
        self.floats(&inputs)?;
        let n = *self
            .shape(inputs[2])
            .first()
            .ok_or("has a bias that is not a vector")?;
        let shape = self.windowed(inputs[0], conv.windows.out, n)?;
        self.fold(Op::Conv(conv), inputs, shape, Type::F32)
    }

    /// Adds a pooling, [`Op::Pool`].
    pub fn pool(&mut self, kind: PoolKind, windows: Windows, x: Id) -> Result<Id, String> {
        self.floats(&[x])?;
        let channels = *self.shape(x).last().ok_or("a scalar is not an image")?;
        let shape = self.windowed(x, windows.out, channels)?;
        self.fold(Op::Pool(Kind(kind), windows), vec![x], shape, Type::F32)
    }

    /// Adds a resize, [`Op::Resize`].
    pub fn resize(&mut self, x: Id, rows: Id, cols: Id) -> Result<Id, String> {
        self.floats(&[x, rows, cols])?;
        let len = |id: Id| {
            self.known_shape(id)
                .and_then(|shape| shape.first().copied())
        };
        let out = [len(rows), len(cols)].map(|len| len.unwrap_or(0));
        let channels = *self.shape(x).last().ok_or("a scalar is not an image")?;
        let shape = self.windowed(x, out, channels)?;
        self.fold(Op::Resize, vec![x, rows, cols], shape, Type::F32)
    }
}
