//! Imports ONNX' `Resize`, nearest and linear, of images and sequences of known size, as tables of
//! the pixels to mix.

use std::sync::Arc;

use super::attributes::Attributes;
use super::images::{MAX_SIDE, sides};
use super::operators::Outputs;
use super::{Operands, shapes};
use crate::graph::{Graph, Id, channels_first, channels_last};
use crate::tensor::Tensor;

/// Mapping from an output coordinate to an input coordinate, by ONNX' names.
struct Places {
    mode: String,
    nearest: Option<String>,
}

impl Places {
    /// Returns the coordinate of output `i` in an input of `from` elements, of which `to` are made;
    /// `scale` is a quotient, so that whole coordinates are exact.
    fn of(&self, i: usize, from: usize, to: usize, scale: [f64; 2]) -> Result<f64, String> {
        let (at, from, to) = (i as f64, from as f64, to as f64);
        let [over, under] = scale;
        let half_pixel = (at + 0.5) * under / over - 0.5;
        Ok(match self.mode.as_str() {
            "half_pixel" => half_pixel,
            "pytorch_half_pixel" => {
                if to > 1.0 {
                    half_pixel
                } else {
                    0.0
                }
            }
            "half_pixel_symmetric" => {
                let adjusted = to * under / (over * from);
                from / 2.0 * (1.0 - adjusted) + half_pixel
            }
            "asymmetric" => at * under / over,
            // The length that there is, as PyTorch and ONNX Runtime have it, and not the one before it was rounded down.
            "align_corners" => at * (from - 1.0) / (to - 1.0).max(1.0),
            other => {
                return Err(format!(
                    "does not support coordinate_transformation_mode = {other}"
                ));
            }
        })
    }

    /// Makes the table of first input, second input and weight of the second, for each of `to`
    /// outputs.
    fn table(&self, from: usize, to: usize, scale: [f64; 2]) -> Result<Tensor, String> {
        let last = (from - 1) as f64;
        let mut table = vec![];
        for i in 0..to {
            let place = self.of(i, from, to, scale)?;
            let (first, second, weight) = match self.nearest.as_deref() {
                None => {
                    let place = place.clamp(0.0, last);
                    (
                        place.floor(),
                        (place.floor() + 1.0).min(last),
                        place - place.floor(),
                    )
                }
                Some(nearest) => {
                    let pixel = match nearest {
                        "round_prefer_floor" => (place - 0.5).ceil(),
                        "round_prefer_ceil" => (place + 0.5).floor(),
                        "floor" => place.floor(),
                        "ceil" => place.ceil(),
                        other => return Err(format!("does not support nearest_mode = {other}")),
                    };
                    let pixel = pixel.clamp(0.0, last);
                    (pixel, pixel, 0.0)
                }
            };
            table.extend([first, second, weight].map(|number| number as f32));
        }
        Ok(Tensor::f32(&[to, 3], table))
    }
}

/// Adds a resize of images, with inputs `X, roi, scales, sizes`; batch and channels keep their
/// length.
pub(super) fn resize(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let image = x.get(0)?;
    sides(g, image)?;
    let shape = g.known_shape(image).unwrap_or_default();
    let rank = shape.len();
    let text = |name: &str, otherwise: &str| {
        Ok::<_, String>(a.text(name)?.unwrap_or_else(|| otherwise.into()))
    };
    let nearest = text("nearest_mode", "round_prefer_floor")?;
    let nearest = match text("mode", "nearest")?.as_str() {
        "nearest" => Some(nearest),
        "linear" => None,
        other => {
            return Err(format!(
                "does not support mode = {other}, only nearest and linear"
            ));
        }
    };
    let places = Places {
        mode: text("coordinate_transformation_mode", "half_pixel")?,
        nearest,
    };
    a.only("antialias", 0)?;
    if text("keep_aspect_ratio_policy", "stretch")? != "stretch" {
        return Err("supports keep_aspect_ratio_policy = stretch only".into());
    }
    // Of other modes only.
    a.float("cubic_coeff_a", -0.75)?;
    a.int("exclude_outside", 0)?;
    a.float("extrapolation_value", 0.0)?;
    let axes = match a.ints("axes")? {
        Some(axes) => axes
            .iter()
            .map(|&axis| shapes::axis(g, image, axis))
            .collect::<Result<Vec<_>, _>>()?,
        None => (0..rank).collect(),
    };
    // New length and scale of each axis.
    let mut to: Vec<(usize, [f64; 2])> = shape.iter().map(|&len| (len, [1.0, 1.0])).collect();
    let scales = x.optional(2).map(|id| {
        let scales = g
            .constant(id)
            .and_then(|tensor| tensor.as_f32().map(<[f32]>::to_vec));
        scales.ok_or("needs constant scales")
    });
    let lens = shapes::integers(g, x.optional(3))?;
    let count = match (scales.transpose()?, lens) {
        (_, Some(lens)) => {
            for (&axis, &len) in axes.iter().zip(&lens) {
                let len = usize::try_from(len).unwrap_or(0);
                to[axis] = (len, [len as f64, shape[axis] as f64]);
            }
            lens.len()
        }
        (Some(scales), None) => {
            for (&axis, &scale) in axes.iter().zip(&scales) {
                let scale = f64::from(scale);
                to[axis] = ((shape[axis] as f64 * scale).floor() as usize, [scale, 1.0]);
            }
            scales.len()
        }
        (None, None) => return Err("misses its scales or sizes".into()),
    };
    if count != axes.len() {
        return Err(format!(
            "has {count} scales or sizes for {} axes",
            axes.len()
        ));
    }
    if to[..2]
        .iter()
        .zip(&shape)
        .any(|(&(len, _), &from)| len != from)
    {
        return Err("supports other sizes of rows and columns only".into());
    }
    if to.iter().any(|&(len, _)| !(1..=MAX_SIDE).contains(&len)) {
        return Err(format!("gives a side that is not from 1 to {MAX_SIDE}"));
    }
    let mut tables = vec![];
    for axis in 2..rank {
        let (len, scale) = to[axis];
        tables.push(places.table(shape[axis], len, scale)?);
    }
    if tables.len() == 1 {
        tables.insert(0, Tensor::f32(&[1, 3], vec![0.0; 3]));
    }
    let tables: Vec<Id> = tables
        .into_iter()
        .map(|table| g.add_const(Arc::new(table)))
        .collect();
    let last = channels_last(g, image)?;
    let y = g.resize(last, tables[0], tables[1])?;
    channels_first(g, y).map(|y| vec![y])
}
