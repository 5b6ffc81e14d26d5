//! Tests that opening and compiling any bytes ends with a value: a policy that loads or one clear
//! line.

use lads_compiler::{Bundle, compile};
use lads_core::Policy;
use proptest::prelude::*;

const TINY: &[u8] = include_bytes!("data/tiny.onnx");

/// Opens and compiles; the tests fail on panics.
fn survive(bytes: &[u8]) {
    let message = match Bundle::from_bytes(bytes) {
        Err(error) => error.to_string(),
        Ok(bundle) => match compile(&bundle) {
            Err(error) => error.to_string(),
            Ok(image) => {
                Policy::new_checked(image.as_bytes()).expect("an image that was made loads");
                return;
            }
        },
    };
    assert!(!message.is_empty() && !message.contains('\n'), "{message}");
}

/// Generates offsets of the graph's nodes: names, attributes and shapes, not weights.
fn structure() -> impl Strategy<Value = usize> {
    let end = TINY
        .windows(8)
        .position(|window| window == b"weights/")
        .unwrap_or(TINY.len());
    0..end.max(1000)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn changed_bytes(changes in prop::collection::vec((0..TINY.len(), any::<u8>()), 1..6)) {
        let mut bytes = TINY.to_vec();
        for (at, byte) in changes {
            bytes[at] = byte;
        }
        survive(&bytes);
    }

    #[test]
    fn changed_structure(changes in prop::collection::vec((structure(), any::<u8>()), 1..3)) {
        let mut bytes = TINY.to_vec();
        for (at, byte) in changes {
            bytes[at] = byte;
        }
        survive(&bytes);
    }

    #[test]
    fn removed_and_repeated_parts(at in 0..TINY.len(), len in 1usize..200, repeat: bool) {
        let end = (at + len).min(TINY.len());
        let mut bytes = TINY[..end].to_vec();
        if !repeat {
            bytes.truncate(at);
        }
        bytes.extend_from_slice(&TINY[if repeat { at } else { end }..]);
        survive(&bytes);
    }

    #[test]
    fn random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        survive(&bytes);
    }
}
