//! Meaning of a contract's fields: every number in its range, no name twice, and no field that
//! contradicts another.
//!
//! A check is left out where a field that it reads has a fault already.

use std::collections::HashSet;

use super::{Contract, DType, Faults, MAX_LEN, Role, State, StateKind};
use crate::family::RESERVED;

/// Adds all faults of a contract whose form is sound where `faults` does not say otherwise.
pub(super) fn check(contract: &Contract, faults: &mut Faults) {
    let period = contract.control_period_s;
    if !(period.is_finite() && period > 0.0) {
        faults.add(
            "control_period_s",
            format!("is {period}, it must be positive"),
        );
    }
    channels(contract, faults);
    if faults.spare(&["channels", "states"]) {
        states(contract, faults);
    }
    // Before the context, whose length is a multiple of the family's period.
    if faults.spare(&["channels", "family", "context", "network"]) {
        contract.family.check(contract, faults);
    }
    if faults.spare(&["context", "family"]) {
        context(contract, faults);
    }
    if faults.spare(&["channels", "instructions"]) {
        instructions(contract, faults);
    }
    if faults.spare(&["channels", "instructions", "language", "context"]) {
        language(contract, faults);
    }
    if faults.spare(&["instructions", "evaluation"]) {
        evaluation(contract, faults);
    }
}

fn channels(contract: &Contract, faults: &mut Faults) {
    for (i, channel) in contract.channels.iter().enumerate() {
        let at = format!("channels[{i}]");
        if faults.spare(&[&at]) {
            channel.check(&at, faults);
        }
    }
    if !faults.spare(&["channels"]) {
        return;
    }
    let names = contract.channels.iter().map(|c| c.name.as_str());
    distinct("channels", "name", names, faults);
    let count = |role| contract.with(role).count();
    let observations = count(Role::Observation);
    if !(1..=lads_core::MAX_OBSERVATIONS).contains(&observations) {
        faults.add(
            "channels",
            format!(
                "has {observations} observations, it must have 1 to {}",
                lads_core::MAX_OBSERVATIONS
            ),
        );
    }
    let actions = count(Role::Action);
    if actions != 1 {
        faults.add(
            "channels",
            format!("has {actions} actions, it must have one"),
        );
    }
    if count(Role::Instruction) > 1 {
        faults.add("channels", "has more than one instruction");
    }
    for (i, channel) in contract.channels.iter().enumerate() {
        let at = format!("channels[{i}]");
        if channel.role == Role::Observation {
            reserved(&at, &channel.name, faults);
        } else if channel.dtype != DType::F32 {
            faults.add(
                &format!("{at}.dtype"),
                "must be f32: only observations may have other elements",
            );
        }
        if channel.role == Role::Instruction && channel.shape.len() != 2 {
            faults.add(
                &format!("{at}.shape"),
                format!(
                    "is {:?}, an instruction has two axes: words and elements",
                    channel.shape
                ),
            );
        }
    }
}

fn reserved(at: &str, name: &str, faults: &mut Faults) {
    if RESERVED.contains(&name) {
        faults.add(
            &format!("{at}.name"),
            format!("is \"{name}\", which means something else to a graph; give it another name"),
        );
    }
}

fn states(contract: &Contract, faults: &mut Faults) {
    for (i, state) in contract.states.iter().enumerate() {
        let at = format!("states[{i}]");
        reserved(&at, &state.name, faults);
        if contract.channel(&state.name).is_some() {
            faults.add(
                &format!("{at}.name"),
                format!("repeats \"{}\", the name of a channel", state.name),
            );
        }
        check_state(contract, state, &at, faults);
    }
    let names = contract.states.iter().map(|state| state.name.as_str());
    distinct("states", "name", names, faults);
}

fn check_state(contract: &Contract, state: &State, at: &str, faults: &mut Faults) {
    match state.kind {
        StateKind::Plain => {
            let product = |len: usize, &dim| len.checked_mul(dim);
            let len = state.shape.iter().try_fold(1, product);
            let sound = len.is_some_and(|len| (1..=MAX_LEN).contains(&len));
            if state.shape.is_empty() || !sound {
                faults.add(
                    &format!("{at}.shape"),
                    format!("is {:?}, it must have 1 to {MAX_LEN} elements", state.shape),
                );
            }
            if state.source.is_some() {
                faults.add(
                    &format!("{at}.source"),
                    "is not of a plain state: only a ring has a source",
                );
            }
        }
        StateKind::Ring => {
            if !(1..=MAX_LEN).contains(&state.rows) {
                faults.add(
                    &format!("{at}.rows"),
                    format!("is {}, it must be 1 to {MAX_LEN}", state.rows),
                );
            }
            let source = state.source.as_deref().unwrap_or("");
            let mut observations = contract.observations();
            if !observations.any(|channel| channel.name == source) {
                faults.add(
                    &format!("{at}.source"),
                    format!("is \"{source}\", it must name an observation channel"),
                );
            }
        }
    }
}

fn context(contract: &Contract, faults: &mut Faults) {
    let Some(context) = &contract.context else {
        return;
    };
    for (field, len) in [
        ("context.words", context.words),
        ("context.steps", context.steps),
    ] {
        if !(1..=MAX_LEN).contains(&len) {
            faults.add(field, format!("is {len}, it must be 1 to {MAX_LEN}"));
        }
    }
    if let Some(period) = contract.period()
        && !context.steps.is_multiple_of(period)
    {
        faults.add(
            "context.steps",
            format!(
                "is {}, it must be a multiple of the period of {period} control steps: a context that starts again would decide between",
                context.steps
            ),
        );
    }
}

fn instructions(contract: &Contract, faults: &mut Faults) {
    if contract.words().is_none() {
        if !contract.instructions.is_empty() {
            faults.add(
                "instructions",
                "is not empty, and no channel takes an instruction",
            );
        }
        return;
    }
    if !(1..=MAX_LEN).contains(&contract.instructions.len()) {
        let len = contract.instructions.len();
        faults.add(
            "instructions",
            format!("has {len}, it must have 1 to {MAX_LEN}"),
        );
    }
    for (i, known) in contract.instructions.iter().enumerate() {
        if known.text.trim().is_empty() {
            faults.add(&format!("instructions[{i}].text"), "is empty");
        }
    }
    // Texts may repeat: benchmarks ask for the same in other words, and for the same words by other measures.
    let ids = contract.instructions.iter().map(|known| known.id.as_str());
    distinct("instructions", "id", ids, faults);
}

fn language(contract: &Contract, faults: &mut Faults) {
    let Some([words, dim]) = contract.words() else {
        return;
    };
    match &contract.language {
        None => faults.add("language", "is missing, and the policy takes instructions"),
        Some(language) => {
            if language.dim != dim {
                let found = language.dim;
                faults.add(
                    "language.dim",
                    format!("is {found}, the instruction channel's words have {dim} elements"),
                );
            }
            if let Some(acceptance) = &language.acceptance {
                acceptance.check(faults);
            }
        }
    }
    if contract
        .context
        .is_some_and(|context| context.words != words)
    {
        faults.add(
            "context.words",
            format!("is not the instruction channel's {words} words"),
        );
    }
}

fn evaluation(contract: &Contract, faults: &mut Faults) {
    let evaluated = &contract.evaluation.instructions;
    let known = contract.instructions.len();
    if contract.words().is_some() && !evaluated.is_empty() && evaluated.len() != known {
        faults.add(
            "evaluation.instructions",
            format!("has {}, there are {known} instructions", evaluated.len()),
        );
    }
    for (i, known) in evaluated.iter().enumerate() {
        if known.split.trim().is_empty() {
            faults.add(&format!("evaluation.instructions[{i}].split"), "is empty");
        }
    }
}

/// Adds a fault for every name that is empty or stands twice.
pub(super) fn distinct<'a>(
    field: &str,
    part: &str,
    names: impl Iterator<Item = &'a str>,
    faults: &mut Faults,
) {
    let mut seen = HashSet::new();
    for (i, name) in names.enumerate() {
        if name.trim().is_empty() {
            faults.add(&format!("{field}[{i}].{part}"), "is empty");
        } else if !seen.insert(name) {
            faults.add(
                &format!("{field}[{i}].{part}"),
                format!("repeats \"{name}\""),
            );
        }
    }
}
