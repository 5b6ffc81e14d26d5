//! Scalar functions with the same bits on every target, written so that loops over them vectorise: no branch, no table, no
//! fused multiply-add.
//!
//! Error bounds are the largest relative errors that `tests/math.rs` finds against `f64` over a dense sample of all `f32`.
//! In units in the last place, of which one is a relative 6.0e-8 to 1.2e-7: below 1.2e-7 is below 2 units, below 2.5e-7 below 4.2.

/// Rectifier, `max(x, 0)`; NaN stays NaN.
#[inline(always)]
pub fn relu(x: f32) -> f32 {
    if x < 0.0 { 0.0 } else { x }
}

/// Leaky rectifier: `x` where `x >= 0`, else `alpha * x`.
#[inline(always)]
pub fn leaky_relu(x: f32, alpha: f32) -> f32 {
    if x < 0.0 { alpha * x } else { x }
}

/// Returns the larger number; NaN if either is NaN.
#[inline(always)]
pub fn max(a: f32, b: f32) -> f32 {
    if a < b || b.is_nan() { b } else { a }
}

/// Returns the smaller number; NaN if either is NaN.
#[inline(always)]
pub fn min(a: f32, b: f32) -> f32 {
    if a > b || b.is_nan() { b } else { a }
}

/// Natural exponential; relative error below 1.2e-7 where the result is a normal number.
///
/// `exp(x) = 2^n * exp(r)` with `n = round(x / ln 2)` and `r = x - n ln 2` (ln 2 in two parts, the first short enough that its
/// product with `n` is exact). The polynomial and the two parts are those of Cephes' `expf` (S. Moshier).
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    exp_of(split(x))
}

/// [`exp`] of `x`, with `(n, p) = split(x)`.
#[inline(always)]
pub fn exp_of((n, p): (i32, f32)) -> f32 {
    // 2^n in two factors, each a normal number, so that results below the normal numbers are rounded once.
    let half = n >> 1;
    (p + 1.0) * power_of_two(half) * power_of_two(n.wrapping_sub(half))
}

/// Splits an exponential: returns `n` and `p` with `exp(x) = 2^n * (1 + p)`.
#[inline(always)]
pub fn split(x: f32) -> (i32, f32) {
    // 1.5 * 2^23: adding it leaves the rounded number in the low bits of the mantissa.
    const ROUND: f32 = 12582912.0;
    const LN2_HIGH: f32 = 0.693359375;
    const LN2_LOW: f32 = -2.12194440e-4;
    // Beyond these the exponential is infinite or rounds to zero.
    let x = x.clamp(-104.0, 89.0);
    let rounded = x * core::f32::consts::LOG2_E + ROUND;
    let n = rounded - ROUND;
    let r = (x - n * LN2_HIGH) - n * LN2_LOW;
    let mut p = 1.9875691500e-4;
    p = p * r + 1.3981999507e-3;
    p = p * r + 8.3334519073e-3;
    p = p * r + 4.1665795894e-2;
    p = p * r + 1.6666665459e-1;
    p = p * r + 5.0000001201e-1;
    let n = rounded
        .to_bits()
        .wrapping_sub(ROUND.to_bits())
        .cast_signed();
    (n, p * (r * r) + r)
}

/// Exponential linear unit: `x` where `x >= 0`, else `alpha * (exp(x) - 1)`, near zero without
/// cancellation; relative error below 1.2e-7 with an `alpha` of 1.
#[inline(always)]
pub fn elu(x: f32, alpha: f32) -> f32 {
    elu_of(x, alpha, split(elu_exponent(x)))
}

/// Exponent of [`elu`]: below -30 the exponential is lost beside one.
#[inline(always)]
pub fn elu_exponent(x: f32) -> f32 {
    x.clamp(-30.0, 0.0)
}

/// [`elu`] of `x`, with `(n, p) = split(elu_exponent(x))`.
#[inline(always)]
pub fn elu_of(x: f32, alpha: f32, (n, p): (i32, f32)) -> f32 {
    let scale = power_of_two(n);
    let below = alpha * (p * scale + (scale - 1.0));
    if x < 0.0 { below } else { x }
}

/// Softplus, `log(1 + exp(x))`; relative error below 4.0e-7 where the result is a normal number.
///
/// `max(x, 0) + log(1 + t)` with `t = exp(-|x|)`, and `log(1 + t) = 2 atanh(s)` with `s = t / (2 + t)`, at most a third, as a series.
#[inline(always)]
pub fn softplus(x: f32) -> f32 {
    softplus_of(x, exp(-x.abs()))
}

/// [`softplus`] of `x`, with `t = exp(-|x|)`.
#[inline(always)]
pub fn softplus_of(x: f32, t: f32) -> f32 {
    let s = t / (2.0 + t);
    let z = s * s;
    let mut p = 1.0 / 13.0;
    p = p * z + 1.0 / 11.0;
    p = p * z + 1.0 / 9.0;
    p = p * z + 1.0 / 7.0;
    p = p * z + 1.0 / 5.0;
    p = p * z + 1.0 / 3.0;
    relu(x) + (2.0 * s + 2.0 * s * z * p)
}

/// Mish, `x * tanh(log(1 + exp(x)))`; relative error below 4.0e-7 where the result is a normal
/// number.
///
/// With `w = exp(x)` the hyperbolic tangent is `n / (n + 2)`, `n = w (w + 2)`.
#[inline(always)]
pub fn mish(x: f32) -> f32 {
    mish_of(x, exp(mish_exponent(x)))
}

/// Exponent of [`mish`]: from 20 on the quotient rounds to one, long before `n` is infinite.
#[inline(always)]
pub fn mish_exponent(x: f32) -> f32 {
    min(x, 20.0)
}

/// [`mish`] of `x`, with `w = exp(mish_exponent(x))`.
#[inline(always)]
pub fn mish_of(x: f32, w: f32) -> f32 {
    let n = w * (w + 2.0);
    x * (n / (n + 2.0))
}

/// Rounds towards zero.
#[inline(always)]
pub fn trunc(x: f32) -> f32 {
    libm::truncf(x)
}

/// Returns 1 if `a > b`, else 0.
#[inline(always)]
pub fn greater(a: f32, b: f32) -> f32 {
    if a > b { 1.0 } else { 0.0 }
}

/// Returns `a` if `b` is not zero, else 0.
#[inline(always)]
pub fn keep(a: f32, b: f32) -> f32 {
    if b == 0.0 { 0.0 } else { a }
}

/// Returns `2^n` for `n` in `-126..=127`.
#[inline(always)]
fn power_of_two(n: i32) -> f32 {
    f32::from_bits((n.wrapping_add(127) << 23).cast_unsigned())
}

/// Logistic sigmoid, `1 / (1 + exp(-x))`; relative error below 2.5e-7 where the result is a normal
/// number.
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    sigmoid_of(exp(-x))
}

/// [`sigmoid`], with `e = exp(-x)`.
#[inline(always)]
pub fn sigmoid_of(e: f32) -> f32 {
    1.0 / (1.0 + e)
}

/// Hyperbolic tangent; relative error below 2.5e-7.
///
/// Below 0.625 the odd polynomial of Cephes' `tanhf`, above `1 - 2 / (exp(2|x|) + 1)`.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    tanh_of(x, exp(tanh_exponent(x)))
}

/// Exponent of [`tanh`].
#[inline(always)]
pub fn tanh_exponent(x: f32) -> f32 {
    2.0 * x.abs()
}

/// [`tanh`] of `x`, with `e = exp(tanh_exponent(x))`.
#[inline(always)]
pub fn tanh_of(x: f32, e: f32) -> f32 {
    let z = x * x;
    let mut p = -5.70498872745e-3;
    p = p * z + 2.06390887954e-2;
    p = p * z - 5.37397155531e-2;
    p = p * z + 1.33314422036e-1;
    p = p * z - 3.33332819422e-1;
    let small = p * z * x + x;
    let large = (1.0 - 2.0 / (e + 1.0)).copysign(x);
    if x.abs() < 0.625 { small } else { large }
}

/// Error function, from the `libm` crate (a port of the BSD one); relative error below 1.2e-7.
pub fn erf(x: f32) -> f32 {
    libm::erff(x)
}

/// Natural logarithm, from the `libm` crate; relative error below 1.2e-7.
pub fn log(x: f32) -> f32 {
    libm::logf(x)
}

/// Power `a^b`, from the `libm` crate; relative error below 1.2e-7.
pub fn pow(a: f32, b: f32) -> f32 {
    libm::powf(a, b)
}

/// Square root, correctly rounded.
#[inline(always)]
pub fn sqrt(x: f32) -> f32 {
    libm::sqrtf(x)
}
