//! Lowers convolutions: of floats, of integers, and depthwise ones.
//!
//! Images become integers with all of their border, once for all convolutions that read them.

use std::sync::Arc;

use lads_image::op::{
    Activation, Conv, Depthwise, ImageIntegers, IntegerConv, Span, WeightFormat, WeightSpan, Window,
};

use super::Lowering;
use super::compute::{Done, activation_of, product};
use super::images::{Images, four, larger, pair, window};
use super::view::View;
use crate::graph::{ConvOp, Id, Windows};
use crate::report::LayerReport;
use crate::tensor::Tensor;

/// Images as integers, each with the border that it had as floats.
#[derive(Clone)]
pub(super) struct Integers {
    spans: Vec<Span>,
    border: [usize; 4],
    row: usize,
    pixel: usize,
}

/// Convolution that is being lowered.
struct Sweeping<'c> {
    id: Id,
    x: &'c [Id],
    conv: ConvOp,
    matrix: &'c Arc<Tensor>,
    /// Padding that is read.
    pads: [usize; 4],
    window: Window,
    activation: Activation,
    /// Number of images.
    images: usize,
    /// Number of input and output channels of a group.
    group: [usize; 2],
}

impl Lowering<'_, '_> {
    pub(super) fn conv(&mut self, id: Id, x: &[Id], conv: ConvOp) -> Done {
        let (from, shape) = (self.shape(x[0])?, self.shape(id)?);
        let ([images, .., channels], [.., outputs]) = (four(&from)?, four(&shape)?);
        let matrix = self
            .g
            .constant(x[1])
            .cloned()
            .ok_or("reads weights that are not constant")?;
        let activation = match (conv.bound, conv.activation) {
            (Some(bound), _) => Activation::Clipped(f32::from_bits(bound)),
            (None, Some(unary)) => activation_of(unary),
            (None, None) => Activation::None,
        };
        let sweeping = Sweeping {
            id,
            x,
            conv,
            matrix: &matrix,
            pads: self.reached(&conv.windows, x[0]),
            window: window(&conv.windows)?,
            activation,
            images,
            group: [channels / conv.groups, outputs / conv.groups],
        };
        if conv.groups == channels && outputs == channels && !conv.residual && channels > 1 {
            return self.depthwise(&sweeping);
        }
        let (_, node) = self.g.origin(id);
        let format = self
            .weights
            .format_of_windows(&matrix, sweeping.group[0], node)?;
        let w = if format == WeightFormat::F32 {
            self.conv_of_floats(&sweeping)?
        } else {
            self.conv_of_integers(&sweeping, format)?
        };
        self.layers.push(LayerReport {
            node: node.to_owned(),
            weights: product(&matrix.shape),
            format,
            words: w.offset as usize..(w.offset + w.len) as usize,
        });
        Ok(())
    }

    fn depthwise(&mut self, of: &Sweeping) -> Done {
        let channels = of.conv.groups;
        let bias = self.plain(of.x[2])?;
        let input = self.input_of(of)?;
        let output = self.output_of(of)?;
        let w = self.weights.channels(of.matrix)?;
        for i in 0..of.images {
            let op = Depthwise {
                x: self.picture(&input, i, covered(&of.conv.windows), [0, channels]),
                y: self.picture(&output, i, of.conv.windows.out, [0, channels]),
                window: of.window,
                c: channels as u32,
                w,
                bias,
                activation: of.activation,
            };
            self.ops.push(op.into());
        }
        Ok(())
    }

    /// Lowers a convolution with weights of 32 bits, and returns them.
    fn conv_of_floats(&mut self, of: &Sweeping) -> Result<WeightSpan, String> {
        let bias = self.plain(of.x[2])?;
        let input = self.input_of(of)?;
        let output = self.output_of(of)?;
        let whole = self.weights.windows(of.matrix, of.conv.groups)?;
        let ([c, n], windows) = (of.group, &of.conv.windows);
        for (i, group) in of.each() {
            let op = Conv {
                x: self.picture(&input, i, covered(windows), [group * c, c]),
                y: self.picture(&output, i, windows.out, [group * n, n]),
                window: of.window,
                c: c as u32,
                n: n as u32,
                w: part(whole, of.conv.groups, group),
                bias: part(bias, of.conv.groups, group),
                activation: of.activation,
                accumulate: of.conv.residual,
            };
            self.ops.push(op.into());
        }
        Ok(whole)
    }

    /// Lowers a convolution with integer weights, and returns them.
    fn conv_of_integers(
        &mut self,
        of: &Sweeping,
        format: WeightFormat,
    ) -> Result<WeightSpan, String> {
        let bias = self.g.constant(of.x[2]).cloned();
        let bias = bias.ok_or("reads a bias that is not constant")?;
        let input = self.integers(of)?;
        let output = self.output_of(of)?;
        let ([c, n], windows, groups) = (of.group, &of.conv.windows, of.conv.groups);
        // Pixels of the window that follow one another are one run.
        let [_, cols] = windows.kernel;
        let together = cols == 1 || windows.dilation[1] * input.pixel == c;
        let len = if together { cols * c } else { c };
        let stored = self
            .weights
            .integers([of.matrix, &bias], format, [groups, len])?;
        let [top, left, ..] = of.pads;
        let inside = (input.border[0] - top) * input.row + (input.border[1] - left) * input.pixel;
        for (i, group) in of.each() {
            let op = IntegerConv {
                x: input.spans[i],
                first: (inside + group * c) as u32,
                row: input.row as u32,
                pixel: input.pixel as u32,
                y: self.picture(&output, i, windows.out, [group * n, n]),
                window: of.window,
                c: c as u32,
                n: n as u32,
                format,
                w: part(stored.w, groups, group),
                columns: part(stored.columns, groups, group),
                activation: of.activation,
                accumulate: of.conv.residual,
            };
            self.ops.push(op.into());
        }
        Ok(stored.w)
    }

    /// Returns the images that a convolution reads, with their border.
    fn input_of(&mut self, of: &Sweeping) -> Result<Images, String> {
        let value = if of.conv.fill {
            Some(self.plain(of.x[3])?)
        } else {
            None
        };
        self.with_border(of.x[0], of.pads, value)
    }

    /// Returns the images that a convolution writes.
    fn output_of(&mut self, of: &Sweeping) -> Result<Images, String> {
        let y = match of.x.last() {
            Some(&to) if of.conv.residual => self.sum(of.id, of.x[0], to)?,
            _ => {
                let shape = self.shape(of.id)?;
                self.image(of.id, &shape)?
            }
        };
        self.set(of.id, y.clone());
        Ok(Images::of(y))
    }

    /// Converts the images that a convolution reads to integers, unless another one that reads them
    /// did.
    fn integers(&mut self, of: &Sweeping) -> Result<Integers, String> {
        let x = of.x[0];
        if let Some(known) = self.integers.get(&x)
            && !of.conv.fill
            && larger(known.border, of.pads) == known.border
        {
            return Ok(known.clone());
        }
        let floats = self.input_of(of)?;
        // All of the border that is there, because others may read it.
        let there = self.borders.get(&x).copied().unwrap_or_default();
        let border = if of.conv.fill { of.pads } else { there };
        let before: [usize; 2] = std::array::from_fn(|i| border[i] - of.pads[i]);
        let first = floats.view.offset - before[0] * floats.row - before[1] * floats.pixel;
        let floats = Images {
            view: floats.view.with(first, floats.view.strides.clone()),
            ..floats
        };
        let [_, rows, cols, c] = four(&self.shape(x)?)?;
        let size = [rows + border[0] + border[2], cols + border[1] + border[3]];
        let mut spans = vec![];
        for i in 0..of.images {
            // A scale, and at least one integer more than there are.
            let len = product(&size) * c / 2 + 2;
            let buffer = self.buffer(len);
            let y = self.span(&View::contiguous(buffer, 0, &[len]), len);
            let op = ImageIntegers {
                x: self.picture(&floats, i, size, [0, c]),
                size: pair(size)?,
                c: c as u32,
                y,
            };
            self.ops.push(op.into());
            spans.push(y);
        }
        let integers = Integers {
            spans,
            border,
            row: size[1] * c,
            pixel: c,
        };
        if !of.conv.fill {
            self.integers.insert(x, integers.clone());
        }
        Ok(integers)
    }
}

impl Sweeping<'_> {
    /// Lists the images, and for each the groups of channels.
    fn each(&self) -> impl Iterator<Item = (usize, usize)> {
        let groups = self.conv.groups;
        (0..self.images).flat_map(move |i| (0..groups).map(move |group| (i, group)))
    }
}

/// Returns what belongs to one of some groups, whose shares follow one another.
fn part(whole: WeightSpan, groups: usize, group: usize) -> WeightSpan {
    let len = whole.len / groups as u32;
    WeightSpan {
        offset: whole.offset + group as u32 * len,
        len,
    }
}

/// Returns how many input pixels are read, gaps included.
fn covered(windows: &Windows) -> [usize; 2] {
    std::array::from_fn(|i| {
        (windows.out[i] - 1) * windows.stride[i] + (windows.kernel[i] - 1) * windows.dilation[i] + 1
    })
}
