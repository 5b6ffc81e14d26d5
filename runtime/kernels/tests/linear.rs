//! Compares dense layers in every format with their naive twin, on random shapes and values, and
//! bit for bit on every instruction set.

mod support;

use lads_kernels::reference as naive;
use lads_kernels::{Activation, Isa, Linear, Panels, WeightFormat, pack, packed_len, stored};
use proptest::prelude::*;
use proptest::sample::select;
use support::{close_up_to, digest, on_all, values};

/// A matrix in a storage format, and the numbers that it then decodes to.
struct Matrix {
    format: WeightFormat,
    singles: Vec<f32>,
    halves: Vec<u16>,
    bytes: Vec<i8>,
    integers: Vec<i16>,
    scales: Vec<f32>,
    meant: Vec<f32>,
}

impl Matrix {
    fn new(w: &[f32], [k, n]: [usize; 2], format: WeightFormat) -> Self {
        fn packed<T: Copy + Default>(format: WeightFormat, w: &[T], dims: [usize; 2]) -> Vec<T> {
            let mut out = vec![T::default(); packed_len(format, dims)];
            pack(format, w, dims, &mut out);
            out
        }
        let scale = |j: usize| {
            let column = w.iter().skip(j).step_by(n).copied();
            match format {
                WeightFormat::Int16 => stored::int16_scale(column),
                _ => stored::int8_scale(column),
            }
        };
        let scales: Vec<f32> = (0..n).map(scale).collect();
        let bits: Vec<u16> = match format {
            WeightFormat::F16 => w.iter().map(|&w| stored::to_f16(w).unwrap()).collect(),
            _ => w.iter().map(|&w| stored::to_bf16(w).unwrap()).collect(),
        };
        let scaled = || w.iter().enumerate().map(|(i, &w)| (w, scales[i % n]));
        let bytes: Vec<i8> = scaled()
            .map(|(w, scale)| stored::to_int8(w, scale))
            .collect();
        let integers: Vec<i16> = scaled()
            .map(|(w, scale)| stored::to_int16(w, scale))
            .collect();
        let meant = match format {
            WeightFormat::F32 => w.to_vec(),
            WeightFormat::F16 => bits.iter().map(|&bits| stored::from_f16(bits)).collect(),
            WeightFormat::Bf16 => bits.iter().map(|&bits| stored::from_bf16(bits)).collect(),
            WeightFormat::Int8 => (bytes.iter().enumerate())
                .map(|(i, &q)| f32::from(q) * scales[i % n])
                .collect(),
            WeightFormat::Int16 => (integers.iter().enumerate())
                .map(|(i, &q)| f32::from(q) * scales[i % n])
                .collect(),
        };
        Self {
            format,
            // Those of other formats are not read.
            singles: packed(format, w, [k, n]),
            halves: packed(format, &bits, [k, n]),
            bytes: packed(format, &bytes, [k, n]),
            integers: packed(format, &integers, [k, n]),
            scales,
            meant,
        }
    }

    fn panels(&self) -> Panels<'_> {
        match self.format {
            WeightFormat::F32 => Panels::F32(&self.singles),
            WeightFormat::F16 => Panels::F16(&self.halves),
            WeightFormat::Bf16 => Panels::Bf16(&self.halves),
            WeightFormat::Int8 => Panels::Int8 {
                panels: &self.bytes,
                scales: &self.scales,
            },
            WeightFormat::Int16 => Panels::Int16 {
                panels: &self.integers,
                scales: &self.scales,
            },
        }
    }

    /// Returns how much rounding the inputs may change each result, as the module `stored` states
    /// it.
    fn input_error(&self, x: &[f32], [k, n]: [usize; 2]) -> Vec<f32> {
        let errors = |row: usize, col: usize| {
            (0..k).map(move |l| {
                let part = &x[row * k..][..k].chunks(256).nth(l / 256).unwrap();
                let largest = part.iter().fold(0.0_f32, |largest, x| largest.max(x.abs()));
                // A little more than half a unit, because the quotient is rounded too.
                self.meant[l * n + col].abs() * largest / 16382.0 * 1.01
            })
        };
        let rows = x.len() / k;
        if self.format.is_scaled() {
            (0..rows * n).map(|i| errors(i / n, i % n).sum()).collect()
        } else {
            vec![0.0; rows * n]
        }
    }
}

fn activation() -> impl Strategy<Value = Activation> {
    let all = [
        Activation::None,
        Activation::Relu,
        Activation::LeakyRelu(0.2),
        Activation::Clipped(0.5),
        Activation::Tanh,
        Activation::Sigmoid,
        Activation::Elu(0.8),
        Activation::Softplus,
        Activation::Mish,
    ];
    select(all.to_vec())
}

proptest! {
    #[test]
    fn linear_equals_its_twin(
        (m, k, n) in (1_usize..6, prop_oneof![9 => 1_usize..70, 1 => 240_usize..600], 1_usize..180),
        (format, activation) in (select(WeightFormat::ALL.to_vec()), activation()),
        (with_bias, accumulate) in any::<(bool, bool)>(),
        seed in any::<u64>(),
    ) {
        let (x, w) = (values(m * k, seed), values(k * n, seed ^ 1));
        let bias = if with_bias { values(n, seed ^ 2) } else { Vec::new() };
        let before = values(m * n, seed ^ 3);
        let matrix = Matrix::new(&w, [k, n], format);
        let layer = Linear { k, n, w: matrix.panels(), bias: &bias, activation, accumulate };
        let [y] = on_all(|isa| {
            let mut y = before.clone();
            layer.run(isa, &x, &mut y);
            [y]
        });
        let mut expected = vec![0.0; m * n];
        naive::linear(&x, &matrix.meant, &bias, activation, [k, n], &mut expected);
        if accumulate {
            expected.iter_mut().zip(&before).for_each(|(y, before)| *y += before);
        }
        let rounding = 1.5e-7 * k.max(70) as f32;
        close_up_to(&y, &expected, rounding, &matrix.input_error(&x, [k, n]));
        // Each row alone gives the same bits as the rows together.
        for (row, x) in x.chunks(k).enumerate() {
            let mut alone = before[row * n..(row + 1) * n].to_vec();
            layer.run(Isa::detect(), x, &mut alone);
            prop_assert_eq!(&alone, &y[row * n..(row + 1) * n]);
        }
    }
}

#[test]
fn weights_are_packed_in_panels_of_sixty_four_outputs() {
    // [k, n] = [2, 82]: a whole panel, and one of thirty-two of which eighteen are used.
    let w: Vec<f32> = (1..=164_u8).map(f32::from).collect();
    let mut packed = vec![f32::NAN; packed_len(WeightFormat::F32, [2, 82])];
    pack(WeightFormat::F32, &w, [2, 82], &mut packed);
    assert_eq!(packed.len(), 2 * 96);
    assert_eq!(packed[..64], w[..64]);
    assert_eq!(packed[64..128], w[82..146]);
    assert_eq!(packed[128..146], w[64..82]);
    assert_eq!(packed[160..178], w[146..]);
    let padding = packed[146..160].iter().chain(&packed[178..]);
    assert!(padding.into_iter().all(|&w| w == 0.0));
}

#[test]
fn integers_have_the_same_bits_everywhere() {
    let (k, n) = (300, 40);
    let digests = [WeightFormat::Int16, WeightFormat::Int8].map(|format| {
        let matrix = Matrix::new(&values(k * n, 1), [k, n], format);
        let layer = Linear {
            k,
            n,
            w: matrix.panels(),
            bias: &values(n, 2),
            activation: Activation::Tanh,
            accumulate: false,
        };
        let [y] = on_all(|isa| {
            let mut y = vec![0.0; 3 * n];
            layer.run(isa, &values(3 * k, 3), &mut y);
            [y]
        });
        digest(&y)
    });
    let expected = [0x90dd_729a_0462_d716, 0x376a_d0c3_e528_60bf];
    assert_eq!(digests, expected, "{digests:#x?}");
}
