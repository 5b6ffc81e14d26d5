//! Compares every kernel with its naive twin, on random shapes and values, and bit for bit on every
//! instruction set that the CPU offers.

mod support;

use lads_kernels::reference as naive;
use lads_kernels::{
    Activation, Axis, BinaryKind, Input, LayerNorm, Linear, MatMul, Panels, ReduceKind,
    StridedCopy, Unary, UnaryKind, WeightFormat, arg_max, arg_min, binary, pack, packed_len,
    reduce, softmax,
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
    let results = on_all(|isa| {
        let [mut y, mut z, mut p] = [(); 3].map(|()| vec![0.0; 3 * n]);
        layer.run(isa, &values(3 * k, 3), &mut y);
        norm.run(isa, &y, &mut z);
        softmax(isa, &z, n, &mut p);
        [y, z, p]
    });
    let digests = results.map(|x| digest(&x));
    let expected = [
        0x05e1_b773_fda2_c929,
        0xddf6_4acd_014e_4f1e,
        0x370e_3ea7_0ba2_cda6,
    ];
    assert_eq!(digests, expected, "{digests:#x?}");
}
