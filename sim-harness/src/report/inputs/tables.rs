//! Reads tables of `python -m lads_exporter table`: a system of each row with a finished seed.

use std::collections::BTreeMap;

use lads_proof::metrics::{Interval, K_RATES, Score, wilson};
use serde::Deserialize;
use serde_json::Value;

use super::{Found, InputError, TABLES};
use crate::report::compare::{Split, System};
use crate::report::figures::Behaviour;

/// Versions of a file of tables that are read.
pub(super) const VERSION: u32 = 1;

/// Why a table has no figures of what a policy did.
const A_TABLE: &str = "a table holds success rates only; give a bundle";

#[derive(Deserialize)]
struct TablesFile {
    tables: BTreeMap<String, Value>,
}

#[derive(Deserialize)]
struct TableFound {
    environment: String,
    measure: String,
    protocol: Protocol,
    tracks: Vec<TrackFound>,
}

#[derive(Deserialize)]
struct Protocol {
    episodes_per_instruction: u32,
    seed: u64,
    noise: String,
}

#[derive(Deserialize)]
struct TrackFound {
    name: String,
    rows: Vec<RowFound>,
}

#[derive(Deserialize)]
struct RowFound {
    title: String,
    seeds: Vec<u64>,
    #[serde(default)]
    sweep: BTreeMap<String, f64>,
    /// Absent until a seed is finished.
    splits: Option<BTreeMap<String, SplitFound>>,
}

#[derive(Deserialize)]
struct SplitFound {
    episodes: usize,
    success: f64,
    success_interval: Interval,
    n_rate: f64,
    n_rate_standard_error: f64,
    k_rate: [f64; K_RATES],
}

impl SplitFound {
    /// Scores of all seeds' episodes together. Every seed ran as many, so a mean of rates is the rate of all, and times the number of
    /// episodes it is the count that an interval needs.
    fn score(&self) -> Score {
        let count = |rate: f64| (rate * self.episodes as f64).round() as usize;
        Score {
            episodes: self.episodes,
            n_rate: Some(self.n_rate),
            n_rate_standard_error: Some(self.n_rate_standard_error),
            k_rate: self.k_rate.map(Some),
            k_rate_interval: self.k_rate.map(|rate| wilson(count(rate), self.episodes)),
            full_success: Some(self.success),
            full_success_interval: self.success_interval,
            full_success_count: count(self.success),
            un_instructed: 0,
        }
    }
}

/// Reads the systems of a file's tables, or of the one that is asked for.
pub(super) fn read(value: Value, name: &str, asked: Option<&str>) -> Result<Found, InputError> {
    let format = TABLES;
    let file: TablesFile =
        serde_json::from_value(value).map_err(|wrong| InputError::Field { format, wrong })?;
    let mut found = Found::new();
    let tables: Vec<String> = file.tables.keys().cloned().collect();
    for (table, content) in file.tables {
        if asked.is_some_and(|asked| table != asked) {
            continue;
        }
        let content: TableFound =
            serde_json::from_value(content).map_err(|wrong| InputError::Table {
                table: table.clone(),
                wrong,
            })?;
        let systems = content.systems(&table, name);
        if !systems.is_empty() {
            let same = found.entry(content.environment).or_default();
            same.extend(systems);
        }
    }
    if found.is_empty() {
        return Err(InputError::NoTable {
            asked: asked.map(str::to_owned),
            tables: if tables.is_empty() {
                "none".to_owned()
            } else {
                tables.join(", ")
            },
        });
    }
    Ok(found)
}

impl TableFound {
    fn systems(&self, table: &str, file: &str) -> Vec<System> {
        let Protocol {
            episodes_per_instruction: episodes,
            seed,
            noise,
        } = &self.protocol;
        let system = |track: &TrackFound, row: &RowFound| {
            let splits = row.splits.as_ref()?.iter();
            Some(System {
                name: row.title.clone(),
                file: file.to_owned(),
                group: Some(format!("{table}/{}", track.name)),
                facts: format!(
                    "table {table}, track {}, noise {noise}, seed {seed}, {episodes} episodes of each instruction by every policy",
                    track.name
                ),
                policies: row.seeds.len(),
                sweep: row.sweep.clone(),
                splits: splits
                    .map(|(name, split)| Split {
                        name: name.clone(),
                        score: split.score(),
                        // The measure says whether K-rates tell more than success; instructions are not listed.
                        commanded: (self.measure == "n_rate").then_some(K_RATES),
                    })
                    .collect(),
                behaviour: Behaviour {
                    compositions: Err(A_TABLE.to_owned()),
                    words: Err(A_TABLE.to_owned()),
                },
            })
        };
        let tracks = self.tracks.iter();
        tracks
            .flat_map(|track| track.rows.iter().filter_map(move |row| system(track, row)))
            .collect()
    }
}
