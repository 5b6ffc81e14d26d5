use lads_core::Policy;
use lads_image::op::{CacheFormat, WeightFormat};

use super::{Evidence, Storage, Tuned};
use crate::{Bundle, BundleError, CompileError, Options, compile, compile_with};

const TINY: &[u8] = include_bytes!("../../tests/data/tiny.onnx");

fn evidence() -> Evidence {
    Evidence {
        decisions: 12,
        smallest_margin: Some(0.25),
        ..Evidence::default()
    }
}

fn tuned(storage: Storage) -> Vec<u8> {
    Tuned::new(storage, evidence()).written_into(TINY).unwrap()
}

fn small() -> Storage {
    Storage::of_weights(WeightFormat::F16)
        .with_part("low_level/act", WeightFormat::F32)
        .with_cache(CacheFormat::F16)
}

#[test]
fn a_tuned_bundle_is_compiled_as_it_was_tuned() {
    let bundle = Bundle::from_bytes(&tuned(small())).unwrap();
    let found = bundle.tuned().unwrap().unwrap();
    assert_eq!((&found.storage, &found.evidence), (&small(), &evidence()));
    let by_itself = compile(&bundle).unwrap();
    let as_asked = Options {
        storage: Some(small()),
        ..Options::default()
    };
    let asked = compile_with(&bundle, &as_asked).unwrap();
    assert_eq!(by_itself.as_bytes(), asked.as_bytes());
    let exact = compile_with(&bundle, &Options::exact()).unwrap();
    assert!(by_itself.as_bytes().len() < exact.as_bytes().len());
}

#[test]
fn a_record_replaces_the_one_before_and_nothing_else() {
    let first = tuned(Storage::of_weights(WeightFormat::Int8));
    let second = Tuned::new(small(), evidence()).written_into(&first);
    assert_eq!(second.unwrap(), tuned(small()));
    // All other bytes are the file's.
    assert!(first.starts_with(TINY));
    let [plain, bundle] = [TINY, &first].map(|bytes| Bundle::from_bytes(bytes).unwrap());
    assert_eq!(bundle.untuned_sha256(), plain.sha256());
    assert_eq!(plain.untuned_sha256(), plain.sha256());
    assert_ne!(bundle.sha256(), plain.sha256());
}

#[test]
fn one_layer_may_keep_its_bits() {
    let bundle = Bundle::from_bytes(TINY).unwrap();
    let all = Options {
        storage: Some(small()),
        ..Options::default()
    };
    let image = compile_with(&bundle, &all).unwrap();
    let program = |image: &crate::Image| {
        let programs = image.report().programs.iter();
        let mut found = programs.filter(|program| program.entry == "high_level/step");
        found.next().unwrap().layers.clone()
    };
    let layers = program(&image);
    assert!(layers.len() > 2 && layers.iter().all(|layer| layer.format == WeightFormat::F16));
    let node = &layers[1].node;
    let but_one = Options {
        storage: Some(small().with_part(node, WeightFormat::F32)),
        ..Options::default()
    };
    let image = compile_with(&bundle, &but_one).unwrap();
    for layer in program(&image) {
        let wanted = if layer.node == *node {
            WeightFormat::F32
        } else {
            WeightFormat::F16
        };
        assert_eq!(layer.format, wanted, "{}", layer.node);
    }
    assert!(Policy::new_checked(image.as_bytes()).is_ok());
}

#[test]
fn parts_that_are_not_there_are_named_all_at_once() {
    let bundle = Bundle::from_bytes(TINY).unwrap();
    let wrong = Options {
        storage: Some(
            small()
                .with_part("low_level/dance", WeightFormat::F32)
                .with_part("MatMul_999", WeightFormat::F32),
        ),
        ..Options::default()
    };
    let refused = compile_with(&bundle, &wrong).unwrap_err();
    assert!(matches!(refused, CompileError::UnknownParts { .. }));
    let text = refused.to_string();
    assert!(
        text.contains("MatMul_999, low_level/dance") && text.lines().count() == 1,
        "{text}"
    );
}

#[test]
fn records_that_do_not_read_are_refused_by_name() {
    let sound = String::from_utf8_lossy(&tuned(small())).into_owned();
    assert!(sound.contains(r#"{"version":1,"storage":{"weights":"f16""#));
    let altered = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let bytes = tuned(small());
        let at = bytes
            .windows(from.len())
            .rposition(|window| window == from.as_bytes())
            .unwrap();
        let mut bytes = bytes.clone();
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        // The bundle opens, so that it can be tuned again, and compiles where the record is not followed.
        let bundle = Bundle::from_bytes(&bytes).unwrap();
        assert!(compile_with(&bundle, &Options::exact()).is_ok());
        compile(&bundle).unwrap_err()
    };
    for (from, to, part) in [
        (r#""version":1"#, r#""version":9"#, "version 9"),
        // A later version may have other fields.
        (r#"1,"storage""#, r#"2,"storaje""#, "version 2"),
        (r#""weights":"f16""#, r#""weights":"f61""#, "f61"),
        (r#""cache":"f16""#, r#""cacke":"f16""#, "cacke"),
        (r#""decisions":12"#, r#""decisions":-2"#, "-2"),
    ] {
        let refused = altered(from, to);
        assert!(matches!(
            refused,
            CompileError::Bundle(BundleError::Storage { .. })
        ));
        let text = refused.to_string();
        assert!(
            text.contains(part) && text.contains("lads-run tune"),
            "{text}"
        );
    }
}
