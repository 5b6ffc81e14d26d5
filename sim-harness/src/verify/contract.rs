//! Describes a program image with the fields of a bundle's contract.
//!
//! Nothing here can fail.

use lads_core::{Channel, Contract, Decision, Policy};
use serde_json::{Map, Value, json};

/// Lists the fields of the contract that an image holds and that decide what it does.
pub fn of_image(policy: &Policy<'_>) -> Value {
    let contract = policy.contract();
    let mut family = json!({"kind": contract.family()});
    if policy.index_count() > 0 {
        family["decision"] = match contract.decision() {
            Decision::Argmax => json!({"rule": "argmax"}),
            Decision::Sample { temperature, seed } => {
                json!({"rule": "sample", "temperature": temperature, "seed": seed})
            }
        };
    }
    let instructions = contract
        .instructions()
        .map(|known| json!({"id": known.id, "text": known.text}));
    let mut fields = Map::from_iter([
        (
            "environment".to_owned(),
            json!({"id": contract.environment_id(), "version": contract.environment_version()}),
        ),
        (
            "control_period_s".to_owned(),
            json!(contract.control_period_s()),
        ),
        ("family".to_owned(), family),
        (
            "channels".to_owned(),
            contract.channels().map(|it| channel(&it)).collect(),
        ),
    ]);
    if contract.instruction_count() > 0 {
        fields.insert("instructions".to_owned(), instructions.collect());
    }
    if let Some(steps) = contract.context_steps() {
        let beyond = format!("{:?}", contract.beyond()).to_lowercase();
        fields.insert(
            "context".to_owned(),
            json!({"steps": steps, "beyond": beyond}),
        );
    }
    Value::Object(fields)
}

fn channel(channel: &Channel<'_>) -> Value {
    let mut fields = json!({
        "name": channel.name(),
        "role": format!("{:?}", channel.role()).to_lowercase(),
        "dtype": format!("{:?}", channel.dtype()).to_lowercase(),
        "shape": channel.shape(),
    });
    let elements = channel.elements().map(|element| {
        json!({
            "name": element.name,
            "unit": element.unit,
            "min": element.limits.min,
            "max": element.limits.max,
        })
    });
    let elements: Vec<_> = elements.collect();
    if !elements.is_empty() {
        fields["elements"] = elements.into();
    }
    fields
}

/// Describes the rule that decides plans, in a word or two.
pub fn rule(contract: &Contract<'_>) -> String {
    match contract.decision() {
        Decision::Argmax => "argmax".to_owned(),
        Decision::Sample { temperature, .. } => format!("sampling at temperature {temperature}"),
    }
}
