//! The small bundle and its contract.

use std::ops::Range;

use serde_json::Value;

pub const TINY: &[u8] = include_bytes!("../data/tiny.onnx");

/// Returns the small bundle's contract, and where in its bytes it stands.
pub fn contract() -> (Value, Range<usize>) {
    let start = br#"{"version""#;
    let at = TINY.windows(start.len()).position(|part| part == start);
    let at = at.expect("the contract");
    let mut values = serde_json::Deserializer::from_slice(&TINY[at..]).into_iter();
    let contract = values.next().expect("a value").expect("JSON");
    (contract, at..at + values.byte_offset())
}
