//! YAML read as data: numbers, texts, lists, and maps whose keys keep their order.
//!
//! Tags are skipped, so nothing is constructed or executed. What can fail: the text is not YAML, it
//! is nested too deeply, or its aliases stand for more values than a description of a robot has.

use std::collections::HashMap;

use saphyr_parser::{Event, Parser, ScalarStyle};

/// A value of a document.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) enum Value {
    #[default]
    Null,
    Bool(bool),
    Number(f64),
    Text(String),
    List(Vec<Value>),
    Map(Vec<(String, Value)>),
}

impl Value {
    /// Returns the value of a key of a map.
    pub fn get(&self, key: &str) -> Option<&Value> {
        let found = self.pairs().iter().find(|(known, _)| known == key);
        found.map(|(_, value)| value)
    }

    /// Returns the pairs of a map; none for other values.
    pub fn pairs(&self) -> &[(String, Value)] {
        match self {
            Value::Map(pairs) => pairs,
            _ => &[],
        }
    }

    pub fn number(&self) -> Option<f64> {
        match self {
            Value::Number(number) => Some(*number),
            _ => None,
        }
    }

    pub fn text(&self) -> Option<&str> {
        match self {
            Value::Text(text) => Some(text),
            _ => None,
        }
    }

    pub fn list(&self) -> Option<&[Value]> {
        match self {
            Value::List(values) => Some(values),
            _ => None,
        }
    }

    /// Returns the numbers of a list.
    pub fn numbers(&self) -> Option<Vec<f64>> {
        self.list()?.iter().map(Value::number).collect()
    }
}

impl From<serde_json::Value> for Value {
    fn from(json: serde_json::Value) -> Self {
        use serde_json::Value as Json;
        match json {
            Json::Null => Value::Null,
            Json::Bool(flag) => Value::Bool(flag),
            Json::Number(number) => number.as_f64().map_or(Value::Null, Value::Number),
            Json::String(text) => Value::Text(text),
            Json::Array(values) => Value::List(values.into_iter().map(Value::from).collect()),
            Json::Object(map) => Value::Map(
                map.into_iter()
                    .map(|(key, value)| (key, value.into()))
                    .collect(),
            ),
        }
    }
}

/// Largest number of values of a document, those that aliases stand for counted each time.
const MAX_VALUES: usize = 100_000;

/// Largest depth of nesting.
const MAX_DEPTH: usize = 32;

/// A list or a map that is not complete yet.
enum Open {
    List(Vec<Value>),
    Map(Vec<(String, Value)>, Option<String>),
}

/// Reads the first document of a text; nothing for an empty one.
pub(crate) fn read(text: &str) -> Result<Value, String> {
    let mut reader = Reader::default();
    for event in Parser::new_from_str(text) {
        let (event, _) = event.map_err(|error| format!("is not YAML: {error}"))?;
        match event {
            Event::Scalar(text, style, anchor, _) => reader.value(scalar(&text, style), anchor)?,
            Event::SequenceStart(anchor, _) => reader.open(Open::List(vec![]), anchor)?,
            Event::MappingStart(anchor, _) => reader.open(Open::Map(vec![], None), anchor)?,
            Event::SequenceEnd | Event::MappingEnd => reader.close()?,
            Event::Alias(anchor) => {
                let (value, count) = reader.anchored.get(&anchor).cloned().unwrap_or_default();
                reader.count(count)?;
                reader.put(value)?;
            }
            Event::DocumentEnd => break,
            _ => {}
        }
    }
    Ok(reader.done.unwrap_or(Value::Null))
}

#[derive(Default)]
struct Reader {
    open: Vec<(Open, usize, usize)>,
    anchored: HashMap<usize, (Value, usize)>,
    done: Option<Value>,
    values: usize,
}

impl Reader {
    fn count(&mut self, values: usize) -> Result<(), String> {
        self.values = self.values.saturating_add(values);
        if self.values > MAX_VALUES {
            return Err(format!(
                "holds more than {MAX_VALUES} values, those that aliases repeat counted each time"
            ));
        }
        Ok(())
    }

    fn value(&mut self, value: Value, anchor: usize) -> Result<(), String> {
        self.count(1)?;
        if anchor != 0 {
            self.anchored.insert(anchor, (value.clone(), 1));
        }
        self.put(value)
    }

    fn open(&mut self, open: Open, anchor: usize) -> Result<(), String> {
        self.count(1)?;
        if self.open.len() == MAX_DEPTH {
            return Err(format!("is nested more than {MAX_DEPTH} deep"));
        }
        self.open.push((open, anchor, self.values - 1));
        Ok(())
    }

    fn close(&mut self) -> Result<(), String> {
        let Some((open, anchor, before)) = self.open.pop() else {
            return Ok(());
        };
        let value = match open {
            Open::List(values) => Value::List(values),
            Open::Map(map, _) => Value::Map(map),
        };
        if anchor != 0 {
            self.anchored
                .insert(anchor, (value.clone(), self.values - before));
        }
        self.put(value)
    }

    fn put(&mut self, value: Value) -> Result<(), String> {
        match self.open.last_mut() {
            None => self.done = Some(value),
            Some((Open::List(values), ..)) => values.push(value),
            Some((Open::Map(map, key), ..)) => match key.take() {
                None => {
                    *key = Some(match value {
                        Value::Text(text) => text,
                        Value::Number(number) => number.to_string(),
                        Value::Bool(flag) => flag.to_string(),
                        Value::Null => "null".into(),
                        _ => return Err("has a list or a map as a key".into()),
                    });
                }
                Some(key) => {
                    if map.iter().any(|(known, _)| *known == key) {
                        return Err(format!("has the key {key} twice"));
                    }
                    map.push((key, value));
                }
            },
        }
        Ok(())
    }
}

/// Converts a plain scalar by YAML's core schema; a quoted one is a text.
fn scalar(text: &str, style: ScalarStyle) -> Value {
    if style != ScalarStyle::Plain {
        return Value::Text(text.into());
    }
    match text {
        "" | "~" | "null" | "Null" | "NULL" => return Value::Null,
        "true" | "True" | "TRUE" => return Value::Bool(true),
        "false" | "False" | "FALSE" => return Value::Bool(false),
        _ => {}
    }
    let number = text.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c));
    let parsed = number.then(|| text.parse::<f64>().ok()).flatten();
    parsed
        .filter(|number| number.is_finite())
        .map_or_else(|| Value::Text(text.into()), Value::Number)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn values_are_read_in_their_order_and_tags_are_skipped() {
        let text = "b: [1, -2.5, .5, 1e-3, x]\na: {c: null, d: true, e: '1'}\nf: !!python/object/apply:os.system [rm]\n\
                    g: &g [1, 2]\nh: *g\n";
        let read = read(text).expect("it reads");
        let wanted = [
            ("b", json!([1, -2.5, 0.5, 0.001, "x"])),
            ("a", json!({"c": null, "d": true, "e": "1"})),
            ("f", json!(["rm"])),
            ("g", json!([1, 2])),
            ("h", json!([1, 2])),
        ];
        let wanted = wanted.map(|(key, value)| (key.to_owned(), value.into()));
        assert_eq!(read, Value::Map(wanted.to_vec()));
        assert_eq!(super::read(""), Ok(Value::Null));
    }

    #[test]
    fn bombs_are_refused() {
        let mut laughs = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
        for i in 1..10 {
            let before = vec![format!("*a{}", i - 1); 10].join(", ");
            let row = format!("a{i}: &a{i} [{before}]\n");
            laughs.push_str(&row);
        }
        assert!(read(&laughs).unwrap_err().contains("aliases"));
        assert!(read(&"[".repeat(100)).unwrap_err().contains("deep"));
        let million = "[".repeat(1_000_000);
        assert!(read(&million).is_err());
    }

    #[test]
    fn what_is_no_yaml_is_refused() {
        for text in ["a: [1", "a: b: c", "{a: 1, a: 2}", "? [1]\n: 2"] {
            assert!(read(text).is_err(), "{text}");
        }
    }
}
