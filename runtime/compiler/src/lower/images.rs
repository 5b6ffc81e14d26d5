//! Places images with their borders, and lowers pools and resizes.
//!
//! A convolution reads an image whose border is stored. The op that computes an image leaves room
//! for the border that its readers need and fills that first, so that the image is written once,
//! inside its border; any other image is copied into one with a border.

use lads_image::op::{Border, Pair, Picture, Pool, PoolKind, Resize, WeightSpan, Window};

use super::Lowering;
use super::compute::{Done, product};
use super::view::View;
use crate::graph::{Id, Op, Windows};
use crate::tensor::{MAX_ELEMENTS, elements};

/// Returns the batch, rows, columns and channels of images or sequences.
pub(super) fn four(shape: &[usize]) -> Result<[usize; 4], String> {
    match *shape {
        [n, rows, cols, c] => Ok([n, rows, cols, c]),
        [n, cols, c] => Ok([n, 1, cols, c]),
        _ => Err("is neither an image nor a sequence".into()),
    }
}

pub(super) fn pair([rows, cols]: [usize; 2]) -> Result<Pair, String> {
    let number =
        |n: usize| u16::try_from(n).map_err(|_| format!("has a side of {n}, beyond {}", u16::MAX));
    Ok(Pair {
        rows: number(rows)?,
        cols: number(cols)?,
    })
}

/// Returns the smallest border that covers both.
pub(super) fn larger(a: [usize; 4], b: [usize; 4]) -> [usize; 4] {
    std::array::from_fn(|i| a[i].max(b[i]))
}

/// Images in memory: their view, and the distances between images, rows and pixels.
pub(super) struct Images {
    pub view: View,
    pub each: usize,
    pub row: usize,
    pub pixel: usize,
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
    pub(super) fn reached(&self, windows: &Windows, x: Id) -> [usize; 4] {
        let shape = self
            .shape(x)
            .and_then(|shape| four(&shape))
            .unwrap_or([1; 4]);
        windows.reached([shape[1], shape[2]]).pads()
    }

    /// Allocates a new image with the border that its readers need.
    pub(super) fn image(&mut self, id: Id, shape: &[usize]) -> Result<View, String> {
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
    pub(super) fn with_border(
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
    pub(super) fn picture(
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

    /// Returns the place that a convolution is added to: the residual itself if it has no other
    /// reader, else a copy.
    pub(super) fn sum(&mut self, id: Id, x: Id, residual: Id) -> Result<View, String> {
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
    pub fn of(view: View) -> Self {
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

pub(super) fn window(windows: &Windows) -> Result<Window, String> {
    Ok(Window {
        out: pair(windows.out)?,
        kernel: pair(windows.kernel)?,
        stride: pair(windows.stride)?,
        dilation: pair(windows.dilation)?,
    })
}
