//! Compares the cache and the attention to it with their naive twin, in every format and bit for bit
//! on every instruction set that the CPU offers.

mod support;

use lads_kernels::reference as naive;
use lads_kernels::{
    Append, Attention, Cache, CacheFormat, CacheMut, Isa, Scaled, ScaledMut, attention_scratch_len,
    keys_len, stored,
};
use proptest::prelude::*;
use proptest::sample::select;
use support::{close_up_to, digest, on_all, values};

/// Returns the bits of a head's numbers in a cache of this format, and its scale.
fn bits(format: CacheFormat, head: &[f32]) -> (Vec<u32>, Option<f32>) {
    let largest = head.iter().fold(0.0_f32, |largest, x| largest.max(x.abs()));
    let number = |x: &f32| match format {
        CacheFormat::F32 => x.to_bits(),
        CacheFormat::F16 => stored::round_to_f16(*x).into(),
        CacheFormat::Int8 => u32::from((x * (127.0 / largest)).round_ties_even() as i8 as u8),
    };
    let scale = (format == CacheFormat::Int8).then_some(largest / 127.0);
    (head.iter().map(number).collect(), scale)
}

/// A cache and its memory.
#[derive(Clone)]
enum Stored {
    F32([Vec<f32>; 2]),
    F16([Vec<u16>; 2]),
    /// Keys and values, each with their scales.
    Int8([(Vec<i8>, Vec<f32>); 2]),
}

impl Stored {
    /// Makes a cache of `rows` rows of these keys and values, whose scales of integers are some.
    fn new(
        format: CacheFormat,
        [rows, heads]: [usize; 2],
        keys: Vec<f32>,
        values: Vec<f32>,
    ) -> Self {
        let halves = |x: Vec<f32>| x.into_iter().map(stored::round_to_f16).collect();
        let integers = |x: Vec<f32>| {
            let scales = self::values(format.scales(rows, heads), 9);
            let scales = scales.into_iter().map(|scale| scale / 127.0).collect();
            (x.into_iter().map(|x| (x * 127.0) as i8).collect(), scales)
        };
        match format {
            CacheFormat::F32 => Self::F32([keys, values]),
            CacheFormat::F16 => Self::F16([keys, values].map(halves)),
            CacheFormat::Int8 => Self::Int8([keys, values].map(integers)),
        }
    }

    fn readable(&self) -> Cache<'_> {
        match self {
            Self::F32([keys, values]) => Cache::F32 { keys, values },
            Self::F16([keys, values]) => Cache::F16 { keys, values },
            Self::Int8(both) => {
                let [keys, values] = both
                    .each_ref()
                    .map(|(integers, scales)| Scaled { integers, scales });
                Cache::Int8 { keys, values }
            }
        }
    }

    fn writable(&mut self) -> CacheMut<'_> {
        match self {
            Self::F32([keys, values]) => CacheMut::F32 { keys, values },
            Self::F16([keys, values]) => CacheMut::F16 { keys, values },
            Self::Int8(both) => {
                let [keys, values] = both
                    .each_mut()
                    .map(|(integers, scales)| ScaledMut { integers, scales });
                CacheMut::Int8 { keys, values }
            }
        }
    }

    /// Returns the scales of keys and of values; none of floats.
    fn scales(&self) -> [&[f32]; 2] {
        match self {
            Self::F32(_) | Self::F16(_) => [&[]; 2],
            Self::Int8(both) => both.each_ref().map(|(_, scales)| &scales[..]),
        }
    }

    fn bits(&self) -> [Vec<u32>; 2] {
        match self {
            Self::F32(both) => both
                .each_ref()
                .map(|x| x.iter().map(|x| x.to_bits()).collect()),
            Self::F16(both) => both
                .each_ref()
                .map(|x| x.iter().map(|&x| x.into()).collect()),
            Self::Int8(both) => both
                .each_ref()
                .map(|(x, _)| x.iter().map(|&x| u32::from(x as u8)).collect()),
        }
    }
}

proptest! {
    #[test]
    fn attention_equals_its_twin(
        (heads, head_dim) in (1_usize..5, select(vec![1_usize, 3, 5, 8, 16, 17, 32, 48, 64])),
        (past, tokens) in (0_usize..40, 1_usize..6),
        (queries, gap) in (1_usize..6, 0_usize..7),
        (format, seed) in (select(CacheFormat::ALL.to_vec()), any::<u64>()),
    ) {
        let queries = queries.min(tokens);
        let (width, capacity) = (heads * head_dim, past + tokens + 2);
        let stride = width + gap;
        let new = values(2 * tokens * stride, seed);
        let (new_k, new_v) = new.split_at(tokens * stride);
        // What lies beyond the tokens must not matter.
        let mut values_before = values(capacity * width, seed ^ 2);
        values_before[(past + tokens) * width..].fill(f32::NAN);
        let mut keys_before = vec![f32::NAN; keys_len(capacity, width)];
        for (i, &k) in values(past * width, seed ^ 1).iter().enumerate() {
            keys_before[naive::key(width, i / width, i % width)] = k;
        }
        let before = Stored::new(format, [capacity, heads], keys_before, values_before);
        let append = Append { k: new_k, k_stride: stride, v: new_v, v_stride: stride, width, heads, first: past };
        let mut caches = Isa::all().map(|isa| {
            let mut cache = before.clone();
            append.run(isa, &mut cache.writable());
            cache
        });
        let cache = caches.next().unwrap();
        prop_assert!(caches.all(|other| other.bits() == cache.bits() && other.scales() == cache.scales()));
        let ([keys, rows], [keys_before, rows_before]) = (cache.bits(), before.bits());
        for (row, col) in (0..capacity).flat_map(|row| (0..width).map(move |col| (row, col))) {
            let (key, value) = (naive::key(width, row, col), row * width + col);
            let (head, place) = (col / head_dim, col % head_dim);
            let scale = head * capacity.next_multiple_of(16) + row;
            let (expected, scales) = match row.checked_sub(past).filter(|&token| token < tokens) {
                Some(token) => {
                    let start = token * stride + head * head_dim;
                    let [(keys, of_keys), (values, of_values)] = [new_k, new_v].map(|new| bits(format, &new[start..][..head_dim]));
                    ([keys[place], values[place]], [of_keys, of_values])
                }
                None => ([keys_before[key], rows_before[value]], before.scales().map(|scales| scales.get(scale).copied())),
            };
            prop_assert_eq!(cache.scales().map(|scales| scales.get(scale).copied()), scales);
            prop_assert_eq!([keys[key], rows[value]], expected);
        }
        let q: Vec<f32> = values((queries - 1) * stride + width, seed ^ 3).iter().map(|q| q * 4.0).collect();
        let attention = Attention {
            heads,
            head_dim,
            scale: 1.0 / (head_dim as f32).sqrt(),
            q_stride: stride,
            visible: past + tokens - queries + 1,
            cache: cache.readable(),
        };
        let [y] = on_all(|isa| {
            let mut scratch = vec![f32::NAN; attention_scratch_len(queries, heads, capacity)];
            let mut y = vec![f32::NAN; queries * width];
            attention.run(isa, &q, &mut y, &mut scratch);
            [y]
        });
        let mut expected = vec![0.0; queries * width];
        naive::attention(&attention, &q, &mut expected);
        close_up_to(&y, &expected, 1e-5, &vec![0.0; y.len()]);
    }
}

/// What a format cannot hold must reach the controller, which refuses it, and not become a number.
#[test]
fn a_row_that_is_not_finite_makes_the_attention_to_it_so() {
    let (width, capacity) = (32, 20);
    for format in CacheFormat::ALL {
        for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for (in_key, place) in [(true, 3), (false, 3), (false, 31)] {
                let zeros = || vec![0.0; keys_len(capacity, width)];
                let empty = Stored::new(format, [capacity, 2], zeros(), zeros());
                let [mut k, mut v] = [values(width, 1), values(width, 2)];
                let of = if in_key { &mut k } else { &mut v };
                of[place] = wrong;
                let append = Append {
                    k: &k,
                    k_stride: width,
                    v: &v,
                    v_stride: width,
                    width,
                    heads: 2,
                    first: 0,
                };
                let [y] = on_all(|isa| {
                    let mut cache = empty.clone();
                    append.run(isa, &mut cache.writable());
                    let attention = Attention {
                        heads: 2,
                        head_dim: 16,
                        scale: 0.25,
                        q_stride: width,
                        visible: 1,
                        cache: cache.readable(),
                    };
                    let mut y = vec![0.0; width];
                    attention.run(isa, &values(width, 3), &mut y, &mut [0.0; 64]);
                    [y]
                });
                assert!(!y[place].is_finite(), "{format:?}, {wrong}: {y:?}");
            }
        }
    }
}

#[test]
fn results_have_the_same_bits_everywhere() {
    let (keys, rows) = (values(keys_len(50, 64), 6), values(50 * 64, 4));
    let caches =
        CacheFormat::ALL.map(|format| Stored::new(format, [50, 2], keys.clone(), rows.clone()));
    let results = on_all(|isa| {
        caches.each_ref().map(|cache| {
            let attention = Attention {
                heads: 2,
                head_dim: 32,
                scale: 0.25,
                q_stride: 64,
                visible: 49,
                cache: cache.readable(),
            };
            let mut attended = vec![0.0; 128];
            attention.run(isa, &values(128, 5), &mut attended, &mut [0.0; 256]);
            attended
        })
    });
    let digests = results.map(|x| digest(&x));
    let expected = [
        0x3994_9bd4_e431_7df5,
        0x5976_8726_5e74_d609,
        0xc888_dde9_4bbb_d896,
    ];
    assert_eq!(digests, expected, "{digests:#x?}");
}
