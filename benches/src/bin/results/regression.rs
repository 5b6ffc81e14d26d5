//! Compares ratios, never times, with those of the results that were committed last, if the same kind of CPU made them.

use std::fmt::Write as _;
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
    /// CPU of those results, where it is another: nothing is compared then.
    pub other_cpu: Option<String>,
    /// Ratios that are in both, as `(row, before, now)`.
    pub all: Vec<(String, f64, f64)>,
    /// Lines about the ratios that became worse by more than 15 %.
    pub warnings: Vec<String>,
}

impl Changes {
    /// Renders what changed, as a section of the page.
    pub fn section(&self) -> String {
        let Some(with) = &self.with else {
            return String::new();
        };
        let mut text = format!("## Since {with}\n\n");
        if let Some(cpu) = &self.other_cpu {
            let _ = writeln!(
                text,
                "Not compared: those ratios are of another CPU, {cpu}."
            );
            return text;
        }
        let (count, moved) = (
            self.all.len(),
            self.all
                .iter()
                .filter(|(_, was, now)| (now / was - 1.0).abs() > 0.1)
                .count(),
        );
        let _ = writeln!(
            text,
            "{count} ratios are in both; {moved} of them moved by more than 10 %."
        );
        match self.warnings.as_slice() {
            [] => text.push_str("None became worse by more than 15 %.\n"),
            warnings => {
                text.push_str("Worse by more than 15 %:\n\n");
                for warning in warnings {
                    let _ = writeln!(text, "- {warning}");
                }
            }
        }
        text
    }
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

/// Compares the ratios of this CPU row by row.
pub fn compare(rows: &[Row], cpu: &Value, before: Option<&(String, Value)>) -> Changes {
    let Some((with, before)) = before else {
        return Changes::default();
    };
    let mut changes = Changes {
        with: Some(with.clone()),
        ..Changes::default()
    };
    let known = &before["machine"]["cpu"];
    if known != cpu {
        changes.other_cpu = Some(known.as_str().unwrap_or("unknown").to_owned());
        return changes;
    }
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
        let before = json!({ "machine": { "cpu": "this" }, "rows": [
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
        let before = ("x".to_owned(), before);
        let changes = compare(&rows, &json!("this"), Some(&before));
        assert_eq!(changes.all.len(), 2);
        assert_eq!(changes.warnings.len(), 1);
        assert!(changes.warnings[0].starts_with("b: 0.580, was 0.500"));
        assert!(compare(&rows, &json!("this"), None).all.is_empty());
        // Ratios of another CPU say nothing.
        let changes = compare(&rows, &json!("that"), Some(&before));
        assert!(changes.all.is_empty() && changes.warnings.is_empty());
        assert_eq!(changes.other_cpu.as_deref(), Some("this"));
    }
}
