//! Measures the kernels of a control step against the least that their bytes can cost: a bare sweep over as much memory, in the same group.

use std::hint::black_box;

use bytemuck::Pod;
use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, Throughput, criterion_group, criterion_main};
use lads_benches::sweep::Sweep;
use lads_host::Aligned;
use lads_kernels::stored::{round_to_f16, to_f16, to_int16};
use lads_kernels::{
    Activation, Attention, Cache, CacheFormat, Isa, LayerNorm, Linear, Panels, Scaled,
    WeightFormat, attention_scratch_len, keys_len, pack, packed_len,
};

/// Returns `count` elements that are neither zero nor all the same.
fn numbers(count: usize) -> Vec<f32> {
    (0..count)
        .map(|i| ((i * 37 % 101) as f32 - 50.0) / 50.0)
        .collect()
}

/// Measures a bare sweep over `bytes` in the group, after the group's kernel was measured.
fn roofline(group: &mut BenchmarkGroup<'_, WallTime>, bytes: usize) {
    let sweep = Sweep::new(bytes);
    group.bench_function("sweep", |bencher| bencher.iter(|| sweep.read()));
}

/// Packs a matrix in panels, as an image stores it.
fn packed<T: Pod + Default>(format: WeightFormat, w: &[T], dims: [usize; 2]) -> Aligned {
    let mut panels = vec![T::default(); packed_len(format, dims)];
    pack(format, w, dims, &mut panels);
    Aligned::new(bytemuck::cast_slice(&panels))
}

/// Measures one dense layer, in 32 and in 16 bits, for one row and for the two tokens of a control step.
fn linear(criterion: &mut Criterion) {
    let isa = Isa::detect();
    for (k, n) in [(128, 128), (128, 384), (512, 128)] {
        let dense = numbers(k * n);
        let w = packed(WeightFormat::F32, &dense, [k, n]);
        let half: Vec<u16> = dense.iter().map(|&x| to_f16(x).unwrap_or(0)).collect();
        let half = packed(WeightFormat::F16, &half, [k, n]);
        let scale = 1.0 / 16383.0;
        let whole: Vec<i16> = dense.iter().map(|&x| to_int16(x, scale)).collect();
        let whole = packed(WeightFormat::Int16, &whole, [k, n]);
        let scales = vec![scale; n];
        let bias = numbers(n);
        for rows in [1, 2] {
            let (x, mut y) = (numbers(rows * k), vec![0.0; rows * n]);
            let integers = Panels::Int16 {
                panels: bytemuck::cast_slice(whole.as_bytes()),
                scales: &scales,
            };
            let stored = [
                ("f32", Panels::F32(bytemuck::cast_slice(w.as_bytes())), &w),
                ("int16", integers, &whole),
                (
                    "f16",
                    Panels::F16(bytemuck::cast_slice(half.as_bytes())),
                    &half,
                ),
            ];
            for (name, panels, memory) in stored {
                let layer = Linear {
                    k,
                    n,
                    w: panels,
                    bias: &bias,
                    activation: Activation::Relu,
                    accumulate: false,
                };
                let mut group =
                    criterion.benchmark_group(format!("linear/{k}x{n} {name}, {rows} rows"));
                let bytes = memory.as_bytes().len();
                group.throughput(Throughput::Bytes(bytes as u64));
                group.bench_function("kernel", |bencher| {
                    bencher.iter(|| layer.run(isa, black_box(&x), &mut y));
                });
                roofline(&mut group, bytes);
                group.finish();
            }
        }
    }
}

/// Measures attention of two tokens after three hundred, four heads of 32.
fn attention(criterion: &mut Criterion) {
    let isa = Isa::detect();
    let (heads, head_dim, visible) = (4, 32, 301);
    let (width, capacity) = (heads * head_dim, 584);
    let (keys, values) = (
        numbers(keys_len(capacity, width)),
        numbers(capacity * width),
    );
    let halves = |x: &[f32]| -> Vec<u16> { x.iter().map(|&x| round_to_f16(x)).collect() };
    let [half_keys, half_values] = [halves(&keys), halves(&values)];
    let integers = |x: &[f32]| -> Vec<i8> { x.iter().map(|&x| (x * 127.0) as i8).collect() };
    let [key_integers, value_integers] = [integers(&keys), integers(&values)];
    let scales = numbers(CacheFormat::Int8.scales(capacity, heads));
    let scaled = |integers| Scaled {
        integers,
        scales: &scales,
    };
    let caches = [
        Cache::F32 {
            keys: &keys,
            values: &values,
        },
        Cache::F16 {
            keys: &half_keys,
            values: &half_values,
        },
        Cache::Int8 {
            keys: scaled(&key_integers),
            values: scaled(&value_integers),
        },
    ];
    for (format, cache) in CacheFormat::ALL.into_iter().zip(caches) {
        let attention = Attention {
            heads,
            head_dim,
            scale: 0.2,
            q_stride: width,
            visible,
            cache,
        };
        let (q, mut y) = (numbers(2 * width), vec![0.0; 2 * width]);
        let mut scratch = vec![0.0; attention_scratch_len(2, heads, capacity)];
        let bytes = 2 * visible * width * format.bytes();
        let name = format.name();
        let mut group =
            criterion.benchmark_group(format!("attention/2 on 300, 4 heads of 32, {name}"));
        group.throughput(Throughput::Bytes(bytes as u64));
        group.bench_function("kernel", |bencher| {
            bencher.iter(|| attention.run(isa, black_box(&q), &mut y, &mut scratch));
        });
        roofline(&mut group, bytes);
        group.finish();
    }
}

fn layer_norm(criterion: &mut Criterion) {
    let isa = Isa::detect();
    let (scale, bias) = (numbers(128), numbers(128));
    let norm = LayerNorm {
        gamma: &scale,
        beta: &bias,
        eps: 1e-5,
    };
    let (x, mut y) = (numbers(256), vec![0.0; 256]);
    criterion.bench_function("layer norm/2 rows of 128", |bencher| {
        bencher.iter(|| norm.run(isa, black_box(&x), &mut y));
    });
}

criterion_group!(benches, linear, attention, layer_norm);
criterion_main!(benches);
