//! Compares convolutions of integers with their naive twin, on random shapes and bit for bit on every
//! instruction set; and tests where their arithmetic is exact, where it nearly overflows, and where
//! inputs are extreme.

#[path = "support/shapes.rs"]
mod shapes;
mod support;

use lads_kernels::reference as naive;
use lads_kernels::{
    Activation, ImageIntegers, IntegerConv, Isa, Panels, Sweep, WeightFormat, conv_integers_len,
    conv_integers_pack, conv_scale, stored,
};
use proptest::prelude::*;
use shapes::{activation, pair, sweep, untouched};
use support::{close_up_to, digest, on_all, values};

/// Largest magnitude of an input as an integer.
const LARGEST: i16 = 16383;

/// Weights of a convolution in one of its formats.
struct Stored {
    wide: Vec<i16>,
    narrow: Vec<i8>,
    /// As they were packed, `[k, n]`.
    integers: Vec<i16>,
    scales: Vec<f32>,
}

impl Stored {
    /// Quantises `w`, `[k, n]`.
    fn new(format: WeightFormat, w: &[f32], runs: [usize; 2], n: usize) -> Self {
        let column = |j: usize| w.iter().skip(j).step_by(n).copied();
        let scales: Vec<f32> = (0..n)
            .map(|j| conv_scale(format, column(j), runs[1]))
            .collect();
        let is_narrow = format == WeightFormat::Int8;
        let quantised = |(i, &w): (usize, &f32)| {
            if is_narrow {
                i16::from(stored::to_int8(w, scales[i % n]))
            } else {
                stored::to_int16(w, scales[i % n])
            }
        };
        let integers: Vec<i16> = w.iter().enumerate().map(quantised).collect();
        Self::of(integers, is_narrow, scales, runs)
    }

    fn of(integers: Vec<i16>, is_narrow: bool, scales: Vec<f32>, runs: [usize; 2]) -> Self {
        let n = scales.len();
        let mut wide = vec![0; conv_integers_len(runs, n)];
        conv_integers_pack(&integers, runs, n, &mut wide);
        let narrow = if is_narrow {
            wide.iter().map(|&w| w as i8).collect()
        } else {
            vec![]
        };
        Self {
            wide,
            narrow,
            integers,
            scales,
        }
    }

    fn panels(&self) -> Panels<'_> {
        let scales = &self.scales;
        if self.narrow.is_empty() {
            Panels::Int16 {
                panels: &self.wide,
                scales,
            }
        } else {
            Panels::Int8 {
                panels: &self.narrow,
                scales,
            }
        }
    }
}

/// Converts an image that covers what a sweep reads, on every instruction set, and returns its
/// integers, one more, and the scale.
fn converted(sweep: &Sweep, c: usize, x: &[f32]) -> (Vec<i16>, f32) {
    let size: [usize; 2] = std::array::from_fn(|axis| {
        (sweep.out[axis] - 1) * sweep.stride[axis]
            + (sweep.kernel[axis] - 1) * sweep.dilation[axis]
            + 1
    });
    let image = ImageIntegers {
        size,
        c,
        x_strides: sweep.x_strides,
    };
    let run = |isa| {
        let mut y = vec![7; size[0] * size[1] * c + 1];
        let scale = image.run(isa, x, &mut y);
        (y, scale)
    };
    let expected = run(Isa::portable());
    for isa in Isa::all() {
        let (y, scale) = run(isa);
        assert_eq!(y, expected.0, "{isa:?}");
        assert!(scale == expected.1 || scale.is_nan() && expected.1.is_nan());
    }
    expected
}

/// Returns the sweep over the integers of an image, row after row without gaps.
fn dense(sweep: &Sweep, c: usize) -> Sweep {
    let cols = (sweep.out[1] - 1) * sweep.stride[1] + (sweep.kernel[1] - 1) * sweep.dilation[1] + 1;
    Sweep {
        x_strides: [cols * c, c],
        ..*sweep
    }
}

proptest! {
    #[test]
    fn a_convolution_of_integers_equals_its_twin(
        (c, n) in (prop_oneof![1_usize..6, 14_usize..40], prop_oneof![1_usize..5, 14_usize..80]),
        shape in [pair(1..6), pair(1..5), pair(1..4), pair(1..3)],
        gaps in pair(0..4),
        (activation, accumulate, narrow) in (activation(), any::<bool>(), any::<bool>()),
        seed in any::<u64>(),
    ) {
        let format = if narrow { WeightFormat::Int8 } else { WeightFormat::Int16 };
        let (sweep, [x_len, y_len]) = sweep([c, n], shape, gaps);
        let k = sweep.kernel[0] * sweep.kernel[1] * c;
        let (x, w, bias) = (values(x_len, seed), values(k * n, seed ^ 1), values(n, seed ^ 2));
        let (integers, scale) = converted(&sweep, c, &x);
        let inside = dense(&sweep, c);
        let stored = Stored::new(format, &w, inside.runs(c), n);
        let conv = IntegerConv { sweep: inside, c, n, w: stored.panels(), bias: &bias, activation, accumulate };
        let before = values(y_len, seed ^ 3);
        let [y] = on_all(|isa| {
            let mut y = before.clone();
            conv.run(isa, &integers, scale, &mut y);
            [y]
        });
        // The same integers: what differs is how the sums of groups and the scales are rounded.
        let mut expected = before.clone();
        let weights = (&stored.integers[..], &stored.scales[..], &bias[..]);
        naive::integer_conv(&inside, weights, (activation, accumulate), (&integers, scale), &mut expected);
        close_up_to(&y, &expected, 2e-6, &vec![1e-8 * k as f32; y_len]);
        prop_assert!(untouched(&sweep, n, &before, &y));
        // The floats: half a unit of each input and of each weight.
        let mut exact = before.clone();
        naive::conv(&sweep, (&w, &bias), (activation, accumulate), &x, &mut exact);
        let of_weights = stored.scales.iter().fold(0.0_f32, |most, &scale| most.max(scale));
        let each = 0.5 * scale + 0.5 * of_weights + 0.25 * scale * of_weights;
        close_up_to(&y, &exact, 2e-6, &vec![(each + 1e-8) * k as f32; y_len]);
    }

    /// Inputs that are whole numbers, one of them as large as the largest integer, and such weights are
    /// multiplied exactly; results below 2^24 are exact as floats.
    #[test]
    fn whole_numbers_are_multiplied_exactly(
        (c, n) in (1_usize..20, 1_usize..40),
        shape in [pair(1..5), pair(1..4), pair(1..3), pair(1..3)],
        seed in any::<u64>(),
    ) {
        let (sweep, [x_len, y_len]) = sweep([c, n], shape, [0, 0]);
        let k = sweep.kernel[0] * sweep.kernel[1] * c;
        let whole = |x: f32, most: f32| (x * most).round();
        let mut x: Vec<f32> = values(x_len, seed).iter().map(|&x| whole(x, 900.0)).collect();
        x[0] = f32::from(LARGEST);
        let w: Vec<i16> = values(k * n, seed ^ 1).iter().map(|&w| whole(w, 30.0) as i16).collect();
        let (integers, scale) = converted(&sweep, c, &x);
        prop_assert_eq!(scale, 1.0);
        prop_assert!(integers.iter().zip(&x).all(|(&q, &x)| f32::from(q) == x));
        prop_assert_eq!(integers.last(), Some(&0));
        let stored = Stored::of(w, false, vec![1.0; n], sweep.runs(c));
        let bias = vec![0.0; n];
        let conv = IntegerConv {
            sweep, c, n, w: stored.panels(), bias: &bias,
            activation: Activation::None, accumulate: false,
        };
        let [y] = on_all(|isa| {
            let mut y = vec![f32::NAN; y_len];
            conv.run(isa, &integers, scale, &mut y);
            [y]
        });
        let mut expected = vec![f32::NAN; y_len];
        let weights = (&stored.integers[..], &stored.scales[..], &bias[..]);
        naive::integer_conv(&sweep, weights, (Activation::None, false), (&integers, scale), &mut expected);
        prop_assert_eq!(y, expected);
    }

    /// The scale of an output keeps every sum of products inside 32 bits, whatever the weights and
    /// however runs are rounded up to pairs.
    #[test]
    fn no_group_of_weights_can_overflow(
        (runs, len) in (1_usize..20, 1_usize..140),
        (flat, seed) in (any::<bool>(), any::<u64>()),
    ) {
        let column: Vec<f32> = values(runs * len, seed)
            .into_iter()
            .map(|w| if flat { 0.3_f32.copysign(w) } else { w })
            .collect();
        for format in [WeightFormat::Int16, WeightFormat::Int8] {
            let stored = Stored::new(format, &column, [runs, len], 1);
            // Of sixteen columns the first.
            let packed: Vec<i64> = stored.wide.chunks(32).flat_map(|pair| &pair[..2]).map(|&w| i64::from(w)).collect();
            for group in packed.chunks(64) {
                let sum: i64 = group.iter().map(|w| w.abs() * i64::from(LARGEST)).sum();
                prop_assert!(sum <= i64::from(i32::MAX), "{sum}");
            }
            // None is coarser than it must be: the largest weight, or the largest sum, is near its bound.
            let largest = packed.iter().map(|w| w.abs()).max().unwrap_or(0);
            let most = packed.chunks(64).map(|group| group.iter().map(|w| w.abs()).sum::<i64>()).max();
            let bounds = if format == WeightFormat::Int8 { [127, i64::MAX] } else { [16383, 130_900] };
            prop_assert!(largest == bounds[0] || most >= Some(bounds[1]), "{largest}, {most:?}");
        }
    }
}

/// A row of pixels, each multiplied with the same weight.
fn product(x: &[f32], w: i16) -> Vec<f32> {
    let sweep = Sweep {
        out: [1, x.len()],
        kernel: [1, 1],
        stride: [1, 1],
        dilation: [1, 1],
        x_strides: [x.len(), 1],
        y_strides: [x.len(), 1],
    };
    let (integers, scale) = converted(&sweep, 1, x);
    let stored = Stored::of(vec![w], false, vec![1.0], sweep.runs(1));
    let conv = IntegerConv {
        sweep,
        c: 1,
        n: 1,
        w: stored.panels(),
        bias: &[0.0],
        activation: Activation::None,
        accumulate: false,
    };
    let [y] = on_all(|isa| {
        let mut y = vec![0.0; x.len()];
        conv.run(isa, &integers, scale, &mut y);
        [y]
    });
    y
}

#[test]
fn what_is_no_number_or_infinite_is_never_lost() {
    for bad in [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for at in [0, 15, 63, 64, 99] {
            let mut x = [0.5; 100];
            x[at] = bad;
            assert!(product(&x, 3).iter().all(|y| y.is_nan()), "{bad} at {at}");
        }
    }
}

#[test]
fn inputs_of_any_size_keep_their_digits_and_the_tiniest_are_zero() {
    for exponent in -99..=113 {
        let x = f32::powi(2.0, exponent) * 1.37;
        for (y, sign) in product(&[x, -x], 16383).into_iter().zip([1.0, -1.0]) {
            let expected = f64::from(x) * 16383.0 * sign;
            assert!((f64::from(y) / expected - 1.0).abs() < 1e-6, "{x:e}: {y:e}");
        }
    }
    for tiny in [0.0, -0.0, f32::from_bits(1), 7e-31] {
        assert_eq!(product(&[tiny; 20], 16383), [0.0; 20]);
    }
}

#[test]
fn integers_that_overflow_have_the_same_bits_on_every_instruction_set() {
    let (sweep, [x_len, y_len]) = sweep([64, 70], [[1, 1], [1, 1], [1, 1], [1, 1]], [0, 0]);
    let stored = Stored::of(
        vec![i16::MIN; 64 * 70],
        false,
        vec![1.0; 70],
        sweep.runs(64),
    );
    let bias = [0.0; 70];
    let conv = IntegerConv {
        sweep,
        c: 64,
        n: 70,
        w: stored.panels(),
        bias: &bias,
        activation: Activation::None,
        accumulate: false,
    };
    let [y] = on_all(|isa| {
        let mut y = vec![0.0; y_len];
        conv.run(isa, &vec![i16::MIN; x_len], 1.0, &mut y);
        [y]
    });
    // 64 times 2^30, which wraps around to nothing.
    assert_eq!(y, [0.0; 70]);
}

#[test]
fn what_is_too_short_or_no_integer_is_left_as_it_was() {
    // Odd runs: one input more than there are is read.
    let (sweep, [x_len, y_len]) = sweep([1, 3], [[2, 2], [2, 3], [1, 1], [1, 1]], [0, 0]);
    let runs = sweep.runs(1);
    assert_eq!(runs, [2, 3]);
    let stored = Stored::of(vec![1; 6 * 3], false, vec![1.0; 3], runs);
    let conv = IntegerConv {
        sweep,
        c: 1,
        n: 3,
        w: stored.panels(),
        bias: &[0.0; 3],
        activation: Activation::None,
        accumulate: false,
    };
    let short = Panels::Int16 {
        panels: &stored.wide[1..],
        scales: &stored.scales,
    };
    let floats = vec![1.0; stored.wide.len()];
    let beyond = Sweep {
        kernel: [usize::MAX / 2 + 1, 2],
        dilation: [0, 0],
        ..sweep
    };
    for isa in Isa::all() {
        let mut y = vec![5.0; y_len];
        let x = vec![1; x_len + 1];
        conv.run(isa, &x[1..], 1.0, &mut y);
        IntegerConv { w: short, ..conv }.run(isa, &x, 1.0, &mut y);
        let w = Panels::F32(&floats);
        IntegerConv { w, ..conv }.run(isa, &x, 1.0, &mut y);
        let w = Panels::Int16 {
            panels: &[],
            scales: &[],
        };
        IntegerConv {
            sweep: beyond,
            w,
            ..conv
        }
        .run(isa, &x, 1.0, &mut y);
        assert!(y.iter().all(|&y| y == 5.0));
        // Whole pixels that there are are written.
        conv.run(isa, &x, 1.0, &mut y[..4]);
        assert_eq!(y[..5], [6.0, 6.0, 6.0, 5.0, 5.0]);

        let image = ImageIntegers {
            size: [2, 2],
            c: 3,
            x_strides: [6, 3],
        };
        let mut integers = [9; 12];
        assert!(image.run(isa, &[1.0; 11], &mut integers).is_nan());
        assert!(image.run(isa, &[1.0; 12], &mut integers[..11]).is_nan());
        assert_eq!(integers, [9; 12]);
    }
}

/// Pins result bits that must never change, on any target or at any optimisation level.
#[test]
fn results_have_the_same_bits_everywhere() {
    let over = |format, activation: Activation, accumulate: bool| {
        let [c, n] = [19, 37];
        let (sweep, [x_len, y_len]) = sweep([c, n], [[5, 7], [3, 3], [2, 1], [1, 1]], [0, 0]);
        let runs = sweep.runs(c);
        let stored = Stored::new(format, &values(9 * c * n, 1), runs, n);
        let bias = values(n, 2);
        let (integers, scale) = converted(&sweep, c, &values(x_len, 3));
        let conv = IntegerConv {
            sweep,
            c,
            n,
            w: stored.panels(),
            bias: &bias,
            activation,
            accumulate,
        };
        let [y] = on_all(|isa| {
            let mut y = values(y_len, 4);
            conv.run(isa, &integers, scale, &mut y);
            [y]
        });
        digest(&y)
    };
    let digests = [
        over(WeightFormat::Int16, Activation::Clipped(6.0), false),
        over(WeightFormat::Int16, Activation::Tanh, true),
        over(WeightFormat::Int8, Activation::None, false),
    ];
    assert_eq!(
        digests,
        [
            15_081_285_204_944_465_558,
            11_513_728_314_907_280_929,
            8_359_065_549_094_020_138,
        ]
    );
}
