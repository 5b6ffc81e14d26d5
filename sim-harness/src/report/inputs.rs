//! Files of numbers that a comparison takes: results of `lads-run --json`, and tables of `python -m lads_exporter table`.
//!
//! Only the fields that are needed are read, so that a file with more of them is taken too, and only the tables that are asked for. What can
//! fail: a file that cannot be read, is no JSON, is of another format or version, or has no scores or impossible ones.

mod results;
mod tables;

use std::collections::BTreeMap;
use std::io;
use std::path::Path;

use serde_json::Value;
use thiserror::Error;

use super::compare::System;
use crate::results::{FORMAT, FORMAT_VERSION};

/// Value of the `format` of a file of tables.
const TABLES: &str = "lads-tables";

/// What to do about one table of a file that cannot be read.
const REMAKE: &str = "write it again with make table, or name another with --table";

/// Why a file is not taken.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum InputError {
    /// The file cannot be read.
    #[error("it cannot be read ({0})")]
    Read(io::Error),
    /// The file is no JSON.
    #[error("it is not JSON ({0}); give a bundle, results of lads-run --json, or tables.json")]
    Json(serde_json::Error),
    /// The file is of another format.
    #[error(
        "its format is {found}, not {FORMAT} (lads-run --json) or {TABLES} (python -m lads_exporter table)"
    )]
    Format {
        /// What the file says.
        found: String,
    },
    /// The file's version is unknown.
    #[error("it is {format} of version {found}, and this program reads {read}; make it again")]
    Version {
        /// The file's format.
        format: &'static str,
        /// What the file says.
        found: String,
        /// Version that is read.
        read: u32,
    },
    /// A field is missing or of another kind.
    #[error("it is a damaged {format} file ({wrong}); make it again")]
    Field {
        /// The file's format.
        format: &'static str,
        /// Where the form is another one.
        wrong: serde_json::Error,
    },
    /// A table is missing something or has another kind.
    #[error("its table {table} is damaged or of an older version ({wrong}); {REMAKE}")]
    Table {
        /// Name of the table.
        table: String,
        /// Where the form is another one.
        wrong: serde_json::Error,
    },
    /// Scores that no episodes have.
    #[error("its scores of {of} are impossible ({wrong}); make it again")]
    Score {
        /// System and split.
        of: String,
        /// The field that is wrong.
        wrong: String,
    },
    /// No episode was run.
    #[error("'{of}' has no split with episodes, so there is nothing to compare; make it again")]
    Empty {
        /// Name of the system.
        of: String,
    },
    /// The splits are not those of the instructions.
    #[error(
        "its split '{split}' has {scored} episodes in its scores and {listed} in its instructions; make it again"
    )]
    Split {
        /// Name of the split.
        split: String,
        /// Number of episodes by the scores.
        scored: usize,
        /// Number of episodes that are listed.
        listed: usize,
    },
    /// There is no table to compare.
    #[error("it has no table{} with a finished system; it has {tables}", named(asked.as_deref()))]
    NoTable {
        /// Name that was asked for, if one was.
        asked: Option<String>,
        /// Names of the file's tables.
        tables: String,
    },
}

/// Returns a name in quotes after a space; nothing where there is none.
fn named(name: Option<&str>) -> String {
    name.map_or_else(String::new, |name| format!(" '{name}'"))
}

/// Systems that a file has numbers of, by their environment's id.
pub type Found = BTreeMap<String, Vec<System>>;

/// Reads results or tables; of tables only the one that `table` names, where it does.
pub fn read(path: &Path, table: Option<&str>) -> Result<Found, InputError> {
    let text = lads_host::input::read_to_string(path).map_err(InputError::Read)?;
    parse(&text, &path.display().to_string(), table)
}

fn parse(text: &str, name: &str, table: Option<&str>) -> Result<Found, InputError> {
    let value: Value = serde_json::from_str(text).map_err(InputError::Json)?;
    let version = &value["format_version"];
    let versioned = |format, read: u32| {
        let known = version.as_u64() == Some(u64::from(read));
        known.then_some(()).ok_or_else(|| InputError::Version {
            format,
            found: version.to_string(),
            read,
        })
    };
    let found = match value["format"].as_str() {
        Some(FORMAT) => {
            versioned(FORMAT, FORMAT_VERSION)?;
            results::read(value, name)?
        }
        Some(TABLES) => {
            versioned(TABLES, tables::VERSION)?;
            tables::read(value, name, table)?
        }
        found => {
            return Err(InputError::Format {
                found: found.map_or("not stated".to_owned(), |found| format!("'{found}'")),
            });
        }
    };
    for system in found.values().flatten() {
        check(system)?;
    }
    Ok(found)
}

/// Checks that a system has episodes, and scores that they can have.
fn check(system: &System) -> Result<(), InputError> {
    for split in &system.splits {
        let checked = split.score.check();
        checked.map_err(|wrong| InputError::Score {
            of: format!("{}, {}", system.name, split.name),
            wrong,
        })?;
    }
    let ran = system.splits.iter().any(|split| split.score.episodes > 0);
    ran.then_some(()).ok_or_else(|| InputError::Empty {
        of: system.name.clone(),
    })
}

/// Says what ran, in one line.
pub fn facts(sha256: &str, (noise, seed): (&str, u64), rule: &str, episodes: u32) -> String {
    let actions = match rule {
        "uniform" => "uniform random actions".to_owned(),
        rule => format!("plans by {rule}"),
    };
    format!(
        "bundle {sha256:.12}, noise {noise}, seed {seed}, {actions}, {episodes} {} of each instruction",
        if episodes == 1 { "episode" } else { "episodes" }
    )
}

/// Name of a file without its folder and ending.
pub fn short(path: &str, ending: &str) -> String {
    let path = Path::new(path);
    let file = path.file_name().unwrap_or_default().to_string_lossy();
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    file.strip_suffix(ending).unwrap_or(&stem).to_owned()
}

#[cfg(test)]
mod tests {
    use lads_proof::metrics::{Interval, Score, wilson};

    use super::*;

    fn split(k_rate: [f64; 4]) -> Value {
        serde_json::json!({"episodes": 20, "success": 0.25, "success_interval": [0.11, 0.47], "success_by_seed": [0.25],
            "n_rate": 1.75, "n_rate_standard_error": 0.5, "k_rate": k_rate})
    }

    fn tables_file(version: u32) -> Value {
        let row = serde_json::json!({"title": "LADS", "seeds": [0, 1], "splits": {"seen": split([0.75, 0.5, 0.25, 0.25])}});
        let waiting = serde_json::json!({"title": "LISA", "seeds": []});
        let table = |environment: &str, measure: &str| {
            serde_json::json!({"environment": environment, "measure": measure, "jobs": [], "protocol": {"episodes_per_instruction": 10, "seed": 0, "noise": "v0"},
                "tracks": [{"name": "paper", "rows": [row.clone(), waiting.clone()]}]})
        };
        serde_json::json!({"format": "lads-tables", "format_version": version,
            "tables": {"kitchen": table("franka-kitchen", "n_rate"), "lorel": table("lorel-table", "success")}})
    }

    fn parsed(value: &Value, table: Option<&str>) -> Result<Found, InputError> {
        parse(&value.to_string(), "models/tables.json", table)
    }

    #[test]
    fn tables_are_read_by_their_environment() {
        let found = parsed(&tables_file(1), None).unwrap();
        let ids: Vec<&str> = found.keys().map(String::as_str).collect();
        assert_eq!(ids, ["franka-kitchen", "lorel-table"]);
        let [lads] = &found["franka-kitchen"][..] else {
            panic!("what is not finished is left out");
        };
        assert_eq!((lads.name.as_str(), lads.splits.len()), ("LADS", 1));
        assert_eq!(lads.group.as_deref(), Some("kitchen/paper"));
        let score = &lads.splits[0].score;
        assert_eq!(score.k_rate_interval[1], wilson(10, 20));
        assert_eq!(score.full_success_interval, Interval(0.11, 0.47));
        assert_eq!(lads.splits[0].commanded, Some(4));
        assert_eq!(found["lorel-table"][0].splits[0].commanded, None);
        let one = parsed(&tables_file(1), Some("lorel")).unwrap();
        assert_eq!(one.len(), 1);
    }

    #[test]
    fn other_files_are_refused_with_what_they_are() {
        let refused = |text: &str, table: Option<&str>, parts: &[&str]| {
            let error = parse(text, "f", table).err().unwrap().to_string();
            for part in parts {
                assert!(error.contains(part), "'{part}' is not in: {error}");
            }
        };
        refused("{", None, &["not JSON"]);
        refused("[1]", None, &["format is not stated"]);
        refused(
            r#"{"format": "lads-sweep"}"#,
            None,
            &["'lads-sweep'", "lads-results", "lads-tables"],
        );
        let newer = tables_file(2).to_string();
        refused(&newer, None, &["version 2", "reads 1"]);
        refused(
            r#"{"format": "lads-results", "format_version": 9}"#,
            None,
            &["version 9"],
        );
        refused(
            r#"{"format": "lads-results", "format_version": 1}"#,
            None,
            &["damaged lads-results", "environment"],
        );
        refused(
            &tables_file(1).to_string(),
            Some("libero"),
            &["'libero'", "kitchen, lorel"],
        );
        let none = serde_json::json!({"format": "lads-tables", "format_version": 1, "tables": {}});
        refused(
            &none.to_string(),
            None,
            &["no table with a finished system", "it has none"],
        );
    }

    #[test]
    fn a_damaged_table_is_named_and_does_not_keep_the_others_from_being_read() {
        let mut file = tables_file(1);
        let kitchen = file["tables"]["kitchen"].as_object_mut().unwrap();
        kitchen.remove("environment");
        let error = parsed(&file, None).err().unwrap().to_string();
        for part in ["table kitchen", "environment", "make table", "--table"] {
            assert!(error.contains(part), "'{part}' is not in: {error}");
        }
        assert!(parsed(&file, Some("lorel")).is_ok());
    }

    #[test]
    fn impossible_scores_are_refused_with_their_system() {
        let mut file = tables_file(1);
        file["tables"]["lorel"]["tracks"][0]["rows"][0]["splits"]["seen"]["success"] = 7.0.into();
        let error = parsed(&file, None).err().unwrap().to_string();
        for part in ["LADS, seen", "successes in 20 episodes"] {
            assert!(error.contains(part), "'{part}' is not in: {error}");
        }
    }

    #[test]
    fn results_without_episodes_are_refused() {
        let file = serde_json::json!({"format": FORMAT, "format_version": FORMAT_VERSION, "environment": {"id": "e"},
            "bundle_sha256": "0", "seed": 0, "noise": "none", "decision": {"rule": "argmax"}, "episodes_per_instruction": 1,
            "splits": {}, "instructions": []});
        let error = parsed(&file, None).err().unwrap().to_string();
        assert!(error.contains("nothing to compare"), "{error}");
        let mut file = file;
        file["splits"]["seen"] = serde_json::to_value(Score::unasked(3, 0)).unwrap();
        let error = parsed(&file, None).err().unwrap().to_string();
        assert!(
            error.contains("'seen' has 3 episodes in its scores and 0"),
            "{error}"
        );
    }
}
