//! Imports operators on images `[N, C, rows, columns]` and sequences `[N, C, columns]`. In the
//! graph channels come last, so each operator transposes its input and its result; adjacent
//! transposes cancel out, and [`fuse`](crate::fuse) moves the others out of the way.

use std::sync::Arc;

use lads_image::op::PoolKind;

use super::Operands;
use super::attributes::Attributes;
use super::operators::Outputs;
use super::{resize, shapes};
use crate::graph::{ConvOp, Dim, Graph, Id, Windows, channels_first, channels_last, show};
use crate::tensor::Tensor;

/// Longest side of an image, and largest number in the geometry of a window.
pub(super) const MAX_SIDE: usize = u16::MAX as usize;

/// Largest number of images of a node, times its groups: each is an operation of its own.
const MAX_PARTS: usize = 1 << 12;

/// Adds a node's operations to the graph.
pub(super) fn translate(g: &mut Graph, operator: &str, x: &Operands, a: &Attributes) -> Outputs {
    match operator {
        "Conv" => conv(g, x, a),
        "MaxPool" => {
            a.only("storage_order", 0)?;
            pool(g, x, a, PoolKind::Max)
        }
        "AveragePool" => {
            let padded = a.flag("count_include_pad", false)?;
            let kind = if padded {
                PoolKind::PaddedMean
            } else {
                PoolKind::Mean
            };
            pool(g, x, a, kind)
        }
        "GlobalAveragePool" => whole(g, x, PoolKind::Mean),
        "GlobalMaxPool" => whole(g, x, PoolKind::Max),
        "Resize" => resize::resize(g, x, a),
        _ => shapes::translate(g, operator, x, a),
    }
}

/// Returns the number of images, the channels, and the one or two sides.
pub(super) fn sides(g: &Graph, x: Id) -> Result<Vec<usize>, String> {
    let shape = g.known_shape(x).filter(|shape| {
        (3..=4).contains(&shape.len())
            && shape[0] <= MAX_PARTS
            && shape[2..].iter().all(|side| (1..=MAX_SIDE).contains(side))
    });
    shape.map(|shape| shape[2..].to_vec()).ok_or_else(|| {
        format!(
            "supports [N, C, columns] and [N, C, rows, columns] of known size, N up to {MAX_PARTS} and sides up to {MAX_SIDE}, not {}",
            show(g.shape(x))
        )
    })
}

/// Reads an attribute with one number for each side.
fn numbers(
    a: &Attributes,
    name: &str,
    sides: usize,
    otherwise: usize,
    least: usize,
) -> Result<Vec<usize>, String> {
    let Some(found) = a.ints(name)? else {
        return Ok(vec![otherwise; sides]);
    };
    let all: Option<Vec<usize>> = found
        .iter()
        .map(|&number| {
            usize::try_from(number)
                .ok()
                .filter(|number| (least..=MAX_SIDE).contains(number))
        })
        .collect();
    all.filter(|all| all.len() == sides).ok_or_else(|| {
        format!(
            "has {name} {found:?}, it must have {sides} numbers from {least} to {MAX_SIDE}; give the layer such {name} and export the model again"
        )
    })
}

/// Reads the windows of a convolution or a pool from the attributes that they share. `round_up`
/// lets the last window reach beyond the padding.
fn windows(
    a: &Attributes,
    sides: &[usize],
    kernel: &[usize],
    round_up: bool,
) -> Result<Windows, String> {
    let n = sides.len();
    let stride = numbers(a, "strides", n, 1, 1)?;
    let dilation = numbers(a, "dilations", n, 1, 1)?;
    let pads = numbers(a, "pads", 2 * n, 0, 0)?;
    let (mut before, mut after) = (pads[..n].to_vec(), pads[n..].to_vec());
    let auto = a.text("auto_pad")?.unwrap_or_else(|| "NOTSET".into());
    let mut out = vec![];
    for i in 0..n {
        let wide = (kernel[i] - 1) * dilation[i] + 1;
        match auto.as_str() {
            "NOTSET" => {}
            "VALID" => (before[i], after[i]) = (0, 0),
            "SAME_UPPER" | "SAME_LOWER" => {
                let steps = sides[i].div_ceil(stride[i]) - 1;
                let missing = (steps * stride[i] + wide).saturating_sub(sides[i]);
                let (small, large) = (missing / 2, missing - missing / 2);
                (before[i], after[i]) = if auto == "SAME_UPPER" {
                    (small, large)
                } else {
                    (large, small)
                };
            }
            other => {
                return Err(format!(
                    "does not support auto_pad = {other}, only NOTSET, VALID, SAME_UPPER and SAME_LOWER"
                ));
            }
        }
        let padded = sides[i] + before[i] + after[i];
        let rest = padded.checked_sub(wide).ok_or_else(|| {
            format!(
                "has a window of {wide} over {padded} elements, padding included; give it a larger input, or smaller dilations ({}) or a smaller kernel ({})",
                dilation[i], kernel[i]
            )
        })?;
        let mut steps = if round_up {
            rest.div_ceil(stride[i])
        } else {
            rest / stride[i]
        };
        // A window begins inside the image or before it.
        if round_up && steps * stride[i] >= sides[i] + before[i] {
            steps -= 1;
        }
        if steps >= MAX_SIDE || before[i].max(after[i]) > MAX_SIDE {
            return Err(format!(
                "gives an image with a side beyond {MAX_SIDE}; give it a smaller input or larger strides"
            ));
        }
        out.push(steps + 1);
    }
    // A sequence is an image of one row.
    let two = |sides: &[usize], row: usize| match *sides {
        [rows, cols] => [rows, cols],
        [cols] => [row, cols],
        _ => [row; 2],
    };
    Ok(Windows {
        out: two(&out, 1),
        kernel: two(kernel, 1),
        stride: two(&stride, 1),
        dilation: two(&dilation, 1),
        before: two(&before, 0),
        after: two(&after, 0),
    })
}

/// Adds a convolution of `X, W [M, C / group, ..], B [M]`.
fn conv(g: &mut Graph, x: &Operands, a: &Attributes) -> Outputs {
    let (image, weights) = (x.get(0)?, x.get(1)?);
    let sides = sides(g, image)?;
    let rank = sides.len() + 2;
    if g.constant(weights).is_none() || g.shape(weights).len() != rank {
        return Err(format!(
            "needs constant weights with {rank} axes, not {}",
            show(g.shape(weights))
        ));
    }
    let shape = g.known_shape(weights).unwrap_or_default();
    let (outputs, inputs, kernel) = (shape[0], shape[1], &shape[2..]);
    let groups = usize::try_from(a.int("group", 1)?).unwrap_or(0);
    let &[images, channels, ..] = &g.known_shape(image).unwrap_or_default()[..] else {
        return Err("needs channels".into());
    };
    if shape.contains(&0)
        || groups == 0
        || groups.checked_mul(inputs) != Some(channels)
        || !outputs.is_multiple_of(groups)
    {
        return Err(format!(
            "has weights {shape:?} in {groups} groups for {channels} channels; group times the weights' second axis has to be the channels, and the first axis a multiple of group: correct the layer's group or its weights and export the model again"
        ));
    }
    let depthwise = groups == channels && outputs == channels;
    if !depthwise && images.saturating_mul(groups) > MAX_PARTS {
        return Err(format!(
            "has {images} images in {groups} groups, together at most {MAX_PARTS} are supported; export the model for fewer images, or with fewer groups"
        ));
    }
    let named = numbers(a, "kernel_shape", sides.len(), 0, 1)?;
    if !named.contains(&0) && named != kernel {
        return Err(format!(
            "has weights {shape:?} and kernel_shape {named:?}; leave kernel_shape out, or give it that of the weights"
        ));
    }
    let windows = windows(a, &sides, kernel, false)?;
    // [kernel.., C / group, M]
    let perm: Vec<usize> = (2..rank).chain([1, 0]).collect();
    let turned = g.transpose(weights, &perm)?;
    let rows = shape[1..].iter().product();
    let matrix = g.reshape(turned, &[Dim::of(rows), Dim::of(outputs)])?;
    let bias = match x.optional(2) {
        Some(bias) if g.constant(bias).is_some() && g.shape(bias) == [Dim::of(outputs)] => bias,
        Some(bias) => {
            let found = show(g.shape(bias));
            return Err(format!(
                "needs a constant bias of shape [{outputs}], not {found}"
            ));
        }
        None => g.add_const(Arc::new(Tensor::f32(&[outputs], vec![0.0; outputs]))),
    };
    let op = ConvOp {
        windows,
        groups,
        fill: false,
        residual: false,
        activation: None,
        bound: None,
    };
    let last = channels_last(g, image)?;
    let y = g.conv(op, vec![last, matrix, bias])?;
    channels_first(g, y).map(|y| vec![y])
}

fn pool(g: &mut Graph, x: &Operands, a: &Attributes, kind: PoolKind) -> Outputs {
    let image = x.get(0)?;
    let sides = sides(g, image)?;
    let round_up = a.flag("ceil_mode", false)?;
    let kernel = numbers(a, "kernel_shape", sides.len(), 0, 1)?;
    if kernel.contains(&0) {
        return Err("misses its kernel_shape".into());
    }
    let windows = windows(a, &sides, &kernel, round_up)?;
    let covered = [0, 1].map(|i| (windows.kernel[i] - 1) * windows.dilation[i] + 1);
    if (0..2).any(|i| windows.before[i].max(windows.after[i]) >= covered[i]) {
        return Err(
            "has a padding as large as its window, so that some windows see nothing; pad less"
                .into(),
        );
    }
    let last = channels_last(g, image)?;
    let y = g.pool(kind, windows, last)?;
    channels_first(g, y).map(|y| vec![y])
}

/// Adds a pool with one window over the whole image.
fn whole(g: &mut Graph, x: &Operands, kind: PoolKind) -> Outputs {
    let image = x.get(0)?;
    let kernel = match *sides(g, image)? {
        [rows, cols] => [rows, cols],
        [cols] => [1, cols],
        _ => [1; 2],
    };
    let windows = Windows {
        out: [1; 2],
        kernel,
        stride: [1; 2],
        dilation: [1; 2],
        before: [0; 2],
        after: [0; 2],
    };
    let last = channels_last(g, image)?;
    let y = g.pool(kind, windows, last)?;
    channels_first(g, y).map(|y| vec![y])
}
