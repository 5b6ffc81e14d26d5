//! What a policy is for, as one hash: equal for two bundles that can be compared, whatever networks are inside.
//!
//! The same function as `purpose_sha256` of the exporter's `reference` module. Canonical form: `{key value ...}` with keys in order of
//! their code points, `[value ...]`, texts as `"bytes:UTF-8`, numbers as the 16 hexadecimal digits of their IEEE 754 double, `true`,
//! `false` and `null`, no separators. What can fail: text that is no JSON object.

use std::fmt::Write as _;

use serde_json::Value;
use sha2::{Digest, Sha256};

/// The parts of a contract that say what a policy is for; the others say how it is built.
const PURPOSE: [&str; 7] = [
    "environment",
    "control_period_s",
    "observation",
    "action",
    "quaternion_order",
    "instructions",
    "language",
];

/// The hash of a contract's purpose, hexadecimal; `None` for what is no JSON object.
pub fn sha256(contract: &str) -> Option<String> {
    let contract: Value = serde_json::from_str(contract).ok()?;
    let all = contract.as_object()?;
    let purpose = PURPOSE
        .iter()
        .filter_map(|&key| Some((key.to_owned(), all.get(key)?.clone())))
        .collect();
    let mut digest = Sha256::new();
    add(&Value::Object(purpose), &mut digest);
    Some(hexadecimal(&digest.finalize()))
}

fn hexadecimal(bytes: &[u8]) -> String {
    let mut text = String::new();
    for byte in bytes {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
    }
    text
}

fn add(value: &Value, digest: &mut Sha256) {
    match value {
        Value::Object(object) => {
            digest.update(b"{");
            let mut keys: Vec<_> = object.keys().collect();
            keys.sort_unstable();
            for key in keys {
                add_text(key, digest);
                add(&object[key], digest);
            }
            digest.update(b"}");
        }
        Value::Array(list) => {
            digest.update(b"[");
            for value in list {
                add(value, digest);
            }
            digest.update(b"]");
        }
        Value::String(text) => add_text(text, digest),
        Value::Number(number) => {
            let bits = number.as_f64().unwrap_or(f64::NAN).to_bits();
            digest.update(format!("{bits:016x}"));
        }
        Value::Bool(true) => digest.update(b"true"),
        Value::Bool(false) => digest.update(b"false"),
        Value::Null => digest.update(b"null"),
    }
}

fn add_text(text: &str, digest: &mut Sha256) {
    digest.update(format!("\"{}:", text.len()));
    digest.update(text);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_policy_is_built_of_does_not_count() {
        let a = r#"{"environment": {"id": "x", "version": "1"}, "control_period_s": 0.05, "horizon": 10}"#;
        let b = r#"{"horizon": 20, "control_period_s": 5e-2, "environment": {"version": "1", "id": "x"}}"#;
        let c = r#"{"horizon": 10, "control_period_s": 0.04, "environment": {"version": "1", "id": "x"}}"#;
        assert_eq!(sha256(a), sha256(b));
        assert_ne!(sha256(a), sha256(c));
        // Worked out by hand: {"16:control_period_s3fa999999999999a"11:environment{"2:id"1:x"7:version"1:1}}
        let canonical =
            r#"{"16:control_period_s3fa999999999999a"11:environment{"2:id"1:x"7:version"1:1}}"#;
        let expected = hexadecimal(&Sha256::digest(canonical));
        assert_eq!(sha256(a), Some(expected));
        assert_eq!(sha256("[]"), None);
        assert_eq!(sha256("no JSON"), None);
    }
}
