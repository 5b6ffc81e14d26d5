//! Sound ops on images: with a border between rows, and as one of two groups of channels.

use lads_image::op::{
    Activation, Border, Conv, Depthwise, ImageIntegers, IntegerConv, Op, Pair, Picture, Pool,
    PoolKind, Resize, WeightFormat, Window,
};
use lads_kernels::{conv_integers_len, conv_packed_len, depthwise_packed_len};

use super::samples::{span, weight};

/// Returns all sound ops on images.
pub fn images() -> Vec<Op> {
    let window = Window {
        out: Pair { rows: 2, cols: 3 },
        kernel: Pair { rows: 2, cols: 1 },
        stride: Pair { rows: 1, cols: 2 },
        dilation: Pair { rows: 2, cols: 1 },
    };
    // Four rows of five pixels of three channels.
    let x = Picture {
        at: span(10, 3 * 40 + 4 * 6 + 3),
        row: 40,
        pixel: 6,
    };
    let y = Picture {
        at: span(200, 50 + 2 * 10 + 3),
        row: 50,
        pixel: 10,
    };
    let conv = |accumulate| Conv {
        x,
        y,
        window,
        c: 3,
        n: 3,
        w: weight(4, conv_packed_len([6, 3]) as u32),
        bias: weight(200, 3),
        activation: Activation::Clipped(6.0),
        accumulate,
    };
    let depthwise = Depthwise {
        x,
        y,
        window,
        c: 3,
        w: weight(4, depthwise_packed_len([2, 3]) as u32),
        bias: weight(200, 3),
        activation: Activation::LeakyRelu(0.1),
    };
    let border = |value, after: u16| Border {
        y: span(30, 4 * (3 + u32::from(after)) * 2),
        inside: Pair { rows: 2, cols: 2 },
        before: Pair { rows: 2, cols: 1 },
        after: Pair {
            rows: 0,
            cols: after,
        },
        c: 2,
        value,
    };
    let size = Pair { rows: 4, cols: 5 };
    let pool = |kind| Pool {
        kind,
        x,
        y,
        size,
        window,
        before: Pair { rows: 1, cols: 0 },
        after: Pair::of(1),
        c: 3,
    };
    let resize = Resize {
        x,
        y,
        size,
        out: window.out,
        c: 3,
        rows: weight(7, 6),
        cols: weight(20, 9),
    };
    let others: [Op; 8] = [
        conv(false).into(),
        conv(true).into(),
        depthwise.into(),
        border(None, 1).into(),
        border(Some(weight(3, 2)), 0).into(),
        pool(PoolKind::Max).into(),
        pool(PoolKind::PaddedMean).into(),
        resize.into(),
    ];
    [of_integers(x, y, window).as_slice(), &others].concat()
}

/// Returns the conversion of an image to integers, and convolutions of them.
fn of_integers(x: Picture, y: Picture, window: Window) -> [Op; 3] {
    let integers = ImageIntegers {
        x,
        size: Pair { rows: 4, cols: 5 },
        c: 3,
        y: span(200, 32),
    };
    // One of two groups of channels of four rows of five pixels; each pixel is a run of three.
    let integer_conv = |format: WeightFormat, accumulate| {
        let words = conv_integers_len([2, 3], 3) * format.bytes() / 4;
        IntegerConv {
            x: span(100, 1 + 4 * 5 * 6 / 2 + 1),
            first: 3,
            row: 30,
            pixel: 6,
            y,
            window,
            c: 3,
            n: 3,
            format,
            w: weight(4, words as u32),
            columns: weight(200, 6),
            activation: Activation::Relu,
            accumulate,
        }
    };
    [
        integers.into(),
        integer_conv(WeightFormat::Int16, false).into(),
        integer_conv(WeightFormat::Int8, true).into(),
    ]
}
