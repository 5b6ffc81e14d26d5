//! Compares every kernel with its naive twin, on random shapes and values, and bit for bit on every
//! instruction set that the CPU offers.

mod support;

use lads_kernels::reference as naive;
use lads_kernels::{
    Activation, Append, Attention, Axis, BinaryKind, Cache, CacheFormat, CacheMut, Input, Isa,
    LayerNorm, Linear, MatMul, Panels, ReduceKind, Scaled, ScaledMut, StridedCopy, Unary,
    UnaryKind, WeightFormat, arg_max, arg_min, attention_scratch_len, binary, keys_len, pack,
    packed_len, reduce, softmax, stored,
};
use proptest::prelude::*;
use proptest::sample::select;
use support::{close_up_to, digest, on_all, values};

const UNARY: [UnaryKind; 17] = [
    UnaryKind::Relu,
    UnaryKind::LeakyRelu,
    UnaryKind::Tanh,
    UnaryKind::Sigmoid,
    UnaryKind::Exp,
    UnaryKind::Log,
    UnaryKind::Sqrt,
    UnaryKind::Rsqrt,
    UnaryKind::Neg,
    UnaryKind::Abs,
    UnaryKind::Recip,
    UnaryKind::Erf,
    UnaryKind::Square,
    UnaryKind::Elu,
    UnaryKind::Softplus,
    UnaryKind::Mish,
    UnaryKind::Trunc,
];

const BINARY: [BinaryKind; 9] = [
    BinaryKind::Add,
    BinaryKind::Sub,
    BinaryKind::Mul,
    BinaryKind::Div,
    BinaryKind::Max,
    BinaryKind::Min,
    BinaryKind::Pow,
    BinaryKind::Greater,
    BinaryKind::Keep,
];

const REDUCE: [ReduceKind; 5] = [
    ReduceKind::Sum,
    ReduceKind::Mean,
    ReduceKind::Max,
    ReduceKind::Min,
    ReduceKind::Prod,
];

/// Asserts equality up to `bound` times the expected magnitude, at least 1.
#[track_caller]
fn close(got: &[f32], expected: &[f32], bound: f32) {
    close_up_to(got, expected, bound, &vec![0.0; got.len()]);
}

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
    fn layer_norm_equals_its_twin(rows in 1_usize..4, cols in 1_usize..150, seed in any::<u64>()) {
        let (x, gamma, beta) = (values(rows * cols, seed), values(cols, seed ^ 1), values(cols, seed ^ 2));
        let norm = LayerNorm { gamma: &gamma, beta: &beta, eps: 1e-5 };
        let [y] = on_all(|isa| {
            let mut y = vec![0.0; rows * cols];
            norm.run(isa, &x, &mut y);
            [y]
        });
        let mut expected = vec![0.0; rows * cols];
        naive::layer_norm(&x, &gamma, &beta, 1e-5, &mut expected);
        // A single column, or two that are nearly equal, are all cancellation.
        close(&y, &expected, if cols < 4 { 1e-2 } else { 1e-5 });
    }

    #[test]
    fn softmax_equals_its_twin(
        rows in 1_usize..4,
        cols in 1_usize..150,
        scale in select(vec![1.0_f32, 30.0, 1e4]),
        seed in any::<u64>(),
    ) {
        let x: Vec<f32> = values(rows * cols, seed).iter().map(|x| x * scale).collect();
        let [y] = on_all(|isa| {
            let mut y = vec![0.0; rows * cols];
            softmax(isa, &x, cols, &mut y);
            [y]
        });
        let mut expected = vec![0.0; rows * cols];
        naive::softmax(&x, cols, &mut expected);
        close(&y, &expected, 1e-6);
        for row in y.chunks(cols) {
            prop_assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

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
        close(&y, &expected, 1e-5);
    }

    #[test]
    fn unary_equals_its_twin(kind in select(UNARY.to_vec()), len in 1_usize..40, seed in any::<u64>()) {
        let x: Vec<f32> = values(len, seed).iter().map(|x| x * 8.0).collect();
        let expected: Vec<f32> = x.iter().map(|&x| naive::unary(kind, 0.2, x)).collect();
        let unary = Unary { kind, alpha: 0.2 };
        let [y, in_place] = on_all(|isa| {
            let (mut y, mut in_place) = (vec![0.0; len], x.clone());
            unary.run(isa, &x, &mut y);
            unary.run_in_place(isa, &mut in_place);
            [y, in_place]
        });
        close(&y, &expected, 1e-6);
        close(&in_place, &y, 0.0);
    }

    #[test]
    fn binary_equals_its_twin(
        kind in select(BINARY.to_vec()),
        dims in prop::array::uniform4(1_usize..5),
        (a_keeps, b_keeps) in any::<([bool; 4], [bool; 4])>(),
        gap in 1_usize..3,
        seed in any::<u64>(),
    ) {
        let len = dims.iter().product();
        let (a_strides, b_strides) = (strides(dims, a_keeps, gap), strides(dims, b_keeps, 1));
        let (a, b) = (values(len * gap, seed), values(len, seed ^ 1));
        let at = |x: &[f32], strides, i| x[naive::offset(dims, strides, i)];
        let expected = |a: &dyn Fn(usize) -> f32, b: &dyn Fn(usize) -> f32| {
            (0..len).map(|i| naive::binary(kind, a(i), b(i))).collect::<Vec<_>>()
        };
        let run = |a: Input, b: Input, before: &[f32]| {
            let mut y = before.to_vec();
            binary(kind, a, b, dims, &mut y);
            y
        };
        let old = values(len, seed ^ 2);
        let (left, right) = (Input::Strided(&a, a_strides), Input::Strided(&b, b_strides));
        let (a, b) = (|i| at(&a, a_strides, i), |i| at(&b, b_strides, i));
        let own = |i: usize| old[i];
        close(&run(left, right, &old), &expected(&a, &b), 2e-6);
        close(&run(Input::Output, right, &old), &expected(&own, &b), 2e-6);
        close(&run(left, Input::Output, &old), &expected(&a, &own), 2e-6);
        close(&run(Input::Output, Input::Output, &old), &expected(&own, &own), 2e-6);
    }

    #[test]
    fn copy_equals_its_twin(
        dims in prop::array::uniform4(1_usize..5),
        x_keeps in any::<[bool; 4]>(),
        order in Just([0_usize, 1, 2, 3]).prop_shuffle(),
        gap in 1_usize..4,
        seed in any::<u64>(),
    ) {
        // A permutation of the dimensions with gaps: a transposition into a larger tensor.
        let mut y_strides = [0; 4];
        let mut stride = gap;
        for i in order {
            y_strides[i] = stride;
            stride *= dims[i];
        }
        let copy = StridedCopy { dims, x_strides: strides(dims, x_keeps, 2), y_strides };
        let x = values(2 * dims.iter().product::<usize>(), seed);
        let mut y = values(stride, seed ^ 1);
        let mut expected = y.clone();
        copy.run(&x, &mut y);
        naive::copy(&copy, &x, &mut expected);
        prop_assert_eq!(y, expected);
    }

    #[test]
    fn reduce_equals_its_twin(
        kind in select(REDUCE.to_vec()),
        (outer, len, inner) in (1_usize..4, 1_usize..50, 1_usize..6),
        seed in any::<u64>(),
    ) {
        let x = values(outer * len * inner, seed);
        let axis = Axis { len, inner };
        let (mut y, mut expected) = (vec![f32::NAN; outer * inner], vec![0.0; outer * inner]);
        reduce(kind, &x, axis, &mut y);
        naive::reduce(kind, &x, axis, &mut expected);
        close(&y, &expected, 1e-5);
    }

    #[test]
    fn matmul_equals_its_twin(
        (batch, m, k, n) in (1_usize..4, 1_usize..5, 1_usize..20, 1_usize..20),
        (a_transposed, b_transposed, broadcast) in any::<(bool, bool, bool)>(),
        seed in any::<u64>(),
    ) {
        let product = MatMul {
            batch,
            m,
            k,
            n,
            a_strides: if a_transposed { [m * k, 1, m] } else { [m * k, k, 1] },
            b_strides: match (b_transposed, broadcast) {
                (true, _) => [k * n, 1, k],
                (false, true) => [0, n, 1],
                (false, false) => [k * n, n, 1],
            },
        };
        let (a, b) = (values(batch * m * k, seed), values(batch * k * n, seed ^ 1));
        let (mut y, mut expected) = (vec![f32::NAN; batch * m * n], vec![0.0; batch * m * n]);
        product.run(&a, &b, &mut y);
        naive::matmul(&product, &a, &b, &mut expected);
        close(&y, &expected, 1e-5);
    }

    #[test]
    fn the_best_element_is_the_first_of_equal_ones(x in prop::collection::vec(-3_i8..4, 1..40)) {
        let x: Vec<f32> = x.into_iter().map(f32::from).collect();
        let first = |best: f32| x.iter().position(|&x| x == best);
        prop_assert_eq!(Some(arg_max(&x)), first(x.iter().copied().fold(f32::MIN, f32::max)));
        prop_assert_eq!(Some(arg_min(&x)), first(x.iter().copied().fold(f32::MAX, f32::min)));
    }
}

/// Returns the strides of a contiguous layout with `gap` between elements, 0 in the dimensions that
/// are not kept.
fn strides(dims: [usize; 4], keeps: [bool; 4], gap: usize) -> [usize; 4] {
    let mut strides = [0; 4];
    let mut stride = gap;
    for i in (0..4).rev() {
        if keeps[i] {
            strides[i] = stride;
            stride *= dims[i];
        }
    }
    strides
}

/// Covers floats of all magnitudes: subnormal, infinite, NaN, and where `exp` and `tanh` change
/// their formulas.
#[test]
fn extreme_elements_are_the_same_on_every_instruction_set() {
    let x: Vec<f32> = (0..=u32::MAX).step_by(65521).map(f32::from_bits).collect();
    for kind in UNARY {
        let unary = Unary { kind, alpha: 0.2 };
        on_all(|isa| {
            let mut y = vec![0.0; x.len()];
            unary.run(isa, &x, &mut y);
            [y]
        });
    }
    // Rows with elements that are not a number, infinite, or too large to be added up.
    let gamma = vec![1.0; 61];
    let norm = LayerNorm {
        gamma: &gamma,
        beta: &gamma,
        eps: 1e-5,
    };
    on_all(|isa| {
        let [mut p, mut y] = [(); 2].map(|()| vec![0.0; x.len()]);
        softmax(isa, &x, 61, &mut p);
        norm.run(isa, &x, &mut y);
        [p, y]
    });
}

#[test]
fn what_is_not_a_number_is_passed_over_by_the_best_element() {
    assert_eq!(arg_max(&[f32::NAN, 1.0, 2.0, f32::NAN]), 2);
    assert_eq!(arg_min(&[f32::NAN, 1.0, 2.0]), 1);
    assert_eq!((arg_max(&[f32::NAN]), arg_max(&[])), (0, 0));
}

/// Pins result bits that must never change, on any target or at any optimisation level.
#[test]
fn results_have_the_same_bits_everywhere() {
    let (k, n) = (128, 40);
    let mut packed = vec![0.0; packed_len(WeightFormat::F32, [k, n])];
    let w = values(k * n, 1);
    pack(WeightFormat::F32, &w, [k, n], &mut packed);
    let bias = values(n, 2);
    let layer = Linear {
        k,
        n,
        w: Panels::F32(&packed),
        bias: &bias,
        activation: Activation::Tanh,
        accumulate: false,
    };
    let norm = LayerNorm {
        gamma: &bias,
        beta: &bias,
        eps: 1e-5,
    };
    let (keys, cache) = (values(keys_len(50, 64), 6), values(50 * 64, 4));
    let caches =
        CacheFormat::ALL.map(|format| Stored::new(format, [50, 2], keys.clone(), cache.clone()));
    let attentions = caches.each_ref().map(|cache| Attention {
        heads: 2,
        head_dim: 32,
        scale: 0.25,
        q_stride: 64,
        visible: 49,
        cache: cache.readable(),
    });
    let results = on_all(|isa| {
        let [mut y, mut z, mut p] = [(); 3].map(|()| vec![0.0; 3 * n]);
        layer.run(isa, &values(3 * k, 3), &mut y);
        norm.run(isa, &y, &mut z);
        softmax(isa, &z, n, &mut p);
        let [attended, halves, integers] = attentions.map(|attention| {
            let mut attended = vec![0.0; 128];
            attention.run(isa, &values(128, 5), &mut attended, &mut [0.0; 256]);
            attended
        });
        [y, z, p, attended, halves, integers]
    });
    let digests = results.map(|x| digest(&x));
    let expected = [
        0x05e1_b773_fda2_c929,
        0xddf6_4acd_014e_4f1e,
        0x370e_3ea7_0ba2_cda6,
        0x3994_9bd4_e431_7df5,
        0x5976_8726_5e74_d609,
        0xc888_dde9_4bbb_d896,
    ];
    assert_eq!(digests, expected, "{digests:#x?}");
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
