//! Hashes a policy's purpose: equal for two bundles that can be compared, whatever networks are inside.
//!
//! The same function as `purpose_sha256` of the exporter's `reference` module. Canonical form: `{key value ...}` with keys in order of
//! their code points, `[value ...]`, texts as `"bytes:UTF-8`, numbers as the 16 hexadecimal digits of their IEEE 754 double, `true`,
//! `false` and `null`, no separators. What can fail: text that is no JSON object.

use std::fmt::Write as _;

use serde_json::Value;
use sha2::{Digest as _, Sha256};

/// Parts of a contract, version 2, that say what a policy is for; the others say how it is built.
const PURPOSE: [&str; 6] = [
    "environment",
    "control_period_s",
    "channels",
    "instructions",
    "language",
    "evaluation",
];

/// Roles of the channels that the environment gives and takes; the others are the policy's own.
const ROLES: [&str; 2] = ["observation", "action"];

/// Hashes a contract's purpose, hexadecimal; `None` for text that is not a JSON object.
pub fn sha256(contract: &str) -> Option<String> {
    let contract: Value = serde_json::from_str(contract).ok()?;
    let all = contract.as_object()?;
    let purpose = PURPOSE
        .iter()
        .filter_map(|&key| Some((key.to_owned(), part(key, all.get(key)?))))
        .collect();
    Some(digest(canonical(&Value::Object(purpose)).as_bytes()))
}

/// Selects what counts of a part: of the channels those of the environment, of the language what makes words of a sentence, and not which
/// sentences are refused.
fn part(key: &str, value: &Value) -> Value {
    let mut value = value.clone();
    match (key, &mut value) {
        ("channels", Value::Array(channels)) => {
            channels.retain(|channel| {
                channel["role"]
                    .as_str()
                    .is_some_and(|role| ROLES.contains(&role))
            });
        }
        ("language", Value::Object(language)) => {
            language.remove("acceptance");
        }
        _ => {}
    }
    value
}

/// Computes the SHA-256 of bytes, hexadecimal.
fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes)
        .iter()
        .fold(String::new(), |mut text, byte| {
            let _ = write!(text, "{byte:02x}");
            text
        })
}

fn canonical(value: &Value) -> String {
    match value {
        Value::Object(object) => {
            let mut keys: Vec<_> = object.keys().collect();
            keys.sort_unstable();
            let rows = keys
                .into_iter()
                .map(|key| text(key) + &canonical(&object[key]));
            format!("{{{}}}", rows.collect::<String>())
        }
        Value::Array(list) => format!("[{}]", list.iter().map(canonical).collect::<String>()),
        Value::String(words) => text(words),
        Value::Number(number) => {
            let bits = number.as_f64().unwrap_or(f64::NAN).to_bits();
            format!("{bits:016x}")
        }
        Value::Bool(flag) => flag.to_string(),
        Value::Null => "null".to_owned(),
    }
}

fn text(words: &str) -> String {
    format!("\"{}:{words}", words.len())
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
        let expected = digest(canonical.as_bytes());
        assert_eq!(sha256(a), Some(expected));
        assert_eq!(sha256("[]"), None);
        assert_eq!(sha256("no JSON"), None);
    }
}
