//! Checks a JSON value against the part of JSON Schema that `results.schema.json` uses; an unknown keyword is a failure, not a pass.

use serde_json::Value;

/// Checks a value; panics with the path of the first value that does not fit.
pub fn check(value: &Value, schema: &Value, root: &Value, path: &str) {
    for (keyword, rule) in schema.as_object().unwrap() {
        let fits = match keyword.as_str() {
            "$schema" | "$defs" | "title" | "description" => true,
            "$ref" => {
                let pointer = rule.as_str().unwrap().strip_prefix('#').unwrap();
                check(value, root.pointer(pointer).unwrap(), root, path);
                true
            }
            "type" => match rule {
                Value::Array(types) => types.iter().any(|one| is(value, one)),
                one => is(value, one),
            },
            "const" => value == rule,
            "enum" => rule.as_array().unwrap().contains(value),
            // A bound says nothing about a value that is not a number.
            "minimum" => value
                .as_f64()
                .is_none_or(|number| number >= rule.as_f64().unwrap()),
            "maximum" => value
                .as_f64()
                .is_none_or(|number| number <= rule.as_f64().unwrap()),
            "minLength" => value.as_str().unwrap().len() as u64 >= rule.as_u64().unwrap(),
            "maxLength" => value.as_str().unwrap().len() as u64 <= rule.as_u64().unwrap(),
            "minItems" => value.as_array().unwrap().len() as u64 >= rule.as_u64().unwrap(),
            "maxItems" => value.as_array().unwrap().len() as u64 <= rule.as_u64().unwrap(),
            // What is said of fields says nothing about a value that has none.
            "required" => value.as_object().is_none_or(|fields| {
                let mut keys = rule.as_array().unwrap().iter();
                keys.all(|key| fields.contains_key(key.as_str().unwrap()))
            }),
            "additionalProperties" => {
                let others = value.as_object().into_iter().flatten();
                let mut others = others.filter(|(key, _)| schema["properties"].get(key).is_none());
                if rule.is_object() {
                    others.for_each(|(key, inner)| {
                        check(inner, rule, root, &format!("{path}.{key}"));
                    });
                    true
                } else {
                    assert_eq!(rule, &Value::Bool(false), "{path}: false or a schema");
                    others.next().is_none()
                }
            }
            "properties" => {
                for (key, of_key) in rule.as_object().unwrap() {
                    if let Some(inner) = value.get(key) {
                        check(inner, of_key, root, &format!("{path}.{key}"));
                    }
                }
                true
            }
            "items" => {
                for (index, inner) in value.as_array().unwrap().iter().enumerate() {
                    check(inner, rule, root, &format!("{path}[{index}]"));
                }
                true
            }
            other => panic!("{path}: the schema uses {other}, which this checker does not know"),
        };
        assert!(fits, "{path}: {keyword} {rule} does not hold for {value}");
    }
}

fn is(value: &Value, name: &Value) -> bool {
    match name.as_str().unwrap() {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "number" => value.is_number(),
        "integer" => value.is_u64() || value.is_i64(),
        "null" => value.is_null(),
        other => panic!("unknown type {other}"),
    }
}
