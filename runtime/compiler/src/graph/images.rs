//! Images in the graph, `[N, rows, columns, C]`, and sequences, `[N, columns, C]`: windows that move over them, and what is computed.
//!
//! Channels come last, as the kernels want them. ONNX has them second: [`channels_last`] and [`channels_first`] turn.

use std::sync::Arc;

use lads_image::op::PoolKind;

use super::{Dim, Graph, Id, Kind, Op, Type, Unary, eval::apply, show};
use crate::tensor::Tensor;

/// How a window moves over an image: rows, then columns; a sequence has one row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Windows {
    pub out: [usize; 2],
    pub kernel: [usize; 2],
    pub stride: [usize; 2],
    pub dilation: [usize; 2],
    /// Rows above, columns to the left.
    pub before: [usize; 2],
    /// Rows below, columns to the right.
    pub after: [usize; 2],
}

impl Windows {
    /// The rows and columns that come before and after the image.
    pub fn pads(&self) -> [usize; 4] {
        let ([top, left], [bottom, right]) = (self.before, self.after);
        [top, left, bottom, right]
    }

    /// Padding that some window reaches.
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

    /// The pixel of an image of this size that element `at` of the window at `out` looks at; `None` in the padding.
    fn pixel(&self, size: [usize; 2], out: [usize; 2], at: [usize; 2]) -> Option<[usize; 2]> {
        let axis = |i: usize| {
            let from_padding = out[i] * self.stride[i] + at[i] * self.dilation[i];
            let place = from_padding.checked_sub(self.before[i])?;
            (place < size[i]).then_some(place)
        };
        Some([axis(0)?, axis(1)?])
    }
}

/// A convolution and what it took in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct ConvOp {
    pub windows: Windows,
    pub groups: usize,
    /// Whether the padding has a pixel of its own; zeros otherwise.
    pub fill: bool,
    pub residual: bool,
    pub activation: Option<Unary>,
    /// With `Relu`: nothing is larger than this, as bits.
    pub bound: Option<u32>,
}

/// Rows and columns of the shape of images or of sequences.
pub(crate) fn size(shape: &[usize]) -> [usize; 2] {
    match *shape {
        [_, rows, cols, _] => [rows, cols],
        [_, cols, _] => [1, cols],
        _ => [1, 1],
    }
}

/// ONNX' order of axes, `[N, C, ..]`, of a value with its channels last.
pub(crate) fn channels_first(g: &mut Graph, x: Id) -> Result<Id, String> {
    let rank = g.shape(x).len();
    let perm: Vec<usize> = [0, rank - 1].into_iter().chain(1..rank - 1).collect();
    g.transpose(x, &perm)
}

/// The channels of `[N, C, ..]` moved to the end.
pub(crate) fn channels_last(g: &mut Graph, x: Id) -> Result<Id, String> {
    let rank = g.shape(x).len();
    let perm: Vec<usize> = [0].into_iter().chain(2..rank).chain([1]).collect();
    g.transpose(x, &perm)
}

impl Graph {
    /// The shape of windows' results: that of `x` with other rows, columns and channels.
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
        Ok(shape)
    }

    /// See [`Op::Conv`].
    pub fn conv(&mut self, conv: ConvOp, inputs: Vec<Id>) -> Result<Id, String> {
        self.floats(&inputs)?;
        let n = *self
            .shape(inputs[2])
            .first()
            .ok_or("has a bias that is no vector")?;
        let shape = self.windowed(inputs[0], conv.windows.out, n)?;
        self.fold(Op::Conv(conv), inputs, shape, Type::F32)
    }

    /// See [`Op::Pool`].
    pub fn pool(&mut self, kind: PoolKind, windows: Windows, x: Id) -> Result<Id, String> {
        self.floats(&[x])?;
        let channels = *self.shape(x).last().ok_or("a scalar is no image")?;
        let shape = self.windowed(x, windows.out, channels)?;
        self.fold(Op::Pool(Kind(kind), windows), vec![x], shape, Type::F32)
    }

    /// See [`Op::Resize`].
    pub fn resize(&mut self, x: Id, rows: Id, cols: Id) -> Result<Id, String> {
        self.floats(&[x, rows, cols])?;
        let len = |id: Id| {
            self.known_shape(id)
                .and_then(|shape| shape.first().copied())
        };
        let out = [len(rows), len(cols)].map(|len| len.unwrap_or(0));
        let channels = *self.shape(x).last().ok_or("a scalar is no image")?;
        let shape = self.windowed(x, out, channels)?;
        self.fold(Op::Resize, vec![x, rows, cols], shape, Type::F32)
    }
}

/// Calls `f` with every image, row, column and channel of a result, in order, and collects what it says.
fn each(shape: &[usize], mut f: impl FnMut(usize, [usize; 2], usize) -> f32) -> Option<Tensor> {
    let [rows, cols] = size(shape);
    let (&images, &channels) = (shape.first()?, shape.last()?);
    let mut y = Vec::with_capacity(shape.iter().product());
    for image in 0..images {
        for (row, col) in (0..rows).flat_map(|row| (0..cols).map(move |col| (row, col))) {
            y.extend((0..channels).map(|channel| f(image, [row, col], channel)));
        }
    }
    Some(Tensor::f32(shape, y))
}

/// Where a pixel's channels begin.
fn place(shape: &[usize], image: usize, [row, col]: [usize; 2]) -> usize {
    let ([rows, cols], channels) = (size(shape), shape.last().copied().unwrap_or(1));
    ((image * rows + row) * cols + col) * channels
}

pub(super) fn conv(conv: &ConvOp, x: &[Arc<Tensor>], shape: &[usize]) -> Option<Tensor> {
    let (image, w, bias) = (x[0].as_f32()?, x[1].as_f32()?, x[2].as_f32()?);
    let from = &x[0].shape;
    let fill = if conv.fill {
        Some(x[3].as_f32()?)
    } else {
        None
    };
    let residual = if conv.residual {
        Some(x.last()?.as_f32()?)
    } else {
        None
    };
    let n = bias.len();
    let c = from.last()? / conv.groups;
    let [kernel_rows, kernel_cols] = conv.windows.kernel;
    each(shape, |i, out, j| {
        let first = j / (n / conv.groups) * c;
        let mut sum = bias[j];
        for (ky, kx) in (0..kernel_rows).flat_map(|ky| (0..kernel_cols).map(move |kx| (ky, kx))) {
            let pixel = conv.windows.pixel(size(from), out, [ky, kx]);
            for l in 0..c {
                let value = match pixel {
                    Some(pixel) => image[place(from, i, pixel) + first + l],
                    None => fill.map_or(0.0, |fill| fill[first + l]),
                };
                sum += value * w[((ky * kernel_cols + kx) * c + l) * n + j];
            }
        }
        sum += residual.map_or(0.0, |residual| residual[place(shape, i, out) + j]);
        let sum = conv.activation.map_or(sum, |unary| apply(unary, sum));
        conv.bound
            .map_or(sum, |bound| sum.min(f32::from_bits(bound)))
    })
}

pub(super) fn pool(
    kind: PoolKind,
    windows: &Windows,
    x: &Tensor,
    shape: &[usize],
) -> Option<Tensor> {
    let (image, from) = (x.as_f32()?, &x.shape);
    let [kernel_rows, kernel_cols] = windows.kernel;
    let padded = size(from)
        .into_iter()
        .zip(windows.before)
        .zip(windows.after);
    let padded: Vec<usize> = padded
        .map(|((size, before), after)| size + before + after)
        .collect();
    // The image with its padding as an image of its own.
    let whole = Windows {
        before: [0; 2],
        ..*windows
    };
    each(shape, |i, out, j| {
        let (mut inside, mut counted) = (vec![], 0);
        for (ky, kx) in (0..kernel_rows).flat_map(|ky| (0..kernel_cols).map(move |kx| (ky, kx))) {
            counted += usize::from(whole.pixel([padded[0], padded[1]], out, [ky, kx]).is_some());
            if let Some(pixel) = windows.pixel(size(from), out, [ky, kx]) {
                inside.push(image[place(from, i, pixel) + j]);
            }
        }
        let sum: f32 = inside.iter().sum();
        match kind {
            PoolKind::Max => inside.iter().copied().fold(f32::NEG_INFINITY, f32::max),
            PoolKind::Mean => sum / inside.len().max(1) as f32,
            PoolKind::PaddedMean => sum / counted.max(1) as f32,
        }
    })
}

pub(super) fn resize(x: &[Arc<Tensor>], shape: &[usize]) -> Option<Tensor> {
    let (image, rows, cols) = (x[0].as_f32()?, x[1].as_f32()?, x[2].as_f32()?);
    let from = &x[0].shape;
    each(shape, |i, [row, col], j| {
        let (down, along) = (&rows[3 * row..][..3], &cols[3 * col..][..3]);
        let pixel = |row: f32, col: f32| image[place(from, i, [row as usize, col as usize]) + j];
        let line = |row: f32| {
            let (left, right) = (pixel(row, along[0]), pixel(row, along[1]));
            left + (right - left) * along[2]
        };
        let (upper, lower) = (line(down[0]), line(down[1]));
        upper + (lower - upper) * down[2]
    })
}
