//! Lowers convolutions, pools and resizes, and places images with their borders.
//!
//! A convolution reads an image whose border is stored. The op that computes an image leaves room
//! for the border that its readers need and fills that first, so that the image is written once,
//! inside its border; any other image is copied into one with a border.

use std::sync::Arc;

use lads_image::op::{
    Activation, Border, Conv, Depthwise, ImageIntegers, IntegerConv, Pair, Picture, Pool, PoolKind,
    Resize, Span, WeightFormat, WeightSpan, Window,
};

use super::Lowering;
use super::compute::{Done, activation_of, product};
use super::view::View;
use crate::graph::{ConvOp, Id, Op, Windows};
use crate::report::LayerReport;
use crate::tensor::{MAX_ELEMENTS, Tensor, elements};

/// Returns the batch, rows, columns and channels of images or sequences.
fn four(shape: &[usize]) -> Result<[usize; 4], String> {
    match *shape {
        [n, rows, cols, c] => Ok([n, rows, cols, c]),
        [n, cols, c] => Ok([n, 1, cols, c]),
        _ => Err("is neither an image nor a sequence".into()),
    }
}

fn pair([rows, cols]: [usize; 2]) -> Result<Pair, String> {
    let number =
        |n: usize| u16::try_from(n).map_err(|_| format!("has a side of {n}, beyond {}", u16::MAX));
    Ok(Pair {
        rows: number(rows)?,
        cols: number(cols)?,
    })
}

/// Returns the smallest border that covers both.
fn larger(a: [usize; 4], b: [usize; 4]) -> [usize; 4] {
    std::array::from_fn(|i| a[i].max(b[i]))
}

/// Images in memory: their view, and the distances between images, rows and pixels.
struct Images {
    view: View,
    each: usize,
    row: usize,
    pixel: usize,
}

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
    /// Chooses the borders of images: the largest that a convolution needs; a residual has the
    /// border of its sum.
    pub(super) fn plan_borders(&mut self, order: &[Id]) {
        for &id in order.iter().rev() {
            let Op::Conv(conv) = *self.g.op(id) else {
                continue;
            };
            let inputs = &self.g.node(id).inputs;
            // Padding that is not zero makes a border of its own.
            if !conv.fill {
                let pads = self.reached(&conv.windows, inputs[0]);
                self.want(inputs[0], pads);
            }
            if let (true, Some(&residual)) = (conv.residual, inputs.last()) {
                let own = self.wanted.get(&id).copied().unwrap_or_default();
                self.want(residual, own);
            }
        }
    }

    fn want(&mut self, id: Id, border: [usize; 4]) {
        if border != [0; 4] {
            let known = self.wanted.get(&id).copied().unwrap_or_default();
            self.wanted.insert(id, larger(known, border));
        }
    }

    /// Returns the padding that a convolution actually reads.
    fn reached(&self, windows: &Windows, x: Id) -> [usize; 4] {
        let shape = self
            .shape(x)
            .and_then(|shape| four(&shape))
            .unwrap_or([1; 4]);
        windows.reached([shape[1], shape[2]]).pads()
    }

    /// Allocates a new image with the border that its readers need.
    fn image(&mut self, id: Id, shape: &[usize]) -> Result<View, String> {
        let border = self.wanted.get(&id).copied().unwrap_or_default();
        if border == [0; 4] || self.placed.contains_key(&id) {
            return Ok(self.allocate(id, shape));
        }
        self.borders.insert(id, border);
        self.bordered(shape, border, None)
    }

    /// Allocates new images with a border around each, and returns their inside.
    fn bordered(
        &mut self,
        shape: &[usize],
        border: [usize; 4],
        value: Option<WeightSpan>,
    ) -> Result<View, String> {
        let [n, rows, cols, c] = four(shape)?;
        let [top, left, bottom, right] = border;
        let whole = [n, top + rows + bottom, left + cols + right, c];
        if elements(&whole).is_none() {
            return Err(format!(
                "needs an image with its border, {whole:?}, of more than {MAX_ELEMENTS} elements"
            ));
        }
        let buffer = self.buffer(product(&whole));
        let all = View::contiguous(buffer, 0, &whole);
        let [each, row, pixel] = [all.strides[0], all.strides[1], c];
        for i in 0..n {
            let view = all.with(i * each, vec![]);
            let op = Border {
                y: self.span(&view, each),
                inside: pair([rows, cols])?,
                before: pair([top, left])?,
                after: pair([bottom, right])?,
                c: c as u32,
                value,
            };
            self.ops.push(op.into());
        }
        let offset = top * row + left * pixel;
        let strides = if shape.len() == 4 {
            vec![each, row, pixel, 1]
        } else {
            vec![each, pixel, 1]
        };
        Ok(all.with(offset, strides))
    }

    /// Returns the places of images whose channels are side by side in the arena, copied if
    /// necessary.
    fn images(&mut self, id: Id) -> Result<Images, String> {
        let shape = self.shape(id)?;
        let view = self.view(id)?;
        let channels = shape.last().copied().unwrap_or(1);
        let side_by_side = channels == 1 || view.strides.last() == Some(&1);
        let view = if side_by_side && view.buffer().is_some() {
            view
        } else {
            let buffer = self.buffer(product(&shape));
            let to = View::contiguous(buffer, 0, &shape);
            self.copy(id, &to, &shape)?;
            to
        };
        Ok(Images::of(view))
    }

    /// Returns the images that a convolution reads, starting at the first pixel of their border.
    fn with_border(
        &mut self,
        id: Id,
        pads: [usize; 4],
        value: Option<WeightSpan>,
    ) -> Result<Images, String> {
        let [top, left, ..] = pads;
        let there = self.borders.get(&id).copied().unwrap_or_default();
        let fits = value.is_none() && larger(there, pads) == there;
        let images = if fits || pads == [0; 4] {
            self.images(id)?
        } else {
            let shape = self.shape(id)?;
            let border = if value.is_some() {
                pads
            } else {
                larger(pads, self.wanted.get(&id).copied().unwrap_or_default())
            };
            let inside = self.bordered(&shape, border, value)?;
            self.copy(id, &inside, &shape)?;
            if value.is_none() {
                // For others that read it.
                self.borders.insert(id, border);
                self.set(id, inside.clone());
            }
            Images::of(inside)
        };
        let offset = images.view.offset - top * images.row - left * images.pixel;
        Ok(Images {
            view: images.view.with(offset, images.view.strides.clone()),
            ..images
        })
    }

    /// Returns one of the images, `[rows, columns]` of it, some of its channels.
    fn picture(
        &self,
        images: &Images,
        i: usize,
        [rows, cols]: [usize; 2],
        [first, c]: [usize; 2],
    ) -> Picture {
        let view = images
            .view
            .with(images.view.offset + i * images.each + first, vec![]);
        let len = (rows - 1) * images.row + (cols - 1) * images.pixel + c;
        Picture {
            at: self.span(&view, len),
            row: images.row as u32,
            pixel: images.pixel as u32,
        }
    }

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

    /// Returns the place that a convolution is added to: the residual itself if it has no other
    /// reader, else a copy.
    fn sum(&mut self, id: Id, x: Id, residual: Id) -> Result<View, String> {
        let shape = self.shape(id)?;
        let there = self.borders.get(&residual).copied().unwrap_or_default();
        let wanted = self.wanted.get(&id).copied().unwrap_or_default();
        let images = Images::of(self.view(residual)?);
        if let Some(buffer) = images.view.buffer()
            && images.view.strides.last() == Some(&1)
            && images.view.is_injective(&shape)
            && larger(there, wanted) == there
            && self.view(x)?.buffer() != Some(buffer)
            && !self.placed.contains_key(&id)
            && self.dies_here(buffer, id)
        {
            self.borders.insert(id, there);
            return Ok(images.view);
        }
        let y = self.image(id, &shape)?;
        self.copy(residual, &y, &shape)?;
        Ok(y)
    }

    pub(super) fn pool(&mut self, id: Id, x: Id, kind: PoolKind, windows: &Windows) -> Done {
        let (from, shape) = (self.shape(x)?, self.shape(id)?);
        let [n, rows, cols, c] = four(&from)?;
        let input = self.images(x)?;
        let y = self.image(id, &shape)?;
        self.set(id, y.clone());
        let output = Images::of(y);
        for i in 0..n {
            let op = Pool {
                kind,
                x: self.picture(&input, i, [rows, cols], [0, c]),
                y: self.picture(&output, i, windows.out, [0, c]),
                size: pair([rows, cols])?,
                window: window(windows)?,
                before: pair(windows.before)?,
                after: pair(windows.after)?,
                c: c as u32,
            };
            self.ops.push(op.into());
        }
        Ok(())
    }

    pub(super) fn resize(&mut self, id: Id, x: &[Id]) -> Done {
        let (from, shape) = (self.shape(x[0])?, self.shape(id)?);
        let ([n, rows, cols, c], [_, out_rows, out_cols, _]) = (four(&from)?, four(&shape)?);
        let tables = [self.plain(x[1])?, self.plain(x[2])?];
        let input = self.images(x[0])?;
        let y = self.image(id, &shape)?;
        self.set(id, y.clone());
        let output = Images::of(y);
        for i in 0..n {
            let op = Resize {
                x: self.picture(&input, i, [rows, cols], [0, c]),
                y: self.picture(&output, i, [out_rows, out_cols], [0, c]),
                size: pair([rows, cols])?,
                out: pair([out_rows, out_cols])?,
                c: c as u32,
                rows: tables[0],
                cols: tables[1],
            };
            self.ops.push(op.into());
        }
        Ok(())
    }
}

impl Images {
    /// Reads the images of a view `[N, rows, columns, C]` or `[N, columns, C]`.
    fn of(view: View) -> Self {
        let (each, row, pixel) = match view.strides[..] {
            [each, row, pixel, _] => (each, row, pixel),
            [each, pixel, _] => (each, 0, pixel),
            _ => (0, 0, 0),
        };
        Self {
            view,
            each,
            row,
            pixel,
        }
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

fn window(windows: &Windows) -> Result<Window, String> {
    Ok(Window {
        out: pair(windows.out)?,
        kernel: pair(windows.kernel)?,
        stride: pair(windows.stride)?,
        dilation: pair(windows.dilation)?,
    })
}
