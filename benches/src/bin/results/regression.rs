//! Compares ratios, never times, with those of the results that were committed last.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::rows::Row;

/// Relative change beyond which a ratio is worth a warning.
const WORTH: f64 = 0.15;

/// Changes of the ratios since the committed results.
#[derive(Debug, Default)]
pub struct Changes {
    /// Commit or file that was compared with.
    pub with: Option<String>,
    /// Ratios that are in both, as `(row, before, now)`.
    pub all: Vec<(String, f64, f64)>,
    /// Lines about the ratios that became worse by more than 15 %.
    pub warnings: Vec<String>,
}

/// Reads the results of the last commit, or, outside a repository, of the folder.
pub fn committed(folder: &Path) -> Option<(String, Value)> {
    let file = folder.join("results.json");
    let shown = Command::new("git")
        .arg("show")
        .arg(format!("HEAD:./{}", file.display()))
        .output()
        .ok()?;
    if shown.status.success() {
        return Some((
            "the last commit".into(),
            serde_json::from_slice(&shown.stdout).ok()?,
        ));
    }
    let bytes = std::fs::read(&file).ok()?;
    Some((
        file.display().to_string(),
        serde_json::from_slice(&bytes).ok()?,
    ))
}

/// Compares the ratios row by row.
pub fn compare(rows: &[Row], before: Option<&(String, Value)>) -> Changes {
    let Some((with, before)) = before else {
        return Changes::default();
    };
    let mut changes = Changes {
        with: Some(with.clone()),
        ..Changes::default()
    };
    for row in rows.iter().filter(|row| row.unit.is_empty()) {
        let known = before["rows"]
            .as_array()
            .into_iter()
            .flatten()
            .find(|known| known["id"] == row.id.as_str());
        let was = known.and_then(|known| known["ratio"]["median"].as_f64());
        if let (Some(was), Some(ratio)) = (was, row.ratio) {
            changes.all.push((row.label.clone(), was, ratio.median));
            if ratio.median > was * (1.0 + WORTH) {
                let by = (ratio.median / was - 1.0) * 100.0;
                changes.warnings.push(format!(
                    "{}: {:.3}, was {was:.3} in {with}: worse by {by:.0} %",
                    row.label, ratio.median
                ));
            }
        }
    }
    changes
}

#[cfg(test)]
mod tests {
    use super::*;
    use lads_pace::stats::Ratio;
    use serde_json::json;

    fn row(id: &str, median: f64, unit: &'static str) -> Row {
        let ratio = Some(Ratio {
            median,
            low: median,
            high: median,
        });
        Row {
            id: id.into(),
            label: id.into(),
            ratio,
            halves: None,
            target: None,
            unit,
        }
    }

    #[test]
    fn only_ratios_that_became_worse_are_warned_of() {
        let before = json!({ "rows": [
            { "id": "a", "ratio": { "median": 0.5 } },
            { "id": "b", "ratio": { "median": 0.5 } },
            { "id": "time", "ratio": { "median": 1.0 } },
            { "id": "was not measured", "ratio": null },
        ] });
        let rows = [
            row("a", 0.57, ""),
            row("b", 0.58, ""),
            row("time", 9.0, "ms"),
            row("new", 1.0, ""),
        ];
        let changes = compare(&rows, Some(&("x".into(), before)));
        assert_eq!(changes.all.len(), 2);
        assert_eq!(changes.warnings.len(), 1);
        assert!(changes.warnings[0].starts_with("b: 0.580, was 0.500"));
        assert!(compare(&rows, None).all.is_empty());
    }
}
