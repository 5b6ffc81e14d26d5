//! Compares embeddings with the exporter's: those in the tables of the shipped bundles, and those
//! of sentences in no table.
//!
//! `tests/parity/test_language_parity.py` exports the encoder and names its folder in `LADS_LANGUAGE`, where `cases.json` has the sentences;
//! without it there is nothing to compare with, so the test is an ignored one.

use std::path::{Path, PathBuf};

use lads_compiler::{Bundle, compile};
use lads_core::{Policy, similarity};
use lads_language::Encoder;

const VARIABLE: &str = "LADS_LANGUAGE";
const TOLERANCE: f32 = 1e-4;

/// A sentence with the exporter's results for one bundle.
#[derive(serde::Deserialize)]
struct Case {
    bundle: String,
    text: String,
    words: Vec<f32>,
    /// Id of the known instruction that the sentence is most similar to.
    nearest: String,
    /// Similarity of the sentence to that instruction.
    similarity: f32,
}

fn difference(ours: &[f32], theirs: &[f32]) -> f32 {
    assert_eq!(ours.len(), theirs.len());
    let pairs = ours.iter().zip(theirs);
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
#[ignore = "needs the encoder that tests/parity/test_language_parity.py exports, in LADS_LANGUAGE"]
fn embeddings_are_the_exporters() {
    let folder = std::env::var_os(VARIABLE).map(PathBuf::from);
    let folder = folder.unwrap_or_else(|| {
        panic!("{VARIABLE} names no folder; run tests/parity/test_language_parity.py")
    });
    let cases = std::fs::read_to_string(folder.join("cases.json")).unwrap();
    let cases: Vec<Case> = serde_json::from_str(&cases).unwrap();
    for name in ["kitchen", "lorel"] {
        let path = format!("{}/../../models/{name}.onnx", env!("CARGO_MANIFEST_DIR"));
        let bundle = Bundle::open(Path::new(&path)).unwrap();
        let image = compile(&bundle).unwrap();
        let contract = *Policy::new_checked(image.as_bytes()).unwrap().contract();
        let encoder = Encoder::open(&folder, bundle.contract()).unwrap();
        let (mut compared, mut worst) = (0, 0.0_f32);
        for known in contract.instructions() {
            worst = worst.max(difference(&encoder.words(known.text).unwrap(), known.words));
            compared += 1;
        }
        for case in cases.iter().filter(|case| case.bundle == name) {
            let words = encoder.words(&case.text).unwrap();
            worst = worst.max(difference(&words, &case.words));
            let known = contract.instructions().map(|known| known.words);
            let (place, alike) = similarity::nearest(&words, known, contract.word_dim()).unwrap();
            assert!((alike - case.similarity).abs() <= TOLERANCE, "{alike}");
            // Several known instructions may be equally like it.
            let named = contract
                .instructions()
                .find(|known| known.id == case.nearest);
            let named = similarity::alignment(&words, named.unwrap().words, contract.word_dim());
            assert!((alike - named).abs() <= TOLERANCE, "{}: {place}", case.text);
            compared += 1;
        }
        println!("{name}: {compared} sentences, largest difference {worst:.1e}");
        assert!(worst <= TOLERANCE, "{name}: {worst}");
        assert!(compared > contract.instruction_count(), "no free sentence");
    }
}
