//! Counts the instructions of kernels that convert their inputs to integers: whatever the inputs are, they are as many.
//!
//! Each case is this program again, under valgrind, which counts one function of it.
#![cfg(all(target_os = "linux", target_arch = "x86_64"))]

use std::hint::black_box;
use std::process::Command;

use lads_kernels::{
    Activation, ImageIntegers, Isa, Linear, Panels, WeightFormat, pack, packed_len,
};

/// Environment variable that says which case the program is to compute.
const CHILD: &str = "LADS_COUNTED_CASE";
/// Inputs, outputs and rows.
const K: usize = 300;
const N: usize = 20;
const M: usize = 3;

/// Value of an input by its number.
type Value = fn(usize) -> f32;

/// Inputs by what is extreme about them.
const INPUTS: [(&str, Value); 6] = [
    ("ordinary", |i| (i * 31 % 101) as f32 / 50.0 - 1.0),
    ("zero", |_| 0.0),
    ("one part zero", |i| if i < 256 { 0.0 } else { 1.5 }),
    ("not a number", |_| f32::NAN),
    ("infinite", |i| [1.0, f32::INFINITY][i % 2]),
    ("tiny", |i| i as f32 * 1e-36),
];

#[inline(never)]
fn counted_kernels(isa: Isa, x: &[f32]) -> f32 {
    let bias = [0.5; N];
    let scales = [0.01; N];
    let mut y = [0.0; N * M];
    let (mut wide, mut narrow) = (
        vec![0_i16; packed_len(WeightFormat::Int16, [K, N])],
        vec![0_i8; packed_len(WeightFormat::Int8, [K, N])],
    );
    pack(WeightFormat::Int16, &[7; K * N], [K, N], &mut wide);
    pack(WeightFormat::Int8, &[7; K * N], [K, N], &mut narrow);
    let formats = [
        Panels::Int16 {
            panels: &wide,
            scales: &scales,
        },
        Panels::Int8 {
            panels: &narrow,
            scales: &scales,
        },
    ];
    for w in formats {
        let layer = Linear {
            k: K,
            n: N,
            w,
            bias: &bias,
            activation: Activation::None,
            accumulate: false,
        };
        layer.run(isa, x, black_box(&mut y));
    }
    let image = ImageIntegers {
        size: [M, K / 4],
        c: 4,
        x_strides: [K, 4],
    };
    image.run(isa, x, black_box(&mut [0; K * M + 32]))
}

/// Returns the instructions of a case, or `None` without valgrind.
fn count(case: &str) -> Option<u64> {
    let output = Command::new("valgrind")
        .args([
            "--tool=callgrind",
            "--callgrind-out-file=/dev/null",
            "--toggle-collect=*counted_kernels*",
        ])
        .arg(std::env::current_exe().unwrap())
        .args([
            "--exact",
            "inputs_take_the_same_number_of_instructions",
            "--nocapture",
        ])
        .env(CHILD, case)
        .output()
        .ok()?;
    assert!(output.status.success(), "{output:?}");
    let errors = String::from_utf8(output.stderr).unwrap();
    let (_, count) = errors.split_once("Collected : ").expect("what was counted");
    Some(count.lines().next()?.trim().parse().unwrap())
}

#[test]
fn inputs_take_the_same_number_of_instructions() {
    // valgrind has no AVX-512.
    let isas = || Isa::all().filter(|isa| isa.name() != "avx512");
    if let Ok(case) = std::env::var(CHILD) {
        let (isa, inputs) = case.split_once(' ').unwrap();
        let isa = isas().find(|it| it.name() == isa).unwrap();
        let (_, value) = INPUTS.iter().find(|(name, _)| *name == inputs).unwrap();
        let x: Vec<f32> = (0..K * M).map(value).collect();
        black_box(counted_kernels(isa, black_box(&x)));
        return;
    }
    for isa in isas() {
        let mut counts = Vec::new();
        for (name, _) in INPUTS {
            let Some(count) = count(&format!("{} {name}", isa.name())) else {
                println!("skipped: valgrind is not installed");
                return;
            };
            counts.push((name, count));
        }
        println!("{}: {counts:?}", isa.name());
        let (_, ordinary) = counts[0];
        assert!(ordinary > 10_000, "{counts:?}");
        assert!(
            counts.iter().all(|&(_, count)| count == ordinary),
            "{}: {counts:?}",
            isa.name()
        );
    }
}
