//! Parses protocol buffers as a tree of fields, without knowing their schema, so that one can be changed and the lengths around it still
//! fit.

use crate::hostile::Edit;

/// Largest depth of nested messages that is parsed.
const MOST_DEPTH: usize = 8;

/// Largest size of a message after an edit, in bytes.
const MOST_BYTES: usize = 1 << 20;

/// One field of a message.
#[derive(Debug, Clone)]
pub struct Field {
    number: u64,
    value: Value,
}

#[derive(Debug, Clone)]
enum Value {
    Varint(u64),
    Fixed64([u8; 8]),
    Bytes(Vec<u8>),
    Message(Vec<Field>),
    Fixed32([u8; 4]),
}

fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let (&byte, rest) = bytes.split_first()?;
        *bytes = rest;
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

/// Parses the fields of a message; `None` when the bytes are not a message.
pub fn parse(bytes: &[u8]) -> Option<Vec<Field>> {
    parse_to(bytes, MOST_DEPTH)
}

fn parse_to(mut rest: &[u8], depth: usize) -> Option<Vec<Field>> {
    let mut fields = Vec::new();
    while !rest.is_empty() {
        let key = varint(&mut rest)?;
        let value = match key & 7 {
            0 => Value::Varint(varint(&mut rest)?),
            1 => {
                let (bytes, after) = rest.split_first_chunk()?;
                rest = after;
                Value::Fixed64(*bytes)
            }
            2 => {
                let len = usize::try_from(varint(&mut rest)?).ok()?;
                let (content, after) = rest.split_at_checked(len)?;
                rest = after;
                content_of(content, depth)
            }
            5 => {
                let (bytes, after) = rest.split_first_chunk()?;
                rest = after;
                Value::Fixed32(*bytes)
            }
            _ => return None,
        };
        fields.push(Field {
            number: key >> 3,
            value,
        });
    }
    Some(fields)
}

/// Parses the bytes as a message if they are one and are the same when written again.
fn content_of(content: &[u8], depth: usize) -> Value {
    let parsed = (depth > 0 && content.len() > 1).then(|| parse_to(content, depth - 1));
    match parsed.flatten() {
        Some(fields) if bytes(&fields) == content => Value::Message(fields),
        _ => Value::Bytes(content.to_vec()),
    }
}

fn put_varint(mut value: u64, out: &mut Vec<u8>) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Writes the fields as a message.
pub fn bytes(fields: &[Field]) -> Vec<u8> {
    let mut out = Vec::new();
    for Field { number, value } in fields {
        let kind = match value {
            Value::Varint(_) => 0,
            Value::Fixed64(_) => 1,
            Value::Bytes(_) | Value::Message(_) => 2,
            Value::Fixed32(_) => 5,
        };
        put_varint(number << 3 | kind, &mut out);
        let mut put_content = |content: &[u8]| {
            put_varint(content.len() as u64, &mut out);
            out.extend_from_slice(content);
        };
        match value {
            Value::Varint(value) => put_varint(*value, &mut out),
            Value::Fixed64(value) => out.extend_from_slice(value),
            Value::Fixed32(value) => out.extend_from_slice(value),
            Value::Bytes(content) => put_content(content),
            Value::Message(fields) => put_content(&bytes(fields)),
        }
    }
    out
}

/// Changes the field that the edit's place leads to: at every level it says which field, and whether to go in.
pub fn edit(fields: &mut Vec<Field>, edit: Edit) {
    let Edit { kind, place, value } = edit;
    if fields.is_empty() {
        return;
    }
    let at = place % fields.len();
    let deeper = place / fields.len();
    // Half of the messages on the way are entered.
    if let Value::Message(inner) = &mut fields[at].value
        && (kind & 0x80 == 0 || deeper & 1 == 1)
    {
        return self::edit(
            inner,
            Edit {
                place: deeper,
                ..edit
            },
        );
    }
    match kind % 8 {
        0 => fields[at].value = Value::Varint(value),
        1 => {
            fields.remove(at);
        }
        2 => {
            let again = fields[at].clone();
            let times = (value as usize % 64)
                .min(MOST_BYTES / bytes(std::slice::from_ref(&again)).len().max(1));
            fields.splice(at..at, std::iter::repeat_n(again, times));
        }
        3 => {
            let other = value as usize % fields.len();
            fields.swap(at, other);
        }
        4 => fields[at].number = value % 64,
        5 => {
            // A message in itself, as deep as it may become.
            for _ in 0..value % 300 {
                let inner = fields[at].clone();
                fields[at].value = Value::Message(vec![inner]);
            }
        }
        6 => {
            let len = (value as usize).min(MOST_BYTES);
            let mut content = bytes(&fields[at..=at]);
            content.resize(len, b'x');
            fields[at].value = Value::Bytes(content);
        }
        _ => change(&mut fields[at].value, value),
    }
}

/// Changes a value slightly.
fn change(value: &mut Value, with: u64) {
    match value {
        Value::Varint(old) => *old = old.wrapping_add(with),
        Value::Fixed64(old) => old[with as usize % 8] ^= 1 << (with >> 3 & 7),
        Value::Fixed32(old) => old[with as usize % 4] ^= 1 << (with >> 3 & 7),
        Value::Message(fields) => fields.truncate(with as usize % (fields.len() + 1)),
        Value::Bytes(content) => {
            let len = content.len();
            if let Some(byte) = content.get_mut(with as usize % len.max(1)) {
                *byte ^= 1 << (with >> 5 & 7);
            }
        }
    }
}
