//! Compares the formats of stored weights with their definitions, over all bit patterns or a dense
//! sample of all `f32`.

use lads_kernels::stored::{
    from_bf16, from_f16, int8_scale, int16_scale, round_to_f16, to_bf16, to_f16, to_int8, to_int16,
};

/// Decodes a half-precision number by IEEE 754-2019, section 3.4, with 5 bits of exponent and 10 of
/// fraction.
fn half(bits: u16) -> f64 {
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023));
    sign * match exponent {
        0 => fraction * 2_f64.powi(-24),
        31 if fraction == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        _ => (1.0 + fraction / 1024.0) * 2_f64.powi(exponent - 15),
    }
}

/// Returns numbers whose conversion may be wrong: a sample of all, and the neighbourhood of every
/// half-precision number and of every midpoint of two.
fn samples() -> impl Iterator<Item = f32> {
    let near = |x: f64| {
        let bits = (x as f32).to_bits();
        (bits.saturating_sub(2)..=bits + 2).map(f32::from_bits)
    };
    let halves = (0..0x7c00_u16).flat_map(move |bits| {
        let (this, next) = (
            half(bits),
            if bits == 0x7bff {
                65536.0
            } else {
                half(bits + 1)
            },
        );
        near(this).chain(near(f64::midpoint(this, next)))
    });
    let all = (0..=u32::MAX).step_by(4099).map(f32::from_bits);
    all.chain(halves.flat_map(|x| [x, -x]))
        .filter(|x| !x.is_nan())
}

#[test]
fn every_half_means_what_the_standard_says() {
    for bits in 0..=u16::MAX {
        let (got, expected) = (f64::from(from_f16(bits)), half(bits));
        let same = got.to_bits() == expected.to_bits() || got.is_nan() && expected.is_nan();
        assert!(same, "{bits:#06x}: {got} against {expected}");
    }
}

#[test]
fn halves_are_the_nearest_ones_ties_to_even() {
    for x in samples() {
        let Some(bits) = to_f16(x) else {
            assert!(x.abs() >= 65520.0, "{x} is refused");
            let infinite = from_f16(round_to_f16(x));
            assert!(infinite.is_infinite() && infinite.signum() == x.signum());
            continue;
        };
        assert!(x.abs() < 65520.0, "{x} is taken");
        assert_eq!(bits, round_to_f16(x));
        assert_eq!(x.is_sign_negative(), bits >> 15 == 1);
        let error = |bits: u16| (half(bits) - f64::from(x)).abs();
        for other in [bits.wrapping_sub(1), bits + 1]
            .into_iter()
            .filter(|bits| bits & 0x7fff <= 0x7bff)
        {
            let (own, its) = (error(bits), error(other));
            assert!(
                own < its || own == its && bits & 1 == 0,
                "{x:e}: {bits:#06x} or {other:#06x}"
            );
        }
    }
}

#[test]
fn what_is_not_a_number_stays_none_as_a_half() {
    for bits in (0x7f80_0001..=0x7fff_ffff_u32).step_by(4099) {
        for x in [bits, bits | 1 << 31].map(f32::from_bits) {
            assert!(x.is_nan() && to_f16(x).is_none() && from_f16(round_to_f16(x)).is_nan());
        }
    }
}

#[test]
fn brain_floats_are_the_nearest_ones_ties_to_even() {
    for x in (0..=u32::MAX).step_by(257).map(f32::from_bits) {
        let below = x.to_bits() & 0xffff_0000;
        let Some(bits) = to_bf16(x) else {
            assert!(
                !x.is_finite() || below & 0x7fff_0000 == 0x7f7f_0000,
                "{x:e} is refused"
            );
            continue;
        };
        let dropped = x.to_bits() - below;
        let up = dropped > 0x8000 || dropped == 0x8000 && below >> 16 & 1 == 1;
        assert_eq!(u32::from(bits), (below >> 16) + u32::from(up), "{x:e}");
        assert_eq!(from_bf16(bits).to_bits(), u32::from(bits) << 16);
    }
}

#[test]
fn integers_are_the_nearest_multiples_of_the_scale() {
    let w = [0.5, -1.27, 0.004, 0.0, 1.0, 0.015];
    let scale = int8_scale(w.into_iter());
    assert_eq!(scale, 1.27 / 127.0);
    assert_eq!(w.map(|w| to_int8(w, scale)), [50, -127, 0, 0, 100, 2]);
    for w in w {
        assert!((f32::from(to_int8(w, scale)) * scale - w).abs() <= scale / 2.0);
    }
    let scale = int16_scale(w.into_iter());
    assert_eq!(scale, 1.27 / 16383.0);
    assert_eq!(to_int16(-1.27, scale), -16383);
    for w in w {
        assert!((f32::from(to_int16(w, scale)) * scale - w).abs() <= scale * 0.501);
    }
    assert_eq!(int8_scale([0.0, -0.0].into_iter()), 1.0);
    assert_eq!(int8_scale([f32::from_bits(3)].into_iter()), 1.0);
}
