//! Report of `lads inspect` as one JSON object; lengths count elements, sizes are in bytes.

use lads_core::{Channel, Decision, Element, GuardedController, KnownInstruction, Noise};
use lads_host::schedule::{Call, Cost, Place, Steps};
use lads_image::records::{EntryRecord, Event};
use serde_json::{Value, json};

use super::{Report, State, beyond, bytes, dtype, event, quaternions, role, steps};

impl Report<'_> {
    /// Formats everything as one JSON object.
    pub fn json(&self) -> Value {
        let contract = self.policy.contract();
        let golden = self.policy.golden();
        json!({
            "file": self.path.display().to_string(),
            "form": self.form(),
            "bundle_sha256": contract.bundle_sha256(),
            "stored": lads_host::stored(&self.policy),
            "contract": self.contract_json(),
            "states": self.states().map(|state| state_json(&state)).collect::<Vec<_>>(),
            "entries": self.entries().map(|entry| self.entry_json(&entry)).collect::<Vec<_>>(),
            "schedule": self.places.iter().map(place_json).collect::<Vec<_>>(),
            "worst_multiply_adds": contract.worst_work(),
            "sizes": {
                "image_bytes": self.policy.image_bytes(),
                "weights_bytes": self.weights_bytes(),
                "workspace_bytes": lads_ffi::workspace_bytes(&self.policy),
                "arena_bytes": bytes(self.policy.arena_len()),
                "state_bytes": bytes(self.policy.state_len()),
                "controller_bytes": Self::controller_bytes(),
                "guard_bytes": bytes(GuardedController::memory_len(&self.policy)),
                "stack_bytes": lads_ffi::stack_bytes(&self.policy),
            },
            "golden_steps": golden.map(|golden| golden.len()),
            "golden_tolerance": golden.map(|golden| decimal(golden.tolerance())),
            "missing": { "operators": [], "contract": [] },
        })
    }

    fn contract_json(&self) -> Value {
        let contract = self.policy.contract();
        let language = contract.instruction_channel().map(|_| {
            json!({
                "encoder": contract.encoder(),
                "sha256": contract.encoder_sha256(),
                "dim": contract.word_dim(),
                "acceptance": decimal(contract.acceptance()),
            })
        });
        let words = |known: &KnownInstruction| known.words.len() / contract.word_dim().max(1);
        let instruction =
            |known| json!({ "id": known_id(&known), "text": known.text, "words": words(&known) });
        json!({
            "family": contract.family(),
            "environment": { "id": contract.environment_id(), "version": contract.environment_version() },
            "control_period_s": decimal(contract.control_period_s()),
            "channels": contract.channels().map(|channel| channel_json(&channel)).collect::<Vec<_>>(),
            "indices": self.policy.index_count(),
            "decision": decision_json(contract.decision()),
            "noise": noise_json(contract.noise()),
            "noise_elements": self.policy.noise_len(),
            "context": {
                "words": contract.words_len(),
                "steps": contract.context_steps(),
                "beyond": contract.context_steps().map(|_| beyond(contract.beyond())),
            },
            "language": language,
            "instructions": contract.instructions().map(instruction).collect::<Vec<_>>(),
        })
    }

    fn entry_json(&self, entry: &EntryRecord) -> Value {
        let port = |port: lads_image::records::PortRecord| json!({ "name": self.tables.text(port.name), "source": self.source(&port) });
        let cost = self.cost(entry);
        json!({
            "name": self.tables.text(entry.name),
            "ops": entry.ops_len,
            "arena_bytes": bytes(entry.arena_len as usize),
            "tokens": entry.tokens,
            "cache": self.cache(entry),
            "inputs": self.tables.inputs(entry).map(port).collect::<Vec<_>>(),
            "outputs": self.tables.outputs(entry).map(port).collect::<Vec<_>>(),
            "multiply_adds": cost.multiply_adds,
            "weight_bytes": cost.weight_bytes,
            "state_bytes": cost.state_bytes,
        })
    }
}

fn known_id<'a>(known: &KnownInstruction<'a>) -> &'a str {
    known.id
}

fn state_json(state: &State<'_>) -> Value {
    json!({
        "name": state.name,
        "kind": state.kind(),
        "rows": state.record.rows,
        "width": state.record.width,
        "scope": state.scope(),
        "cleared_by_calls": state.cleared,
        "bytes": state.bytes(),
    })
}

fn place_json(place: &Place) -> Value {
    let Cost {
        multiply_adds,
        weight_bytes,
        state_bytes,
    } = place.cost();
    let every = match place.steps {
        Steps::Every(every) => Some(every),
        _ => None,
    };
    json!({
        "event": event(place.event),
        "steps": (place.event == Event::Step).then(|| steps(place.steps)),
        "every": every,
        "calls": place.calls.iter().map(call_json).collect::<Vec<_>>(),
        "multiply_adds": multiply_adds,
        "weight_bytes": weight_bytes,
        "state_bytes": state_bytes,
    })
}

fn call_json(call: &Call) -> Value {
    json!({
        "entry": call.entry,
        "runs": call.runs,
        "per_row_of": call.per_row,
        "selects_from": call.selects,
        "clears": call.clears,
        "multiply_adds": call.cost.multiply_adds,
        "weight_bytes": call.cost.weight_bytes,
        "state_bytes": call.cost.state_bytes,
    })
}

fn channel_json(channel: &Channel<'_>) -> Value {
    let elements: Vec<_> = channel.elements().map(element_json).collect();
    let alike = channel.limits().next().filter(|_| elements.is_empty());
    json!({
        "name": channel.name(),
        "role": role(channel.role()),
        "dtype": dtype(channel.dtype()),
        "shape": channel.shape(),
        "quaternion_order": quaternions(channel.quaternion_order()),
        "reference": channel.reference(),
        "min": alike.map(|limits| decimal(limits.min)),
        "max": alike.map(|limits| decimal(limits.max)),
        "elements": elements,
    })
}

fn element_json(element: Element<'_>) -> Value {
    // Through the shortest decimal form: 0.16_f32 is 0.16 in the JSON too.
    json!({
        "name": element.name,
        "unit": element.unit,
        "joint": element.joint,
        "interface": element.interface,
        "scale": decimal(element.scale),
        "offset": decimal(element.offset),
        "physical_unit": element.physical_unit,
        "min": decimal(element.limits.min),
        "max": decimal(element.limits.max),
    })
}

fn decision_json(decision: Decision) -> Value {
    match decision {
        Decision::Argmax => json!({ "rule": "argmax" }),
        Decision::Sample { temperature, seed } => {
            json!({ "rule": "sample", "temperature": decimal(temperature), "seed": seed })
        }
    }
}

fn noise_json(noise: Noise) -> Value {
    match noise {
        Noise::Zero => json!({ "rule": "zero" }),
        Noise::Seeded { seed } => json!({ "rule": "seeded", "seed": seed }),
    }
}

/// Converts an f32 to the f64 of its shortest decimal form.
fn decimal(value: f32) -> f64 {
    value
        .to_string()
        .parse()
        .unwrap_or_else(|_| f64::from(value))
}
