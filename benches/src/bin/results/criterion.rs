//! Reads what `cargo bench` left: the median and its confidence interval of every criterion benchmark.

use std::path::Path;

use serde_json::{Value, json};

/// Reads all benchmarks below criterion's folder, by name; empty where there is none.
pub fn collect(folder: &Path) -> Vec<Value> {
    let mut found = vec![];
    walk(folder, &mut found);
    found.sort_by_key(|row| row["name"].to_string());
    found
}

fn walk(folder: &Path, found: &mut Vec<Value>) {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    for entry in entries.flatten() {
        let path = entry.path();
        if path.file_name().is_some_and(|name| name == "new") {
            found.extend(read(&path));
        } else if path.is_dir() {
            walk(&path, found);
        }
    }
}

fn read(folder: &Path) -> Option<Value> {
    let json_of = |file: &str| -> Option<Value> {
        serde_json::from_slice(&std::fs::read(folder.join(file)).ok()?).ok()
    };
    let (estimates, benchmark) = (json_of("estimates.json")?, json_of("benchmark.json")?);
    let median = &estimates["median"];
    let us = |value: &Value| value.as_f64().map(|ns| ns / 1e3);
    let throughput = &benchmark["throughput"];
    let bytes = throughput["Bytes"].as_f64();
    Some(json!({
        "name": benchmark["full_id"].as_str()?,
        "median_us": us(&median["point_estimate"])?,
        "low_us": us(&median["confidence_interval"]["lower_bound"])?,
        "high_us": us(&median["confidence_interval"]["upper_bound"])?,
        "bytes": bytes,
        "elements": throughput["Elements"].as_f64(),
    }))
}
