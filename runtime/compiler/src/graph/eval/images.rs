//! Evaluates windows over images and sequences, and resizing: every result by itself, channel by
//! channel of every pixel.

use lads_image::op::PoolKind;
use ndarray::{Array4, ArrayD, ArrayView4, ArrayViewD, Axis, Ix1, Ix2, IxDyn};

use super::super::{ConvOp, Windows};
use super::{Real, apply};

/// Views images as `[N, rows, columns, C]`: a sequence `[N, columns, C]` has one row.
fn four<'v, T: Clone>(x: &ArrayViewD<'v, T>) -> Option<ArrayView4<'v, T>> {
    let x = x.clone();
    let x = if x.ndim() == 3 {
        x.insert_axis(Axis(1))
    } else {
        x
    };
    x.into_dimensionality().ok()
}

fn size<T>(x: &ArrayView4<T>) -> [usize; 2] {
    [x.shape()[1], x.shape()[2]]
}

/// Returns the rows, and the columns within each, of a kernel.
fn places([rows, cols]: [usize; 2]) -> impl Iterator<Item = [usize; 2]> {
    (0..rows).flat_map(move |row| (0..cols).map(move |col| [row, col]))
}

/// Makes a result from `f` of an image, a pixel and a channel.
fn each<T>(shape: &[usize], f: impl Fn(usize, [usize; 2], usize) -> T) -> Option<ArrayD<T>> {
    let whole = match *shape {
        [n, rows, cols, c] => (n, rows, cols, c),
        [n, cols, c] => (n, 1, cols, c),
        _ => return None,
    };
    let all = Array4::from_shape_fn(whole, |(i, row, col, j)| f(i, [row, col], j));
    all.into_shape_with_order(IxDyn(shape)).ok()
}

/// Evaluates [`Op::Conv`](super::Op::Conv).
pub(super) fn conv<T: Real>(
    conv: &ConvOp,
    x: &[ArrayViewD<T>],
    shape: &[usize],
) -> Option<ArrayD<T>> {
    let image = four(x.first()?)?;
    let weights = x.get(1)?.clone().into_dimensionality::<Ix2>().ok()?;
    let column = |i: usize| x.get(i)?.clone().into_dimensionality::<Ix1>().ok();
    let bias = column(2)?;
    let fill = if conv.fill { Some(column(3)?) } else { None };
    let residual = if conv.residual {
        Some(four(x.last()?)?)
    } else {
        None
    };
    let n = bias.len() / conv.groups;
    let c = image.shape()[3] / conv.groups;
    each(shape, |i, out, j| {
        let first = j / n * c;
        let mut sum = bias[j];
        for (k, at) in places(conv.windows.kernel).enumerate() {
            let pixel = conv.windows.pixel(size(&image), out, at);
            for l in 0..c {
                let value = match (pixel, &fill) {
                    (Some([row, col]), _) => image[[i, row, col, first + l]],
                    (None, Some(fill)) => fill[first + l],
                    (None, None) => T::zero(),
                };
                sum += value * weights[[k * c + l, j]];
            }
        }
        if let Some(residual) = &residual {
            sum += residual[[i, out[0], out[1], j]];
        }
        let sum = conv.activation.map_or(sum, |unary| apply(unary, sum));
        let bound = conv.bound.map(|bound| T::exact(f32::from_bits(bound)));
        // A sum that is NaN stays NaN, as in the kernels.
        bound.map_or(sum, |bound| if sum > bound { bound } else { sum })
    })
}

/// Evaluates [`Op::Pool`](super::Op::Pool).
pub(super) fn pool<T: Real>(
    kind: PoolKind,
    windows: &Windows,
    x: &ArrayViewD<T>,
    shape: &[usize],
) -> Option<ArrayD<T>> {
    let image = four(x)?;
    // The image with its padding as an image of its own.
    let padded = std::array::from_fn(|i| size(&image)[i] + windows.before[i] + windows.after[i]);
    let whole = Windows {
        before: [0; 2],
        ..*windows
    };
    each(shape, |i, out, j| {
        let inside = || {
            places(windows.kernel)
                .filter_map(|at| windows.pixel(size(&image), out, at))
                .map(|[row, col]| image[[i, row, col, j]])
        };
        let counted = |windows: &Windows, size| {
            let seen = |&at: &[usize; 2]| windows.pixel(size, out, at).is_some();
            let count = places(windows.kernel).filter(seen).count();
            T::of(count.max(1) as i64)
        };
        match kind {
            PoolKind::Max => inside().fold(T::neg_infinity(), |most, x| {
                if most.is_nan() || most > x { most } else { x }
            }),
            PoolKind::Mean => inside().sum::<T>() / counted(windows, size(&image)),
            PoolKind::PaddedMean => inside().sum::<T>() / counted(&whole, padded),
        }
    })
}

/// Evaluates [`Op::Resize`](super::Op::Resize).
pub(super) fn resize<T: Real>(x: &[ArrayViewD<T>], shape: &[usize]) -> Option<ArrayD<T>> {
    let image = four(x.first()?)?;
    let table = |i: usize| x.get(i)?.clone().into_dimensionality::<Ix2>().ok();
    let (rows, cols) = (table(1)?, table(2)?);
    let mix = |first: T, second: T, weight: T| first + (second - first) * weight;
    each(shape, |i, [row, col], j| {
        let line = |row: T| {
            let pixel = |col: T| image[[i, row.whole() as usize, col.whole() as usize, j]];
            mix(pixel(cols[[col, 0]]), pixel(cols[[col, 1]]), cols[[col, 2]])
        };
        mix(line(rows[[row, 0]]), line(rows[[row, 1]]), rows[[row, 2]])
    })
}
