//! Meaning of a contract's fields: every number in its range, no name twice, and no field that
//! contradicts another.
//!
//! A check is left out where a field that it reads could not be read ([`Faults::sound`]).

use std::collections::HashSet;

use super::{Channel, Contract, DType, Faults, MAX_LEN, Role, State, StateKind};
use crate::family::RESERVED;

/// Adds all faults of a contract whose form is sound where `faults` does not say otherwise.
pub(super) fn check(contract: &Contract, faults: &mut Faults) {
    let period = contract.control_period_s;
    if faults.sound(&["control_period_s"]) && !(period.is_finite() && period > 0.0) {
        faults.add(
            "control_period_s",
            format!("is {period}, it must be positive"),
        );
    }
    channels(contract, faults);
    states(contract, faults);
    // Before the context, whose length is a multiple of the family's period.
    if faults.sound(&["family.kind"]) {
        contract.family.check(contract, faults);
    }
    context(contract, faults);
    instructions(contract, faults);
    language(contract, faults);
    evaluation(contract, faults);
}

/// Returns whether a field of every element of a list is the contract's own.
fn all_sound(list: &str, len: usize, field: &str, faults: &Faults) -> bool {
    let mut each = (0..len).map(|i| format!("{list}[{i}].{field}"));
    faults.counted(list) && each.all(|field| faults.sound(&[&field]))
}

/// Returns whether nothing is wrong with a field of any element of a list.
pub(crate) fn all_free(list: &str, len: usize, field: &str, faults: &Faults) -> bool {
    let mut each = (0..len).map(|i| format!("{list}[{i}].{field}"));
    faults.counted(list) && each.all(|field| faults.free(&[&field]))
}

/// Returns whether it is known which role every channel has.
pub(crate) fn roles_are_known(contract: &Contract, faults: &Faults) -> bool {
    all_sound("channels", contract.channels.len(), "role", faults)
}

fn channels(contract: &Contract, faults: &mut Faults) {
    for (i, channel) in contract.channels.iter().enumerate() {
        let at = format!("channels[{i}]");
        channel.check(&at, faults);
        in_its_role(channel, &at, faults);
    }
    let names = contract.channels.iter().map(|c| c.name.as_str());
    distinct("channels", "name", names, faults);
    if !roles_are_known(contract, faults) {
        return;
    }
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
}

fn in_its_role(channel: &Channel, at: &str, faults: &mut Faults) {
    let [role, name, dtype, shape] =
        ["role", "name", "dtype", "shape"].map(|field| format!("{at}.{field}"));
    if channel.role == Role::Observation && faults.sound(&[&role, &name]) {
        reserved(&name, &channel.name, faults);
    }
    if channel.role != Role::Observation
        && channel.dtype != DType::F32
        && faults.sound(&[&role, &dtype])
    {
        faults.add(
            &dtype,
            "must be f32: only observations may have other elements",
        );
    }
    if channel.role == Role::Instruction
        && channel.shape.len() != 2
        && faults.sound(&[&role, &shape])
    {
        let found = &channel.shape;
        faults.add(
            &shape,
            format!("is {found:?}, an instruction has two axes: words and elements"),
        );
    }
}

fn reserved(field: &str, name: &str, faults: &mut Faults) {
    if RESERVED.contains(&name) {
        faults.add(
            field,
            format!("is \"{name}\", which means something else to a graph; give it another name"),
        );
    }
}

fn states(contract: &Contract, faults: &mut Faults) {
    let channels = contract.channels.len();
    let named = all_sound("channels", channels, "name", faults);
    for (i, state) in contract.states.iter().enumerate() {
        let at = format!("states[{i}]");
        let name = format!("{at}.name");
        if faults.sound(&[&name]) {
            reserved(&name, &state.name, faults);
            if named && contract.channel(&state.name).is_some() {
                faults.add(
                    &name,
                    format!("repeats \"{}\", the name of a channel", state.name),
                );
            }
        }
        check_state(contract, state, &at, faults);
    }
    let names = contract.states.iter().map(|state| state.name.as_str());
    distinct("states", "name", names, faults);
}

fn check_state(contract: &Contract, state: &State, at: &str, faults: &mut Faults) {
    let [kind, shape, rows, source] =
        ["kind", "shape", "rows", "source"].map(|field| format!("{at}.{field}"));
    if !faults.sound(&[&kind]) {
        return;
    }
    match state.kind {
        StateKind::Plain => {
            let product = |len: usize, &dim| len.checked_mul(dim);
            let len = state.shape.iter().try_fold(1, product);
            let fits = len.is_some_and(|len| (1..=MAX_LEN).contains(&len));
            if faults.sound(&[&shape]) && (state.shape.is_empty() || !fits) {
                faults.add(
                    &shape,
                    format!("is {:?}, it must have 1 to {MAX_LEN} elements", state.shape),
                );
            }
            if faults.sound(&[&source]) && state.source.is_some() {
                faults.add(&source, "is not of a plain state: only a ring has a source");
            }
        }
        StateKind::Ring => {
            if faults.sound(&[&rows]) && !(1..=MAX_LEN).contains(&state.rows) {
                faults.add(
                    &rows,
                    format!("is {}, it must be 1 to {MAX_LEN}", state.rows),
                );
            }
            let channels = contract.channels.len();
            let known = all_sound("channels", channels, "name", faults)
                && roles_are_known(contract, faults);
            let named = state.source.as_deref().unwrap_or("");
            let mut observations = contract.observations();
            if known
                && faults.sound(&[&source])
                && !observations.any(|channel| channel.name == named)
            {
                faults.add(
                    &source,
                    format!("is \"{named}\", it must name an observation channel"),
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
        if faults.sound(&[field]) && !(1..=MAX_LEN).contains(&len) {
            faults.add(field, format!("is {len}, it must be 1 to {MAX_LEN}"));
        }
    }
    if let Some(period) = contract.period()
        && faults.sound(&["context.steps"])
        && faults.free(&["family.kind", "family.horizon"])
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
    let known = contract.instructions.len();
    for (i, known) in contract.instructions.iter().enumerate() {
        let text = format!("instructions[{i}].text");
        if faults.sound(&[&text]) && known.text.trim().is_empty() {
            faults.add(&text, "is empty");
        }
    }
    // Texts may repeat: benchmarks ask for the same in other words, and for the same words by other measures.
    let ids = contract.instructions.iter().map(|known| known.id.as_str());
    distinct("instructions", "id", ids, faults);
    if !(roles_are_known(contract, faults) && faults.counted("instructions")) {
        return;
    }
    if contract.with(Role::Instruction).next().is_none() {
        if known > 0 {
            faults.add(
                "instructions",
                "is not empty, and no channel takes an instruction",
            );
        }
    } else if !(1..=MAX_LEN).contains(&known) {
        faults.add(
            "instructions",
            format!("has {known}, it must have 1 to {MAX_LEN}"),
        );
    }
}

fn language(contract: &Contract, faults: &mut Faults) {
    if let Some(acceptance) = contract.language.as_ref().and_then(|l| l.acceptance) {
        acceptance.check(faults);
    }
    let mut channels = contract.channels.iter();
    let taken = channels.position(|channel| channel.role == Role::Instruction);
    let Some(index) = taken.filter(|_| roles_are_known(contract, faults)) else {
        return;
    };
    if contract.language.is_none() && faults.sound(&["language"]) {
        faults.add("language", "is missing, and the policy takes instructions");
    }
    let shape = format!("channels[{index}].shape");
    let Some([words, dim]) = contract.words().filter(|_| faults.free(&[&shape])) else {
        return;
    };
    if let Some(language) = &contract.language
        && language.dim != dim
        && faults.sound(&["language.dim"])
    {
        let found = language.dim;
        faults.add(
            "language.dim",
            format!("is {found}, the instruction channel's words have {dim} elements"),
        );
    }
    if let Some(context) = contract.context
        && context.words != words
        && faults.sound(&["context.words"])
    {
        faults.add(
            "context.words",
            format!("is not the instruction channel's {words} words"),
        );
    }
}

fn evaluation(contract: &Contract, faults: &mut Faults) {
    let list = "evaluation.instructions";
    let evaluated = &contract.evaluation.instructions;
    let known = contract.instructions.len();
    if faults.counted(list)
        && faults.counted("instructions")
        && !evaluated.is_empty()
        && known > 0
        && evaluated.len() != known
    {
        faults.add(
            list,
            format!("has {}, there are {known} instructions", evaluated.len()),
        );
    }
    for (i, known) in evaluated.iter().enumerate() {
        let split = format!("{list}[{i}].split");
        if faults.sound(&[&split]) && known.split.trim().is_empty() {
            faults.add(&split, "is empty");
        }
    }
}

/// Adds a fault for every name of a list that is empty or stands twice.
pub(super) fn distinct<'a>(
    list: &str,
    part: &str,
    names: impl Iterator<Item = &'a str>,
    faults: &mut Faults,
) {
    let mut seen = HashSet::new();
    for (i, name) in names.enumerate() {
        let field = format!("{list}[{i}].{part}");
        if !faults.sound(&[&field]) {
            continue;
        }
        if name.trim().is_empty() {
            faults.add(&field, "is empty");
        } else if !seen.insert(name) {
            faults.add(&field, format!("repeats \"{name}\""));
        }
    }
}
