//! Compares the encoder of a small network with `PyTorch`'s embeddings, and tests everything that
//! it refuses.

use std::fs;
use std::path::{Path, PathBuf};

use lads_compiler::contract::{Pooling, Role};
use lads_compiler::{Bundle, Contract, sha256};
use lads_language::{Encoder, LanguageError, default_folder};
use serde::Deserialize;

const TOLERANCE: f32 = 1e-5;

/// A sentence with `PyTorch`'s hidden layers of it; see data/README.md.
#[derive(Deserialize)]
struct Row {
    text: String,
    first: Vec<f32>,
    last: Vec<f32>,
    mean: Vec<f32>,
}

fn tiny() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny-encoder")
}

/// Makes the contract of a bundle whose words the small encoder made.
fn contract(layer: i32, pooling: Pooling, most: usize) -> Contract {
    let path = "../compiler/tests/data/tiny.onnx";
    let bundle = Bundle::open(&Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap();
    let manifest = fs::read_to_string(tiny().join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    let mut contract = bundle.contract().clone();
    let language = contract.language.as_mut().unwrap();
    language.encoder = "tiny-encoder".into();
    language.sha256 = manifest["sha256"].as_str().unwrap().into();
    language.dim = 8;
    language.layer = layer;
    language.pooling = pooling;
    let words = contract.channels.iter_mut();
    let mut words = words.filter(|channel| channel.role == Role::Instruction);
    words.next().unwrap().shape[0] = most;
    contract
}

#[test]
fn a_policy_that_takes_no_instructions_hears_no_sentence() {
    let mut deaf = words();
    deaf.language = None;
    assert!(matches!(
        refusal(&tiny(), &deaf),
        LanguageError::NoInstructions
    ));
    let mut deaf = words();
    deaf.channels
        .retain(|channel| channel.role != Role::Instruction);
    let refused = refusal(&tiny(), &deaf);
    assert!(
        refused.to_string().contains("takes no instructions"),
        "{refused}"
    );
}

fn words() -> Contract {
    contract(-1, Pooling::None, 8)
}

fn close(ours: &[f32], theirs: &[f32]) {
    assert_eq!(ours.len(), theirs.len());
    for (a, b) in ours.iter().zip(theirs) {
        assert!((a - b).abs() <= TOLERANCE, "{a} against {b}");
    }
}

#[test]
fn embeddings_are_pytorchs() {
    let rows = fs::read_to_string(tiny().join("sentences.json")).unwrap();
    let rows: Vec<Row> = serde_json::from_str(&rows).unwrap();
    let open = |layer, pooling| Encoder::open(&tiny(), &contract(layer, pooling, 8)).unwrap();
    let (first, last) = (open(0, Pooling::None), open(-1, Pooling::None));
    let mean = open(0, Pooling::Mean);
    assert_eq!(rows.len(), 3);
    for row in &rows {
        close(&first.words(&row.text).unwrap(), &row.first);
        close(&last.words(&row.text).unwrap(), &row.last);
        close(&mean.words(&row.text).unwrap(), &row.mean);
    }
}

#[test]
fn empty_sentences_are_refused() {
    let encoder = Encoder::open(&tiny(), &words()).unwrap();
    for text in ["", " \t\n", "\u{0}\u{200b}"] {
        let error = encoder.words(text).unwrap_err();
        assert!(matches!(error, LanguageError::Empty(_)), "{error}");
        one_line(&error, &["empty", "give"]);
    }
}

#[test]
fn sentences_that_nobody_hears_to_the_end_are_refused() {
    let encoder = Encoder::open(&tiny(), &words()).unwrap();
    let most = "open ".repeat(7);
    assert_eq!(encoder.words(&most).unwrap().len(), 8 * 8, "with the end");
    let more = "open ".repeat(8);
    let error = encoder.words(&more).unwrap_err();
    one_line(&error, &["9 word pieces", "the policy", "at most 8"]);
    let mean = Encoder::open(&tiny(), &contract(-1, Pooling::Mean, 1)).unwrap();
    assert_eq!(
        mean.words(&more).unwrap().len(),
        8,
        "one word, however long"
    );
    assert_eq!(mean.words(&"open ".repeat(14)).unwrap().len(), 8);
    let error = mean.words(&"open\n".repeat(15)).unwrap_err();
    one_line(
        &error,
        &["17 word pieces", "the language encoder", "at most 16"],
    );
}

#[test]
fn a_missing_encoder_is_refused() {
    for folder in ["no/such/folder", "Cargo.toml"] {
        one_line(
            &refusal(Path::new(folder), &words()),
            &[folder, "tiny-encoder", "lads_exporter"],
        );
    }
}

#[test]
fn another_encoder_is_refused() {
    let mut other = words();
    other.language.as_mut().unwrap().sha256 = "0123456789abcdef".repeat(4);
    let error = refusal(&tiny(), &other);
    one_line(&error, &["tiny-encoder", "51acd264e5af", "0123456789ab"]);
    let mut wide = words();
    wide.language.as_mut().unwrap().dim = 9;
    one_line(&refusal(&tiny(), &wide), &["language.dim", "9", "8"]);
    for layer in [3, -4, i32::MAX, i32::MIN] {
        let error = refusal(&tiny(), &contract(layer, Pooling::None, 8));
        one_line(
            &error,
            &["language.layer", &layer.to_string(), "layers 0 to 2"],
        );
    }
}

#[test]
fn damaged_files_are_refused() {
    let damage = |file: &str, change: &dyn Fn(&mut Vec<u8>), honest: bool| {
        let folder = copy();
        let path = folder.path().join(file);
        let mut bytes = fs::read(&path).unwrap();
        change(&mut bytes);
        fs::write(&path, &bytes).unwrap();
        if honest {
            trust(folder.path(), file, &bytes);
        }
        let error = refusal(folder.path(), &words());
        one_line(&error, &[file, "lads_exporter"]);
        error.to_string()
    };
    for file in ["encoder.onnx", "tokenizer.json"] {
        let flipped = damage(file, &|bytes| bytes[100] ^= 1, false);
        assert!(flipped.contains("sha256"), "{flipped}");
        let cut = damage(file, &|bytes| bytes.truncate(bytes.len() / 2), false);
        assert!(cut.contains("sha256"), "{cut}");
        // Even where the manifest agrees.
        damage(file, &|bytes| bytes.truncate(bytes.len() / 2), true);
        damage(file, &|bytes| bytes.clear(), true);
        damage(file, &|bytes| *bytes = b"something else".to_vec(), true);
    }
    damage("manifest.json", &|bytes| bytes.truncate(40), false);
    let newer = damage(
        "manifest.json",
        &|bytes| replace(bytes, "\"format_version\": 1", "\"format_version\": 7"),
        false,
    );
    assert!(newer.contains("lads-language 7"), "{newer}");
    let folder = copy();
    fs::remove_file(folder.path().join("encoder.onnx")).unwrap();
    one_line(
        &refusal(folder.path(), &words()),
        &["encoder.onnx", "lads_exporter"],
    );
}

#[test]
fn an_encoder_that_contradicts_its_manifest_is_refused() {
    let lies = [
        ("\"layers\": 3", "\"layers\": 4", 1),
        ("\"max_tokens\": 16", "\"max_tokens\": 17", 15),
    ];
    for (from, to, words) in lies {
        let folder = copy();
        let path = folder.path().join("manifest.json");
        let mut bytes = fs::read(&path).unwrap();
        replace(&mut bytes, from, to);
        fs::write(&path, bytes).unwrap();
        let encoder = Encoder::open(folder.path(), &contract(0, Pooling::Mean, 8)).unwrap();
        let error = encoder.words(&"open ".repeat(words)).unwrap_err();
        one_line(&error, &["lads_exporter"]);
    }
}

#[test]
fn names_that_leave_the_cache_are_refused() {
    for name in ["", "..", ".hidden", "a/b", "..\\b", "a\nb", "/etc"] {
        one_line(
            &default_folder(name).unwrap_err(),
            &["export the bundle again"],
        );
    }
    let folder = default_folder("some-encoder").unwrap();
    assert!(
        folder.ends_with("language/some-encoder"),
        "{}",
        folder.display()
    );
}

fn refusal(folder: &Path, contract: &Contract) -> LanguageError {
    let opened = Encoder::open(folder, contract);
    opened.err().expect("a refusal")
}

fn one_line(error: &LanguageError, parts: &[&str]) {
    let line = error.to_string();
    assert!(!line.contains('\n'), "{line}");
    for part in parts {
        assert!(line.contains(part), "'{part}' is not in: {line}");
    }
}

/// Copies the small encoder to a folder of its own.
fn copy() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for file in ["encoder.onnx", "tokenizer.json", "manifest.json"] {
        fs::copy(tiny().join(file), folder.path().join(file)).unwrap();
    }
    folder
}

/// Updates the manifest to match a file.
fn trust(folder: &Path, file: &str, bytes: &[u8]) {
    let path = folder.join("manifest.json");
    let mut manifest: serde_json::Value =
        serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    manifest["files"][file] = sha256(bytes).into();
    fs::write(path, manifest.to_string()).unwrap();
}

fn replace(bytes: &mut Vec<u8>, from: &str, to: &str) {
    let text = String::from_utf8(bytes.clone()).unwrap();
    assert!(text.contains(from), "{text}");
    *bytes = text.replace(from, to).into_bytes();
}
