//! Formats tables and numbers in Markdown. Nothing here can fail.

use std::fmt::Write as _;

use serde_json::Value;

/// Formats a table in Markdown; the first column is text, the others are numbers.
pub fn table(header: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let mut text = format!(
        "| {} |\n|---|{}\n",
        header.join(" | "),
        "---:|".repeat(header.len() - 1)
    );
    for row in rows {
        let _ = writeln!(text, "| {} |", row.join(" | "));
    }
    text
}

/// Formats a text, or a question mark where there is none.
pub fn text(value: &Value) -> String {
    value.as_str().unwrap_or("?").to_owned()
}

/// Formats a number, or a dash where there is none.
pub fn number(value: &Value) -> String {
    value.as_f64().map_or_else(|| "–".into(), plain)
}

/// Formats a number with three significant digits or so.
pub fn plain(x: f64) -> String {
    match x.abs() {
        size if size >= 100.0 => format!("{x:.0}"),
        size if size >= 10.0 => format!("{x:.1}"),
        size if size >= 0.1 => format!("{x:.2}"),
        _ => format!("{x:.3}"),
    }
}

/// Joins texts to a list.
pub fn list(value: &Value) -> String {
    value
        .as_array()
        .into_iter()
        .flatten()
        .map(text)
        .collect::<Vec<_>>()
        .join(", ")
}
