//! Compares the shipped calibrations of free sentences with the words in the bundles: the runtime
//! repeats the exporter's counts.

use std::collections::BTreeMap;
use std::path::Path;

use lads_compiler::{Bundle, compile};
use lads_core::similarity::{UNLIKE, alignment, nearest};
use lads_core::{KnownInstruction, Policy};
use serde::Deserialize;

/// Part of a `models/NAME.acceptance.json` that is compared here.
#[derive(Deserialize)]
struct Calibration {
    acceptance: Acceptance,
    left_out: Vec<LeftOut>,
}

#[derive(Deserialize)]
struct Acceptance {
    threshold: f32,
}

/// Known instructions of a split that would be accepted if the table had none of their text.
#[derive(Debug, PartialEq, Deserialize)]
struct LeftOut {
    split: String,
    instructions: usize,
    accepted: usize,
}

fn models() -> impl Iterator<Item = (&'static str, Bundle, Calibration)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
    ["kitchen", "kitchen-small", "lorel"]
        .into_iter()
        .map(move |name| {
            let bundle = Bundle::open(&folder.join(format!("{name}.onnx"))).unwrap();
            let json = folder.join(format!("{name}.acceptance.json"));
            let json = std::fs::read_to_string(json).unwrap();
            (name, bundle, serde_json::from_str(&json).unwrap())
        })
}

#[test]
fn the_runtime_accepts_what_the_exporter_counted() {
    for (name, bundle, calibration) in models() {
        let image = compile(&bundle).unwrap();
        let contract = *Policy::new_checked(image.as_bytes()).unwrap().contract();
        let dim = contract.word_dim();
        let mut splits: BTreeMap<&str, (usize, usize)> = BTreeMap::new();
        for (i, known) in contract.instructions().enumerate() {
            let (_, split) = bundle.contract().evaluated(i);
            let others = contract.instructions();
            let others = others.filter(|other| other.text != known.text);
            let (_, alike) = nearest(known.words, others.map(|other| other.words), dim).unwrap();
            let (count, accepted) = splits.entry(split).or_default();
            *count += 1;
            *accepted += usize::from(alike >= calibration.acceptance.threshold);
        }
        assert!(!calibration.left_out.is_empty());
        assert_eq!(splits.len(), calibration.left_out.len(), "{name}");
        for counted in &calibration.left_out {
            let found = splits[counted.split.as_str()];
            assert_eq!(
                found,
                (counted.instructions, counted.accepted),
                "{name}, {}",
                counted.split
            );
        }
    }
}

#[test]
fn known_instructions_are_like_themselves_and_noise_is_like_none() {
    for (name, bundle, calibration) in models() {
        let threshold = calibration.acceptance.threshold;
        let image = compile(&bundle).unwrap();
        let contract = *Policy::new_checked(image.as_bytes()).unwrap().contract();
        let dim = contract.word_dim();
        let like = |words: &[f32]| {
            let known = contract.instructions().map(|known| known.words);
            nearest(words, known, dim).unwrap().1
        };
        for KnownInstruction { text, words, .. } in contract.instructions() {
            assert!((like(words) - 1.0).abs() < 1e-5, "{name}: {text}");
        }
        let noise: Vec<f32> = (0..3 * dim as u64).map(noise).collect();
        assert!(like(&noise) < threshold, "{name}: noise");
        let known = contract.instruction(0).unwrap().words;
        let opposite: Vec<f32> = known.iter().map(|x| -x).collect();
        assert!(like(&opposite) < threshold, "{name}: the opposite");
        assert_eq!(alignment(&known[1..], known, dim), UNLIKE, "{name}");
    }
}

/// Returns number `i` of a fixed stream of numbers between -1 and 1 (splitmix64).
fn noise(i: u64) -> f32 {
    let mut x = (i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x >> 40) as f32 / (1u64 << 23) as f32) - 1.0
}
