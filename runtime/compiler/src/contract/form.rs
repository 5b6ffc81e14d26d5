//! Form of a contract's JSON: which fields it has, and of which types.
//!
//! A deserializer stops at the first fault. To find all of them, every part of the contract is
//! read alone, in the place of the same part of an example that is known to be sound.

use serde_json::{Map, Value};

use super::{Contract, Faults};
use crate::family::Family;

/// Contract with every field that a contract may have, and one element in every list. Its family is
/// replaced by the example of the family that is looked for.
const EXAMPLE: &str = r#"{
    "version": 2,
    "family": {"kind": "plain"},
    "environment": {"id": "e", "version": "1"},
    "control_period_s": 1,
    "channels": [{
        "name": "c", "role": "action", "dtype": "f32", "shape": [1], "quaternion_order": "none",
        "reference": "", "min": 0, "max": 1, "rendering": {},
        "elements": [{
            "name": "x", "unit": "1", "min": 0, "max": 1, "joint": "j", "interface": "position",
            "scale": 1, "offset": 0, "physical_unit": "rad", "stiffness": 1, "damping": 1
        }]
    }],
    "states": [{
        "name": "s", "kind": "plain", "shape": [1], "rows": 1, "source": "c", "fill": "zero", "cleared_by": "episode"
    }],
    "context": {"words": 1, "steps": 1, "beyond": "restart"},
    "instructions": [{"id": "i", "text": "i"}],
    "language": {
        "encoder": "e", "sha256": "", "dim": 1, "layer": 0, "pooling": "none",
        "acceptance": {"similarity": "alignment", "threshold": 0, "accepted_known": 0, "accepted_other": 0}
    },
    "network": {"layers": 1, "heads": 1, "head_dim": 1},
    "evaluation": {"instructions": [{"sub_tasks": ["t"], "split": "s"}]},
    "provenance": {}
}"#;

/// Fields that every contract requires, and what each is for.
pub(crate) const REQUIRED: [(&str, &str); 6] = [
    ("version", "the version of the contract's form, 2"),
    (
        "family",
        "the family of policies and its own fields; {\"kind\": \"plain\"} for one graph from observations to an action",
    ),
    (
        "environment",
        "`id` and `version` of the environment that it was made for",
    ),
    (
        "control_period_s",
        "the time from one control step to the next, in seconds",
    ),
    (
        "channels",
        "every observation and the action, with names, units and limits",
    ),
    ("provenance", "how the policy was trained: anything, or {}"),
];

/// Adds all faults of a contract's form, and returns the contract with the example's parts in place
/// of the faulty ones; `None` if it is no contract in any part.
pub(super) fn read(found: &Value, faults: &mut Faults) -> Option<Contract> {
    let mut example: Value = serde_json::from_str(EXAMPLE).ok()?;
    let kind = found.pointer("/family/kind").and_then(Value::as_str);
    if let Some(family) = kind.and_then(Family::example) {
        example["family"] = serde_json::from_str(family).ok()?;
    }
    let place = Place {
        pointer: String::new(),
        field: String::new(),
    };
    let repaired = place.read(found, &example, &example, faults);
    serde_json::from_value(repaired).ok()
}

/// Place of a part.
struct Place {
    /// Pointer to the part in the example.
    pointer: String,
    /// Name of the part for a person.
    field: String,
}

impl Place {
    fn of_key(&self, key: &str) -> Self {
        let point = if self.field.is_empty() { "" } else { "." };
        let escaped = key.replace('~', "~0").replace('/', "~1");
        Self {
            pointer: format!("{}/{escaped}", self.pointer),
            field: format!("{}{point}{key}", self.field),
        }
    }

    /// Returns the place of an element, which the example has once.
    fn of_element(&self, index: usize) -> Self {
        Self {
            pointer: format!("{}/0", self.pointer),
            field: format!("{}[{index}]", self.field),
        }
    }

    /// Returns a part without its faults, which are added.
    fn read(&self, found: &Value, sound: &Value, example: &Value, faults: &mut Faults) -> Value {
        let Err(error) = self.reads(found, example) else {
            return found.clone();
        };
        if faults.is_cut() {
            return sound.clone();
        }
        match (found, sound) {
            (Value::Object(found), Value::Object(sound)) => {
                Value::Object(self.fields(found, sound, example, faults))
            }
            (Value::Array(found), Value::Array(sound)) if !sound.is_empty() => {
                let elements = found.iter().enumerate();
                let elements = elements.map(|(i, element)| {
                    let place = self.of_element(i);
                    place.read(element, &sound[0], example, faults)
                });
                Value::Array(elements.collect())
            }
            _ => {
                faults.add(&self.field, format!("cannot be read: {error}"));
                sound.clone()
            }
        }
    }

    fn fields(
        &self,
        found: &Map<String, Value>,
        sound: &Map<String, Value>,
        example: &Value,
        faults: &mut Faults,
    ) -> Map<String, Value> {
        let mut repaired = found.clone();
        for (key, sound) in sound {
            let place = self.of_key(key);
            if let Some(found) = found.get(key) {
                let value = place.read(found, sound, example, faults);
                repaired.insert(key.clone(), value);
            } else if self.needs(key, example) {
                let needed = REQUIRED.iter().find(|(field, _)| *field == place.field);
                let needed = needed.map_or(String::new(), |(_, needed)| format!(": {needed}"));
                faults.add(&place.field, format!("is missing{needed}"));
                repaired.insert(key.clone(), sound.clone());
            }
        }
        repaired
    }

    /// Reads the example with this part in place of its own.
    fn reads(&self, part: &Value, example: &Value) -> Result<(), serde_json::Error> {
        let mut whole = example.clone();
        if let Some(place) = whole.pointer_mut(&self.pointer) {
            *place = part.clone();
        }
        serde_json::from_value::<Contract>(whole).map(drop)
    }

    /// Returns whether the example cannot be read without a field of this part.
    fn needs(&self, key: &str, example: &Value) -> bool {
        let mut whole = example.clone();
        if let Some(Value::Object(fields)) = whole.pointer_mut(&self.pointer) {
            fields.remove(key);
        }
        serde_json::from_value::<Contract>(whole).is_err()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every family's own example, with all its fields, is read as that family.
    #[test]
    fn the_examples_are_sound() {
        for kind in Family::NAMES {
            let mut example: Value = serde_json::from_str(EXAMPLE).unwrap();
            let family = Family::example(kind).unwrap();
            example["family"] = serde_json::from_str(family).unwrap();
            let contract: Contract = serde_json::from_value(example).unwrap();
            assert_eq!(contract.family.name(), *kind);
        }
    }
}
