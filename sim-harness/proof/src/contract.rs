//! Compares two contracts field by field, whatever fields they have. Field by field, whatever fields a contract has.
//!
//! A policy is more than its networks: the rule that decides, limits, context and units run too. Nothing here can fail.

use serde::Serialize;
use serde_json::Value;

/// Contract fields that say where a policy comes from, not what it does.
const HISTORY: [&str; 2] = ["version", "provenance"];

/// A contract field that differs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FieldDifference {
    /// Place of the field, such as `action[gripper].max`.
    pub field: String,
    /// Value in the run's contract, as JSON; `null` if absent.
    pub run: String,
    /// Value that the run's value is compared with, as JSON; `null` if absent.
    pub reference: String,
}

/// Result of comparing contracts.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Compared {
    /// Names of the contract's fields that were compared; empty where the reference records no contract.
    pub fields: Vec<String>,
    /// Fields that differ from the reference's.
    pub differing: Vec<FieldDifference>,
    /// Fields in which the program image that ran differs from the bundle.
    pub image_differing: Vec<FieldDifference>,
    /// Fields that differ and say only where the policy comes from.
    pub history: Vec<FieldDifference>,
    /// Remedy where no field was compared.
    #[serde(skip)]
    pub remedy: &'static str,
}

impl Compared {
    /// Compares the contract of the run with the reference's, and what the image that ran says with what its bundle says of the same fields.
    /// The remedy names no command: who knows one sets it.
    pub fn new(run: &Value, reference: Option<&Value>, [image, bundle]: [&Value; 2]) -> Self {
        let mut compared = Self {
            remedy: "complete it with its contract",
            ..Self::default()
        };
        if let Some(reference) = reference {
            let mut all = Vec::new();
            differences(String::new(), run, reference, &mut all);
            let old = |difference: &FieldDifference| {
                HISTORY.iter().any(|name| top(&difference.field) == *name)
            };
            (compared.history, compared.differing) = all.into_iter().partition(old);
            let names = reference
                .as_object()
                .into_iter()
                .flat_map(|object| object.keys());
            compared.fields = names
                .filter(|name| !HISTORY.contains(&name.as_str()))
                .cloned()
                .collect();
        }
        differences(String::new(), image, bundle, &mut compared.image_differing);
        compared
    }

    /// Compares the contract of the run with what is known of the reference's, which may be a part: a field that nobody states is not compared.
    /// `remedy` says how to state one.
    pub fn with_stated(run: &Value, stated: &Value, remedy: &'static str) -> Self {
        let mut compared = Self {
            remedy,
            ..Self::default()
        };
        // What is stated takes the place of what the run says, so the sides are exchanged back.
        restricted(String::new(), stated, run, &mut compared.differing);
        for difference in &mut compared.differing {
            std::mem::swap(&mut difference.run, &mut difference.reference);
        }
        let names = stated.as_object().into_iter().flat_map(|all| all.keys());
        compared.fields = names.cloned().collect();
        compared
    }
}

/// Name of the contract's top-level field that contains a place.
fn top(place: &str) -> &str {
    place.split(['.', '[']).next().unwrap_or_default()
}

fn inside(place: &str, name: &str) -> String {
    if place.is_empty() {
        name.to_owned()
    } else {
        format!("{place}.{name}")
    }
}

/// Names an element of a list by its name or id, if it has one.
fn element(place: &str, index: usize, value: &Value) -> String {
    let name = ["name", "id"]
        .iter()
        .find_map(|key| value.get(key)?.as_str());
    name.map_or_else(
        || format!("{place}[{index}]"),
        |name| format!("{place}[{name}]"),
    )
}

fn note(field: String, run: &Value, reference: &Value, found: &mut Vec<FieldDifference>) {
    found.push(FieldDifference {
        field,
        run: run.to_string(),
        reference: reference.to_string(),
    });
}

fn differences(place: String, run: &Value, reference: &Value, found: &mut Vec<FieldDifference>) {
    match (run, reference) {
        (Value::Object(ours), Value::Object(theirs)) => {
            for (name, value) in theirs {
                differences(
                    inside(&place, name),
                    ours.get(name).unwrap_or(&Value::Null),
                    value,
                    found,
                );
            }
            for (name, value) in ours.iter().filter(|(name, _)| !theirs.contains_key(*name)) {
                note(inside(&place, name), value, &Value::Null, found);
            }
        }
        (Value::Array(ours), Value::Array(theirs)) if ours.len() == theirs.len() => {
            for (index, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
                differences(element(&place, index, theirs), ours, theirs, found);
            }
        }
        (Value::Array(ours), Value::Array(theirs)) => {
            let lens = [ours.len(), theirs.len()].map(Value::from);
            note(inside(&place, "len"), &lens[0], &lens[1], found);
        }
        (Value::Number(ours), Value::Number(theirs)) if ours.as_f64() == theirs.as_f64() => {}
        (ours, theirs) if ours == theirs => {}
        (ours, theirs) => note(place, ours, theirs, found),
    }
}

/// Compares the fields that `image` has with those of the bundle's contract; fields that the image lacks are not compared.
fn restricted(place: String, image: &Value, bundle: &Value, found: &mut Vec<FieldDifference>) {
    match (image, bundle) {
        (Value::Object(ours), theirs) => {
            for (name, value) in ours {
                restricted(
                    inside(&place, name),
                    value,
                    theirs.get(name).unwrap_or(&Value::Null),
                    found,
                );
            }
        }
        (Value::Array(ours), Value::Array(theirs)) if ours.len() == theirs.len() => {
            for (index, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
                restricted(element(&place, index, theirs), ours, theirs, found);
            }
        }
        (Value::Number(ours), Value::Number(theirs)) => {
            let single = |number: &serde_json::Number| number.as_f64().map(|number| number as f32);
            if single(ours) != single(theirs) {
                note(place, image, bundle, found);
            }
        }
        (ours, theirs) if ours == theirs => {}
        (ours, theirs) => note(place, ours, theirs, found),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn contract() -> Value {
        json!({
            "version": 1,
            "decision": {"rule": "argmax", "temperature": 1.0},
            "action": [{"name": "lift", "max": 0.1}, {"name": "turn", "max": 2}],
            "provenance": {"seed": 0},
        })
    }

    fn fields(found: &[FieldDifference]) -> Vec<&str> {
        found
            .iter()
            .map(|difference| difference.field.as_str())
            .collect()
    }

    #[test]
    fn every_field_is_named() {
        let mut run = contract();
        run["decision"]["rule"] = json!("sample");
        run["action"][1]["max"] = json!(2.5);
        run["extra"] = json!(true);
        run["provenance"]["seed"] = json!(7);
        let found = Compared::new(&run, Some(&contract()), [&Value::Null; 2]);
        assert_eq!(
            fields(&found.differing),
            ["action[turn].max", "decision.rule", "extra"]
        );
        assert_eq!(found.differing[1].run, "\"sample\"");
        assert_eq!(fields(&found.history), ["provenance.seed"]);
        assert_eq!(found.fields, ["action", "decision"]);
        run["action"] = json!([]);
        let found = Compared::new(&run, Some(&contract()), [&Value::Null; 2]);
        assert!(fields(&found.differing).contains(&"action.len"));
    }

    #[test]
    fn numbers_are_compared_as_numbers() {
        let mut run = contract();
        run["action"][1]["max"] = json!(2.0);
        let image = json!({"action": [{"max": 0.5}, {"max": 2.0}]});
        let bundle = json!({"action": [{"max": 0.5}, {"max": 2}]});
        let found = Compared::new(&run, Some(&contract()), [&image, &bundle]);
        assert!(
            found.differing.is_empty() && found.image_differing.is_empty(),
            "{found:?}"
        );
    }

    #[test]
    fn only_what_is_stated_is_compared() {
        let stated = json!({"decision": {"rule": "argmax"}, "period": 0.02});
        let mut run = contract();
        run["period"] = json!(0.04);
        let found = Compared::with_stated(&run, &stated, "state one");
        assert_eq!(fields(&found.differing), ["period"]);
        assert_eq!(found.differing[0].run, "0.04");
        assert_eq!(found.differing[0].reference, "0.02");
        assert_eq!(found.fields, ["decision", "period"]);
    }

    #[test]
    fn an_image_that_says_otherwise_is_found_and_no_recorded_contract_is_none_compared() {
        let image = json!({"decision": {"rule": "sample"}, "joint": "elbow"});
        let bundle = json!({"decision": {"rule": "argmax"}, "interface": "effort"});
        let found = Compared::new(&contract(), None, [&image, &bundle]);
        assert_eq!(
            fields(&found.image_differing),
            ["decision.rule", "interface", "joint"]
        );
        assert!(found.fields.is_empty() && found.differing.is_empty());
    }
}
