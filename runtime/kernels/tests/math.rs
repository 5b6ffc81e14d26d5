//! Measures the error bounds that `math` states against `f64`, over a dense sample of all `f32`.

use lads_kernels::math;

/// Returns every `f32` that is not NaN, in steps of 257 bit patterns: 16.7 million values.
fn samples() -> impl Iterator<Item = f32> {
    (0..=u32::MAX)
        .step_by(257)
        .map(f32::from_bits)
        .filter(|x| !x.is_nan())
}

/// Returns the largest relative error over the samples of a range; results below the normal numbers
/// have to be within one subnormal step instead.
fn largest_error(range: [f32; 2], f: fn(f32) -> f32, exact: fn(f64) -> f64) -> f64 {
    let mut largest = 0.0_f64;
    for x in samples().filter(|x| (range[0]..=range[1]).contains(x)) {
        let (got, expected) = (f64::from(f(x)), exact(f64::from(x)));
        if expected.abs() < f64::from(f32::MIN_POSITIVE) {
            let step = f64::from(f32::from_bits(1));
            assert!(
                (got - expected).abs() <= step,
                "{x}: {got} against {expected}"
            );
        } else if expected.abs() <= f64::from(f32::MAX) {
            largest = largest.max(((got - expected) / expected).abs());
        }
    }
    largest
}

#[track_caller]
fn below(error: f64, bound: f64) {
    assert!(error < bound, "{error} is not below {bound}");
    // A bound that is far too generous says nothing.
    assert!(error > bound / 3.0, "{error} is far below {bound}");
}

#[test]
fn exp_is_as_exact_as_it_says() {
    below(
        largest_error([f32::NEG_INFINITY, 88.7], math::exp, f64::exp),
        1.2e-7,
    );
    assert_eq!(math::exp(0.0), 1.0);
    assert_eq!(math::exp(-0.0), 1.0);
    assert_eq!(math::exp(f32::NEG_INFINITY), 0.0);
    assert_eq!(math::exp(-104.0), 0.0);
    assert_eq!(math::exp(f32::INFINITY), f32::INFINITY);
    assert_eq!(math::exp(88.73), f32::INFINITY);
    assert!(math::exp(f32::NAN).is_nan());
}

#[test]
fn sigmoid_is_as_exact_as_it_says() {
    below(
        largest_error([-87.0, f32::INFINITY], math::sigmoid, |x| {
            1.0 / (1.0 + (-x).exp())
        }),
        2.5e-7,
    );
    assert_eq!(math::sigmoid(0.0), 0.5);
    assert_eq!(math::sigmoid(f32::NEG_INFINITY), 0.0);
    assert_eq!(math::sigmoid(f32::INFINITY), 1.0);
    assert!(math::sigmoid(f32::NAN).is_nan());
}

#[test]
fn tanh_is_as_exact_as_it_says() {
    below(
        largest_error([f32::NEG_INFINITY, f32::INFINITY], math::tanh, f64::tanh),
        2.5e-7,
    );
    assert_eq!(math::tanh(0.0), 0.0);
    assert_eq!(math::tanh(f32::INFINITY), 1.0);
    assert_eq!(math::tanh(f32::NEG_INFINITY), -1.0);
    assert!(math::tanh(f32::NAN).is_nan());
}

#[test]
fn elu_is_as_exact_as_it_says() {
    let elu = |x| math::elu(x, 1.0);
    below(
        largest_error([f32::NEG_INFINITY, f32::INFINITY], elu, |x| {
            if x < 0.0 { x.exp_m1() } else { x }
        }),
        1.2e-7,
    );
    assert_eq!((elu(0.0), elu(-0.0)), (0.0, 0.0));
    assert_eq!(math::elu(f32::NEG_INFINITY, 0.5), -0.5);
    assert_eq!(elu(f32::INFINITY), f32::INFINITY);
    assert!(elu(f32::NAN).is_nan());
}

#[test]
fn softplus_and_mish_are_as_exact_as_they_say() {
    let exact = |x: f64| x.max(0.0) + (-x.abs()).exp().ln_1p();
    let range = [-87.0, f32::INFINITY];
    below(largest_error(range, math::softplus, exact), 4.0e-7);
    below(
        largest_error(range, math::mish, |x| {
            let n = x.min(300.0).exp();
            let n = n * (n + 2.0);
            x * (n / (n + 2.0))
        }),
        4.0e-7,
    );
    for f in [math::softplus, math::mish] {
        assert_eq!(f(f32::INFINITY), f32::INFINITY);
        assert!(f(f32::NAN).is_nan());
    }
    assert_eq!(math::softplus(f32::NEG_INFINITY), 0.0);
    assert_eq!(math::mish(-200.0), 0.0);
}

#[test]
fn the_functions_of_libm_are_as_exact_as_stated() {
    below(
        largest_error([f32::NEG_INFINITY, f32::INFINITY], math::erf, libm::erf),
        1.2e-7,
    );
    below(largest_error([0.0, f32::MAX], math::log, f64::ln), 1.2e-7);
    below(
        largest_error(
            [0.0, f32::MAX],
            |x| math::pow(x, 0.7),
            |x| x.powf(f64::from(0.7_f32)),
        ),
        1.2e-7,
    );
}

#[test]
fn not_a_number_is_never_lost() {
    let nan = f32::NAN;
    assert!(math::relu(nan).is_nan() && math::leaky_relu(nan, 0.1).is_nan());
    for (a, b) in [(nan, 1.0), (1.0, nan), (nan, nan)] {
        assert!(math::max(a, b).is_nan() && math::min(a, b).is_nan());
    }
    assert_eq!((math::max(1.0, 2.0), math::min(1.0, 2.0)), (2.0, 1.0));
    assert_eq!(
        (
            math::relu(-1.0),
            math::relu(3.0),
            math::leaky_relu(-2.0, 0.25)
        ),
        (0.0, 3.0, -0.5)
    );
}
