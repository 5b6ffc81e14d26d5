//! What the program image that runs says of itself, in the words of a bundle's contract.
//!
//! Nothing here can fail.

use lads_core::{Contract, Decision};
use serde_json::{Value, json};

/// The fields of the contract that an image holds and that decide what it does.
pub fn of_image(contract: &Contract<'_>) -> Value {
    let decision = match contract.decision() {
        Decision::Argmax => json!({"rule": "argmax"}),
        Decision::Sample { temperature, seed } => {
            json!({"rule": "sample", "temperature": temperature, "seed": seed})
        }
    };
    let beyond = format!("{:?}", contract.beyond()).to_lowercase();
    let actions = contract.actions().map(|element| {
        json!({"name": element.name, "min": element.limits.min, "max": element.limits.max})
    });
    let observations = contract.observations().map(|element| {
        json!({"name": element.name, "min": element.limits.min, "max": element.limits.max})
    });
    let instructions = contract
        .instructions()
        .map(|known| json!({"id": known.id, "text": known.text, "split": known.split}));
    json!({
        "environment": {"id": contract.environment_id(), "version": contract.environment_version()},
        "control_period_s": contract.control_period_s(),
        "horizon": contract.horizon(),
        "codebook": {"size": contract.codebook_len()},
        "context": {"words": contract.words_len(), "steps": contract.context_steps(), "beyond": beyond},
        "decision": decision,
        "observation": observations.collect::<Vec<_>>(),
        "action": actions.collect::<Vec<_>>(),
        "instructions": instructions.collect::<Vec<_>>(),
    })
}

/// The rule that decides plans, in a word or two.
pub fn rule(contract: &Contract<'_>) -> String {
    match contract.decision() {
        Decision::Argmax => "argmax".to_owned(),
        Decision::Sample { temperature, .. } => format!("sampling at temperature {temperature}"),
    }
}
