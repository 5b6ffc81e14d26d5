//! The contract of the bundle, as JSON.

use serde_json::{Value, json};

use crate::build::Kept;
use crate::model::Model;
use crate::plan::{Channel, Element, Plan};
use crate::robot::QuaternionOrder;

/// Formats the contract; it names only the digests of the files, because their other content may be
/// private.
pub(crate) fn contract(models: &[Model], plan: &Plan, states: &[Kept]) -> String {
    let mut channels: Vec<Value> = plan.channels.iter().map(observation).collect();
    channels.push(json!({
        "name": "action",
        "role": "action",
        "dtype": "f32",
        "shape": [plan.action.elements.len()],
        "reference": plan.action.reference,
        "elements": elements(&plan.action.elements),
    }));
    let states: Vec<Value> = states.iter().map(state).collect();
    let files: Vec<Value> = models
        .iter()
        .map(|model| json!({ "sha256": model.sha256 }))
        .collect();
    let (id, version) = &plan.environment;
    let contract = json!({
        "version": lads_compiler::contract::CONTRACT_VERSION,
        "family": { "kind": "plain" },
        "environment": { "id": id, "version": version },
        "control_period_s": plan.period,
        "channels": channels,
        "states": states,
        "provenance": { "imported": files },
    });
    contract.to_string()
}

fn observation(channel: &Channel) -> Value {
    let mut value = json!({
        "name": channel.name,
        "role": "observation",
        "dtype": "f32",
        "shape": [channel.elements.len()],
        "elements": elements(&channel.elements),
    });
    if let Some(order) = channel.quaternion_order {
        value["quaternion_order"] = match order {
            QuaternionOrder::Wxyz => "wxyz".into(),
            QuaternionOrder::Xyzw => "xyzw".into(),
        };
    }
    value
}

fn elements(elements: &[Element]) -> Vec<Value> {
    let element = |element: &Element| {
        let mut value = json!({
            "name": element.name,
            "unit": element.unit,
            "min": element.min,
            "max": element.max,
        });
        for (key, said) in [
            ("joint", element.joint.clone().map(Value::from)),
            ("interface", element.interface.clone().map(Value::from)),
            ("stiffness", element.stiffness.map(Value::from)),
            ("damping", element.damping.map(Value::from)),
        ] {
            if let Some(said) = said {
                value[key] = said;
            }
        }
        value
    };
    elements.iter().map(element).collect()
}

fn state(kept: &Kept) -> Value {
    match kept {
        Kept::Plain { name, shape } => json!({
            "name": name, "kind": "plain", "shape": shape, "cleared_by": "episode",
        }),
        Kept::Ring { name, rows, source } => json!({
            "name": name, "kind": "ring", "rows": rows, "source": source, "fill": "first", "cleared_by": "episode",
        }),
    }
}
