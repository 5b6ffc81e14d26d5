//! Compares kernels of images with their naive twins, on random shapes, strides and values, and bit
//! for bit on every instruction set.

#[path = "support/shapes.rs"]
mod shapes;
mod support;

use lads_kernels::reference as naive;
use lads_kernels::{
    Activation, Conv, Depthwise, Isa, Pool, PoolKind, Resize, Sweep, conv_pack, conv_packed_len,
    depthwise_pack, depthwise_packed_len,
};
use proptest::prelude::*;
use proptest::sample::select;
use shapes::{activation, pair, sweep, untouched};
use support::{close_up_to, digest, on_all, values};

proptest! {
    #[test]
    fn conv_equals_its_twin(
        (c, n) in (prop_oneof![1_usize..6, 14_usize..40], prop_oneof![1_usize..5, 14_usize..80]),
        shape in [pair(1..6), pair(1..5), pair(1..4), pair(1..3)],
        gaps in pair(0..4),
        (activation, accumulate) in (activation(), any::<bool>()),
        seed in any::<u64>(),
    ) {
        let (sweep, [x_len, y_len]) = sweep([c, n], shape, gaps);
        let k = sweep.kernel[0] * sweep.kernel[1] * c;
        let (x, w, bias) = (values(x_len, seed), values(k * n, seed ^ 1), values(n, seed ^ 2));
        let mut packed = vec![0.0; conv_packed_len([k, n])];
        conv_pack(&w, [k, n], &mut packed);
        let conv = Conv { sweep, c, n, w: &packed, bias: &bias, activation, accumulate };
        let before = values(y_len, seed ^ 3);
        let [y] = on_all(|isa| {
            let mut y = before.clone();
            conv.run(isa, &x, &mut y);
            [y]
        });
        let mut expected = before.clone();
        naive::conv(&sweep, (&w, &bias), (activation, accumulate), &x, &mut expected);
        // Six times what k roundings of a running sum come to, whose terms lie in [-1, 1]: 8.5e-9 k.
        close_up_to(&y, &expected, 2e-6, &vec![5e-8 * k as f32; y_len]);
        prop_assert!(untouched(&sweep, n, &before, &y));
    }

    #[test]
    fn depthwise_equals_its_twin(
        c in prop_oneof![1_usize..6, 14_usize..70],
        shape in [pair(1..7), pair(1..6), pair(1..4), pair(1..3)],
        gaps in pair(0..4),
        activation in activation(),
        seed in any::<u64>(),
    ) {
        let (sweep, [x_len, y_len]) = sweep([c, c], shape, gaps);
        let kernel = sweep.kernel[0] * sweep.kernel[1];
        let (x, w, bias) = (values(x_len, seed), values(kernel * c, seed ^ 1), values(c, seed ^ 2));
        let mut packed = vec![0.0; depthwise_packed_len([kernel, c])];
        depthwise_pack(&w, [kernel, c], &mut packed);
        let layer = Depthwise { sweep, c, w: &packed, bias: &bias, activation };
        let before = values(y_len, seed ^ 3);
        let [y] = on_all(|isa| {
            let mut y = before.clone();
            layer.run(isa, &x, &mut y);
            [y]
        });
        let mut expected = before.clone();
        naive::depthwise(&sweep, (&w, &bias), activation, &x, &mut expected);
        close_up_to(&y, &expected, 4e-6, &vec![0.0; y_len]);
        prop_assert!(untouched(&sweep, c, &before, &y));
    }

    #[test]
    fn pool_equals_its_twin(
        kind in select(vec![PoolKind::Max, PoolKind::Mean, PoolKind::PaddedMean]),
        (c, size) in (1_usize..20, pair(1..9)),
        [kernel, stride, dilation] in [pair(1..5), pair(1..4), pair(1..3)],
        [before, after] in [pair(0..3), pair(0..3)],
        (ceil, gap, seed) in (any::<bool>(), 0_usize..3, any::<u64>()),
    ) {
        // As many windows as ONNX says, at least one.
        let out = [0, 1].map(|axis| {
            let whole = before[axis] + size[axis] + after[axis];
            let rest = whole.saturating_sub((kernel[axis] - 1) * dilation[axis] + 1);
            1 + if ceil { rest.div_ceil(stride[axis]) } else { rest / stride[axis] }
        });
        let strides = |cols: usize| [(c + gap) * cols, c + gap];
        let pool = Pool {
            kind, size, out, c, kernel, stride, dilation, before, after,
            x_strides: strides(size[1]),
            y_strides: strides(out[1]),
        };
        let x = values(size[0] * size[1] * (c + gap), seed);
        let [y] = on_all(|isa| {
            let mut y = vec![7.0; out[0] * out[1] * (c + gap)];
            pool.run(isa, &x, &mut y);
            [y]
        });
        let mut expected = vec![7.0; y.len()];
        naive::pool(&pool, &x, &mut expected);
        close_up_to(&y, &expected, 1e-6, &vec![0.0; y.len()]);
    }

    #[test]
    fn resize_equals_its_twin(
        (c, size, out) in (1_usize..20, pair(1..9), pair(1..9)),
        seed in any::<u64>(),
    ) {
        let table = |axis: usize| -> Vec<f32> {
            let random = values(3 * out[axis], seed ^ axis as u64);
            let index = |x: f32| (f32::midpoint(x, 1.0) * size[axis] as f32).floor();
            random.chunks(3).flat_map(|r| [index(r[0]), index(r[1]), f32::midpoint(r[2], 1.0)]).collect()
        };
        let (rows, cols) = (table(0), table(1));
        let resize = Resize {
            size, c, rows: &rows, cols: &cols,
            x_strides: [c * size[1], c],
            y_strides: [c * out[1], c],
        };
        let x = values(size[0] * size[1] * c, seed);
        let [y] = on_all(|isa| {
            let mut y = vec![0.0; out[0] * out[1] * c];
            resize.run(isa, &x, &mut y);
            [y]
        });
        let mut expected = vec![0.0; y.len()];
        naive::resize(&resize, &x, &mut expected);
        close_up_to(&y, &expected, 1e-6, &vec![0.0; y.len()]);
    }
}

#[test]
fn what_is_too_short_is_left_as_it_was() {
    let (sweep, [x_len, y_len]) = sweep([2, 3], [[2, 2], [2, 2], [1, 1], [1, 1]], [0, 0]);
    let (packed, bias) = (vec![1.0; conv_packed_len([8, 3])], [0.0; 3]);
    let conv = Conv {
        sweep,
        c: 2,
        n: 3,
        w: &packed,
        bias: &bias,
        activation: Activation::None,
        accumulate: false,
    };
    let layer = Depthwise {
        sweep,
        c: 2,
        w: &packed[..depthwise_packed_len([4, 2])],
        bias: &bias[..2],
        activation: Activation::None,
    };
    for isa in Isa::all() {
        let mut y = vec![5.0; y_len];
        conv.run(isa, &vec![1.0; x_len - 1], &mut y);
        Conv {
            w: &packed[1..],
            ..conv
        }
        .run(isa, &vec![1.0; x_len], &mut y);
        layer.run(isa, &vec![1.0; x_len - 1], &mut y);
        assert!(y.iter().all(|&y| y == 5.0));
        // A kernel whose size is beyond a usize.
        let beyond = Sweep {
            kernel: [usize::MAX / 2 + 1, 2],
            dilation: [0, 0],
            ..sweep
        };
        Conv {
            sweep: beyond,
            w: &[],
            ..conv
        }
        .run(isa, &vec![1.0; x_len], &mut y);
        Depthwise {
            sweep: beyond,
            w: &[],
            ..layer
        }
        .run(isa, &vec![1.0; x_len], &mut y);
        assert!(y.iter().all(|&y| y == 5.0));
        // Whole pixels that there are are written.
        conv.run(isa, &vec![1.0; x_len], &mut y[..4]);
        assert_eq!(y[..5], [8.0, 8.0, 8.0, 5.0, 5.0]);
    }
}

/// Over one row or column a stride says nothing, however large it is; and outputs that lie beyond any memory are not written.
#[test]
fn strides_that_nothing_goes_along_may_be_anything() {
    const MOST: usize = usize::MAX;
    let one = Sweep {
        out: [1, 1],
        kernel: [1, 1],
        stride: [MOST, MOST],
        dilation: [MOST, MOST],
        x_strides: [MOST, MOST],
        y_strides: [MOST, MOST],
    };
    let far = Sweep {
        out: [2, 3],
        stride: [1, 1],
        x_strides: [0, 0],
        ..one
    };
    let (packed, bias) = (vec![1.0; conv_packed_len([2, 2])], [0.5; 2]);
    for (sweep, pixels) in [(one, 1), (far, 1)] {
        let conv = Conv {
            sweep,
            c: 2,
            n: 2,
            w: &packed,
            bias: &bias,
            activation: Activation::None,
            accumulate: false,
        };
        let layer = Depthwise {
            sweep,
            c: 2,
            w: &packed[..depthwise_packed_len([1, 2])],
            bias: &bias,
            activation: Activation::None,
        };
        let results = on_all(|isa| {
            let (mut dense, mut deep) = (vec![7.0; 8], vec![7.0; 8]);
            conv.run(isa, &[1.0, 2.0], &mut dense);
            layer.run(isa, &[1.0, 2.0], &mut deep);
            [dense, deep]
        });
        for (y, wanted) in results.iter().zip([[3.5, 3.5], [1.5, 2.5]]) {
            assert_eq!(y[..2 * pixels], wanted);
            assert!(y[2 * pixels..].iter().all(|&y| y == 7.0), "{y:?}");
        }
    }
}

#[test]
fn activations_keep_what_is_no_number_and_bound_what_is_infinite() {
    let kinds = [
        Activation::None,
        Activation::Relu,
        Activation::LeakyRelu(0.1),
        Activation::Clipped(6.0),
    ];
    let (sweep, [x_len, y_len]) = sweep([1, 1], [[1, 1], [1, 1], [1, 1], [1, 1]], [0, 0]);
    assert_eq!([x_len, y_len], [1, 1]);
    for activation in kinds {
        for x in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.0, 7.0] {
            let mut packed = vec![0.0; conv_packed_len([1, 1])];
            packed[0] = 1.0;
            let results = [false, true].map(|depthwise| {
                on_all(|isa| {
                    let mut y = vec![0.0];
                    if depthwise {
                        let layer = Depthwise {
                            sweep,
                            c: 1,
                            w: &packed,
                            bias: &[0.0],
                            activation,
                        };
                        layer.run(isa, &[x], &mut y);
                    } else {
                        let conv = Conv {
                            sweep,
                            c: 1,
                            n: 1,
                            w: &packed,
                            bias: &[0.0],
                            activation,
                            accumulate: false,
                        };
                        conv.run(isa, &[x], &mut y);
                    }
                    [y]
                })
            });
            let wanted = lads_kernels::reference::activation(activation, f64::from(x)) as f32;
            for [y] in results {
                assert_eq!(y[0].is_nan(), x.is_nan(), "{activation:?} of {x}");
                assert!(
                    x.is_nan() || y[0] == wanted,
                    "{activation:?} of {x} is {y:?}"
                );
            }
        }
    }
}

#[test]
fn not_a_number_is_not_lost() {
    let pool = Pool {
        kind: PoolKind::Max,
        size: [1, 3],
        out: [1, 1],
        c: 1,
        kernel: [1, 3],
        stride: [1, 1],
        dilation: [1, 1],
        before: [0, 0],
        after: [0, 0],
        x_strides: [3, 1],
        y_strides: [1, 1],
    };
    for i in 0..3 {
        let mut x = [1.0, 2.0, 3.0];
        x[i] = f32::NAN;
        let [y] = on_all(|isa| {
            let mut y = vec![0.0];
            pool.run(isa, &x, &mut y);
            [y]
        });
        assert!(y[0].is_nan());
    }
}

/// Pins result bits that must never change, on any target or at any optimisation level.
#[test]
fn results_have_the_same_bits_everywhere() {
    let over = |channels, activation: Activation, accumulate: bool| {
        let (sweep, [x_len, y_len]) = sweep(channels, [[5, 7], [3, 3], [2, 1], [1, 1]], [0, 0]);
        let [c, n] = channels;
        let k = 9 * c;
        let mut packed = vec![0.0; conv_packed_len([k, n])];
        conv_pack(&values(k * n, 1), [k, n], &mut packed);
        let bias = values(n, 2);
        let conv = Conv {
            sweep,
            c,
            n,
            w: &packed,
            bias: &bias,
            activation,
            accumulate,
        };
        let [y] = on_all(|isa| {
            let mut y = values(y_len, 4);
            conv.run(isa, &values(x_len, 3), &mut y);
            [y]
        });
        y
    };
    let (deep, [x_len, y_len]) = sweep([37, 37], [[5, 7], [3, 3], [2, 1], [1, 2]], [0, 0]);
    let mut packed = vec![0.0; depthwise_packed_len([9, 37])];
    depthwise_pack(&values(9 * 37, 1), [9, 37], &mut packed);
    let bias = values(37, 2);
    let layer = Depthwise {
        sweep: deep,
        c: 37,
        w: &packed,
        bias: &bias,
        activation: Activation::Elu(0.7),
    };
    let [depthwise] = on_all(|isa| {
        let mut y = vec![0.0; y_len];
        layer.run(isa, &values(x_len, 3), &mut y);
        [y]
    });
    let pool = |kind| {
        let pool = Pool {
            kind,
            size: [9, 8],
            out: [4, 6],
            c: 19,
            kernel: [3, 2],
            stride: [3, 2],
            dilation: [1, 2],
            before: [1, 2],
            after: [1, 2],
            x_strides: [19 * 8, 19],
            y_strides: [19 * 6, 19],
        };
        let [y] = on_all(|isa| {
            let mut y = vec![0.0; 4 * 6 * 19];
            pool.run(isa, &values(9 * 8 * 19, 5), &mut y);
            [y]
        });
        y
    };
    let table = [
        [0.0, 1.0, 0.25],
        [1.0, 2.0, 0.7],
        [4.0, 4.0, 0.0],
        [3.0, 4.0, 0.1],
    ];
    let resize = Resize {
        size: [5, 5],
        c: 19,
        rows: table.as_flattened(),
        cols: table.as_flattened(),
        x_strides: [19 * 5, 19],
        y_strides: [19 * 4, 19],
    };
    let [resized] = on_all(|isa| {
        let mut y = vec![0.0; 4 * 4 * 19];
        resize.run(isa, &values(5 * 5 * 19, 6), &mut y);
        [y]
    });
    let results = [
        over([19, 37], Activation::Clipped(6.0), false),
        over([19, 37], Activation::Tanh, true),
        depthwise,
        pool(PoolKind::Max),
        pool(PoolKind::Mean),
        pool(PoolKind::PaddedMean),
        resized,
    ];
    assert_eq!(
        results.map(|y| digest(&y)),
        [
            13_669_488_750_079_871_009,
            13_999_116_788_343_981_019,
            3_101_047_274_708_411_837,
            3_911_788_625_827_074_647,
            7_856_214_053_099_813_820,
            8_040_180_050_763_095_212,
            16_607_212_345_964_279_329,
        ]
    );
}
