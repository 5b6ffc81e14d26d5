//! Reads the top-level fields of a protocol buffer, to distinguish a truncated model from a file
//! that never was one.
//!
//! A field is a varint key (`number << 3 | wire type`) and its value; see the protocol buffer
//! encoding specification. The walk reads keys and lengths only, so it is exact about where the
//! file ends.

use crate::error::BundleError;

/// Highest field number of a `ModelProto`.
const LAST_MODEL_FIELD: u64 = 26;

/// One encoded field of the file.
pub(crate) struct Field<'b> {
    pub number: u64,
    /// Bytes of key and value.
    pub whole: &'b [u8],
    /// Content of a field of varying length; empty for the other wire types.
    pub value: &'b [u8],
}

/// Returns the fields of a `ModelProto` if the bytes look like a complete one.
pub(crate) fn fields(bytes: &[u8]) -> Result<Vec<Field<'_>>, BundleError> {
    let not_onnx = |problem: &str| BundleError::NotOnnx {
        problem: problem.into(),
    };
    if bytes.is_empty() {
        return Err(not_onnx("it is empty"));
    }
    let mut at = 0;
    let mut fields = vec![];
    while at < bytes.len() {
        let start = at;
        let cut = |needed: u64| BundleError::Truncated {
            needed,
            got: bytes.len() as u64,
        };
        // A file that fails in its first field never was a model; later, it was cut off.
        let Some(key) = varint(bytes, &mut at) else {
            return Err(if fields.is_empty() {
                not_onnx("its first bytes are not a field")
            } else {
                cut(bytes.len() as u64 + 1)
            });
        };
        let (number, wire) = (key >> 3, key & 7);
        if number == 0 || number > LAST_MODEL_FIELD {
            return Err(not_onnx("its fields are not a model's"));
        }
        let end = match wire {
            0 => match varint(bytes, &mut at) {
                Some(_) => at as u64,
                None => return Err(cut(bytes.len() as u64 + 1)),
            },
            1 => at as u64 + 8,
            2 => match varint(bytes, &mut at) {
                Some(len) => (at as u64).saturating_add(len),
                None => return Err(cut(bytes.len() as u64 + 1)),
            },
            5 => at as u64 + 4,
            _ => return Err(not_onnx("its fields are not a model's")),
        };
        if end > bytes.len() as u64 {
            return Err(if fields.is_empty() {
                not_onnx("its first field is longer than the file")
            } else {
                cut(end)
            });
        }
        let value = if wire == 2 { at } else { end as usize };
        at = end as usize;
        fields.push(Field {
            number,
            whole: &bytes[start..at],
            value: &bytes[value..at],
        });
    }
    Ok(fields)
}

/// Reads a varint of at most ten bytes and advances `at` past it.
fn varint(bytes: &[u8], at: &mut usize) -> Option<u64> {
    let mut value = 0u64;
    for shift in (0..70).step_by(7) {
        let byte = *bytes.get(*at)?;
        *at += 1;
        value |= u64::from(byte & 0x7f).checked_shl(shift)?;
        if byte & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}
