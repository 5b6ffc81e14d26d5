//! Bounds the rows that an entry can read from its tables: a timestep, a phase, a pass, a selected
//! index or an integer of the caller beyond the last row would stop the policy in the middle of an
//! episode, so it is refused at compile time, with the field of the contract that is too large.

use std::collections::HashMap;

use lads_image::op::{IntSlot, Op, Place};

use crate::contract::Contract;
use crate::error::CompileError;
use crate::family::{Blueprint, Bound, Entry, Keep, Times};
use crate::lower::Lowered;

/// Smallest and largest value of an integer; `None` before the first.
#[derive(Debug, Clone, Copy, Default)]
struct Range(Option<(i64, i64)>);

impl Range {
    fn see(&mut self, value: usize) {
        let value = value as i64;
        let (from, to) = self.0.unwrap_or((value, value));
        self.0 = Some((from.min(value), to.max(value)));
    }
}

/// Ranges of the integers of an entry.
#[derive(Debug, Clone, Copy, Default)]
struct Integers {
    timestep: Range,
    phase: Range,
    pass: Range,
}

/// Ranges of the integers of all entries.
#[derive(Debug)]
pub(crate) struct Reach {
    entries: HashMap<String, Integers>,
}

impl Reach {
    /// Computes the ranges by walking the schedule of the longest context.
    pub fn new(contract: &Contract, blueprint: &Blueprint) -> Self {
        let mut entries: HashMap<String, Integers> = HashMap::new();
        blueprint.walk(contract, |call, entry, timestep| {
            let times = match &call.times {
                Times::Times(times) => *times,
                Times::Rows(ring) => ring_rows(blueprint, ring),
            };
            if !entries.contains_key(&entry.name) {
                entries.insert(entry.name.clone(), Integers::default());
            }
            let Some(integers) = entries.get_mut(&entry.name) else {
                return;
            };
            integers.timestep.see(timestep);
            integers.phase.see(timestep % blueprint.period.max(1));
            integers.pass.see(0);
            integers.pass.see(times.saturating_sub(1));
        });
        Self { entries }
    }

    /// Refuses a table with fewer rows than the schedule reads.
    pub fn check(
        &self,
        contract: &Contract,
        blueprint: &Blueprint,
        entry: &Entry,
        lowered: &Lowered,
    ) -> Result<(), CompileError> {
        let Some(integers) = self.entries.get(&entry.name) else {
            return Ok(());
        };
        for (name, place) in &lowered.inputs {
            let Place::Int(slot) = *place else { continue };
            let bound = blueprint.bind(contract, &entry.name, name, true);
            let Some(chosen) = chooser(contract, blueprint, integers, bound) else {
                continue;
            };
            // The table that ends first comes first: its remedy is one for the others too.
            let mut tables: Vec<_> = tables(lowered, slot).collect();
            tables.sort_by_key(|(rows, shift)| rows - shift);
            for (rows, shift) in tables {
                fits(contract, &chosen, rows, shift).map_err(|problem| CompileError::Entry {
                    entry: entry.name.as_str().into(),
                    problem: problem.into(),
                })?;
            }
        }
        Ok(())
    }
}

fn ring_rows(blueprint: &Blueprint, ring: &str) -> usize {
    let mut states = blueprint.states.iter();
    match states
        .find(|state| state.name == ring)
        .map(|state| state.keep)
    {
        Some(Keep::Ring { rows, .. }) => rows,
        _ => 0,
    }
}

/// Returns the number of rows of every table that an integer indexes, and the number that is added
/// to the integer.
fn tables(lowered: &Lowered, slot: IntSlot) -> impl Iterator<Item = (i64, i64)> {
    lowered.ops.iter().filter_map(move |op| match op {
        Op::GatherRow(op) if op.index == slot => Some((i64::from(op.rows), i64::from(op.shift))),
        _ => None,
    })
}

/// Describes the integer that chooses a row, with its range; `None` if nothing chooses one.
fn chooser(
    contract: &Contract,
    blueprint: &Blueprint,
    integers: &Integers,
    bound: Option<Bound>,
) -> Option<(String, Range)> {
    Some(match bound? {
        Bound::Timestep => ("`timestep`".into(), integers.timestep),
        Bound::Phase => ("`phase`".into(), integers.phase),
        Bound::Pass => ("`pass`".into(), integers.pass),
        Bound::Selected => {
            let scores = blueprint
                .calls
                .iter()
                .find_map(|call| call.select.as_ref())?;
            let state = blueprint
                .states
                .iter()
                .find(|state| state.name == *scores)?;
            let (width, field) = state.width.as_ref()?;
            let what = format!("the selected index (field `{field}`)");
            (what, Range(Some((0, *width as i64 - 1))))
        }
        Bound::Channel(index) => {
            let channel = &contract.channels[index];
            let (min, max) = channel.limits();
            let what = format!("channel `{}` (fields `min` and `max`)", channel.name);
            (what, Range(Some((min.ceil() as i64, max.floor() as i64))))
        }
        Bound::State(_) | Bound::Row(_) | Bound::Cache => return None,
    })
}

fn fits(
    contract: &Contract,
    (what, range): &(String, Range),
    rows: i64,
    shift: i64,
) -> Result<(), String> {
    let timestep = what == "`timestep`";
    let steps = contract.context.map(|context| context.steps);
    if timestep && steps.is_none() {
        return Err(format!(
            "a table of {rows} rows is read by `timestep`, which has no end without the field `context`"
        ));
    }
    let Some((from, to)) = range.0 else {
        return Ok(());
    };
    let (first, last) = (from + shift, to + shift);
    if first < 0 {
        return Err(format!(
            "a table of {rows} rows is read at row {first} when {what} is {from}"
        ));
    }
    if last < rows {
        return Ok(());
    }
    let remedy = match steps {
        Some(steps) if timestep => remedy(contract, steps, steps as i64 - (last + 1 - rows)),
        _ => String::new(),
    };
    Err(format!(
        "a table of {rows} rows is read at row {last} when {what} is {to}{remedy}"
    ))
}

/// Names the longest context of whole periods within a number of steps.
fn remedy(contract: &Contract, steps: usize, within: i64) -> String {
    let period = contract.period().map_or(1, |period| period as i64).max(1);
    let whole = within - within.rem_euclid(period);
    if whole > 0 {
        format!(": field `context.steps` is {steps}, for this table it may be {whole} at most")
    } else {
        format!(
            ": field `context.steps` is {steps}, and the table is shorter than a period of {period} steps"
        )
    }
}
