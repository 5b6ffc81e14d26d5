//! Reads results of `lads-run --json`: one system, whose splits have the episodes that its instructions list.

use std::collections::BTreeMap;

use lads_proof::metrics::Score;
use serde::Deserialize;
use serde_json::Value;

use super::{Found, InputError, facts, short};
use crate::report::compare::{Split, System};
use crate::report::figures::Behaviour;
use crate::report::words::Counts;
use crate::results::FORMAT;

/// Why results have no figures of control steps.
const RESULTS: &str = "results hold no control steps; give the bundle";

#[derive(Deserialize)]
struct ResultsFile {
    environment: Id,
    bundle_sha256: String,
    seed: u64,
    noise: String,
    decision: Decision,
    episodes_per_instruction: u32,
    splits: BTreeMap<String, Score>,
    instructions: Vec<InstructionFound>,
}

#[derive(Deserialize)]
struct Id {
    id: String,
}

#[derive(Deserialize)]
struct Decision {
    rule: String,
}

#[derive(Deserialize)]
struct InstructionFound {
    text: String,
    split: String,
    completions: Vec<Value>,
    runs: Vec<RunFound>,
}

#[derive(Deserialize)]
struct RunFound {
    plans: Vec<u32>,
}

/// Reads the one system of a results file.
pub(super) fn read(value: Value, name: &str) -> Result<Found, InputError> {
    let format = FORMAT;
    let file: ResultsFile =
        serde_json::from_value(value).map_err(|wrong| InputError::Field { format, wrong })?;
    // JSON's order of splits is the alphabet's; the instructions have the contract's.
    let mut names: Vec<&str> = Vec::new();
    for instruction in &file.instructions {
        if !names.contains(&instruction.split.as_str()) {
            names.push(&instruction.split);
        }
    }
    for split in names
        .iter()
        .copied()
        .chain(file.splits.keys().map(String::as_str))
    {
        let own = file.instructions.iter().filter(|it| it.split == split);
        let listed = own.map(|it| it.runs.len()).sum();
        let scored = file.splits.get(split).map_or(0, |score| score.episodes);
        if scored != listed {
            let split = split.to_owned();
            return Err(InputError::Split {
                split,
                scored,
                listed,
            });
        }
    }
    let split = |&name: &&str| {
        let own = file.instructions.iter().filter(|it| it.split == name);
        Some(Split {
            name: name.to_owned(),
            score: file.splits.get(name)?.clone(),
            commanded: own.map(|it| it.completions.len()).max(),
        })
    };
    let decided = file.instructions.iter().map(|instruction| {
        let plans = instruction.runs.iter().flat_map(|run| &run.plans).copied();
        (instruction.text.as_str(), plans.collect())
    });
    let system = System {
        name: short(name, ".results.json"),
        file: name.to_owned(),
        group: None,
        facts: facts(
            &file.bundle_sha256,
            (&file.noise, file.seed),
            &file.decision.rule,
            file.episodes_per_instruction,
        ),
        policies: 1,
        sweep: BTreeMap::new(),
        splits: names.iter().filter_map(split).collect(),
        behaviour: Behaviour {
            compositions: Err(RESULTS.to_owned()),
            words: Behaviour::words(Counts::of(decided)),
        },
    };
    Ok(Found::from([(file.environment.id, vec![system])]))
}
