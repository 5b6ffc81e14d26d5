//! The schedule of a policy as a table: which programs run at which control steps, and their cost.
//!
//! It is computed by walking the steps of a context, so it shows what runs, independent of the
//! image's encoding.

use std::collections::BTreeMap;

use lads_core::Policy;
use lads_image::place::Place as PortPlace;
use lads_image::records::{self, CallRecord, EntryRecord, Event, Repeat, SourceKind, When};
use lads_image::{Chain, Program, Tables};

/// Calls that run together, with their event and its control steps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// Event that makes the calls run.
    pub event: Event,
    /// Control steps at which the calls run; [`Steps::All`] for other events.
    pub steps: Steps,
    /// Calls in the order in which they run.
    pub calls: Vec<Call>,
}

/// Control steps of a context.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Steps {
    /// All control steps.
    All,
    /// The first control step.
    First,
    /// One control step in every so many; the first among them unless it has a place of its own.
    Every(u32),
    /// All control steps that no other [`Place`] of the table covers.
    Other,
}

/// One call of a [`Place`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Call {
    /// Name of the call's entry.
    pub entry: String,
    /// Largest number of runs of the entry.
    pub runs: u32,
    /// Name of the ring whose rows determine the number of runs, if one does.
    pub per_row: Option<String>,
    /// Name of the scores that an index is selected from after the runs, if there are any.
    pub selects: Option<String>,
    /// Names of the states that are cleared before the runs.
    pub clears: Vec<String>,
    /// Cost of all runs.
    pub cost: Cost,
}

/// Cost of calls at the largest context.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Cost {
    /// Number of multiply-adds; an operation that works element by element counts one for each.
    pub multiply_adds: u64,
    /// Number of bytes of weights that are read.
    pub weight_bytes: u64,
    /// Number of bytes of states that are read, and of KV caches that are written.
    pub state_bytes: u64,
}

impl Cost {
    fn and(self, other: Self) -> Self {
        Self {
            multiply_adds: self.multiply_adds.saturating_add(other.multiply_adds),
            weight_bytes: self.weight_bytes.saturating_add(other.weight_bytes),
            state_bytes: self.state_bytes.saturating_add(other.state_bytes),
        }
    }

    fn times(self, runs: u32) -> Self {
        let runs = u64::from(runs);
        Self {
            multiply_adds: self.multiply_adds.saturating_mul(runs),
            weight_bytes: self.weight_bytes.saturating_mul(runs),
            state_bytes: self.state_bytes.saturating_mul(runs),
        }
    }
}

impl Place {
    /// Returns the cost of all calls of the place.
    pub fn cost(&self) -> Cost {
        let costs = self.calls.iter().map(|call| call.cost);
        costs.fold(Cost::default(), Cost::and)
    }
}

/// Returns the number of control steps after which the schedule repeats, not counting the first; 1
/// if nothing is periodic.
pub fn period(tables: &Tables) -> u32 {
    let steps = tables.calls().filter(|call| call.event == Event::Step);
    let every = steps.filter(|call| call.when == When::Every && call.every > 0);
    every.fold(1, |period, call| {
        let common = gcd(period, call.every);
        (period / common).saturating_mul(call.every)
    })
}

/// Returns the number of control steps from one plan to the next, be it an index or a vector; `None` for a policy without plans.
pub fn plan_period(policy: &Policy<'_>) -> Option<usize> {
    let tables = Tables::new(policy.image()).ok()?;
    let period = period(&tables) as usize;
    (period > 1 || policy.index_count() > 0).then_some(period)
}

fn gcd(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { gcd(b, a % b) }
}

/// Returns the cost of one run of an entry.
pub fn cost(tables: &Tables, entry: &EntryRecord) -> Cost {
    let ops = tables.ops(entry);
    let work = Program::trusted(ops, entry.arena_len, entry.tokens, 0).work();
    let of_state = tables.inputs(entry).filter_map(|port| match port {
        records::PortRecord {
            source,
            place: PortPlace::Span(span),
            ..
        } if matches!(source.kind, SourceKind::State | SourceKind::Row) => {
            Some(u64::from(span.len))
        }
        _ => None,
    });
    let state_words = of_state.fold(work.state_words, u64::saturating_add);
    Cost {
        multiply_adds: work.multiply_adds,
        weight_bytes: work.weight_words.saturating_mul(4),
        state_bytes: state_words.saturating_mul(4),
    }
}

/// Returns all places of a policy, in the order of events and, among control steps, of the first at
/// which they run.
pub fn places(policy: &Policy) -> Vec<Place> {
    // A policy's image was checked.
    let Ok(tables) = Tables::new(policy.image()) else {
        return vec![];
    };
    let mut places = vec![];
    for event in [Event::Instruct, Event::Step, Event::Follow, Event::Encode] {
        if event != Event::Step {
            let calls: Vec<_> = tables.due(event, 0).collect();
            places.extend(place(&tables, event, Steps::All, &calls));
            continue;
        }
        let last = match policy.contract().context_steps() {
            Some(steps) => steps as u32,
            None => period(&tables).saturating_mul(2).max(2),
        };
        for (steps, timestep) in groups(&tables, last) {
            let calls: Vec<_> = tables.due(event, timestep).collect();
            places.extend(place(&tables, event, steps, &calls));
        }
    }
    places
}

/// Groups the steps of a context at which the same calls run, each group with its first step.
fn groups(tables: &Tables, last: u32) -> Vec<(Steps, u32)> {
    let mut groups: BTreeMap<Vec<usize>, Vec<u32>> = BTreeMap::new();
    for timestep in 0..last {
        let mut chain = Chain::default();
        let mut runs = |call: &CallRecord| call.event == Event::Step && chain.runs(call, timestep);
        let calls = tables.calls().enumerate();
        let key = calls.filter_map(|(i, call)| runs(&call).then_some(i));
        groups.entry(key.collect()).or_default().push(timestep);
    }
    let mut named: Vec<_> = groups
        .into_values()
        .map(|steps| (name(&steps, last), steps.first().copied().unwrap_or(0)))
        .collect();
    named.sort_by_key(|&(_, first)| first);
    named
}

fn name(steps: &[u32], last: u32) -> Steps {
    if steps.len() == last as usize {
        return Steps::All;
    }
    let later = steps.strip_prefix(&[0]).unwrap_or(steps);
    let Some(&every) = later.first() else {
        return Steps::First;
    };
    let multiples = (1..)
        .map(|i| every * i)
        .take_while(|&multiple| multiple < last);
    if multiples.eq(later.iter().copied()) && every > 1 {
        Steps::Every(every)
    } else {
        Steps::Other
    }
}

fn place(tables: &Tables, event: Event, steps: Steps, calls: &[CallRecord]) -> Option<Place> {
    let state = |i: u32| Some(tables.text(tables.state(i as usize)?.name).to_owned());
    let calls = calls.iter().filter_map(|call| {
        let entry = tables.entry(call.entry as usize)?;
        let (runs, per_row) = match call.repeat {
            Repeat::Times => (call.count, None),
            Repeat::Rows => (tables.state(call.count as usize)?.rows, state(call.count)),
        };
        Some(Call {
            entry: tables.text(entry.name).to_owned(),
            runs,
            per_row,
            selects: state(call.select),
            clears: tables
                .clears(call)
                .iter()
                .filter_map(|&cleared| state(cleared))
                .collect(),
            cost: cost(tables, &entry).times(runs),
        })
    });
    let calls: Vec<_> = calls.collect();
    (!calls.is_empty()).then_some(Place {
        event,
        steps,
        calls,
    })
}

#[cfg(test)]
mod tests {
    use super::{Steps, gcd, name};

    #[test]
    fn steps_are_named_by_where_they_come() {
        let all: Vec<u32> = (0..12).collect();
        assert_eq!(name(&all, 12), Steps::All);
        assert_eq!(name(&[0], 12), Steps::First);
        assert_eq!(name(&[0, 4, 8], 12), Steps::Every(4));
        assert_eq!(name(&[4, 8], 12), Steps::Every(4));
        assert_eq!(name(&[1, 2, 3, 5, 6, 7, 9, 10, 11], 12), Steps::Other);
        assert_eq!(name(&all[1..], 12), Steps::Other);
        assert_eq!(name(&[0, 4], 12), Steps::Other, "8 is missing");
    }

    #[test]
    fn common_divisors() {
        assert_eq!((gcd(12, 18), gcd(1, 7), gcd(5, 5)), (6, 1, 5));
    }
}
