//! Renders RESULTS.md: the measurements, in tables with a word on what each means.

use std::fmt::Write as _;

use lads_pace::stats::{Ratio, exponent};
use serde_json::Value;

use crate::files::Measured;
use crate::growth::Point;
use crate::markdown::{list, number, plain, table, text};
use crate::measure::CONTEXT;
use crate::regression::Changes;
use crate::rows::Row;

/// Renders the page.
pub fn page(measured: &Measured, rows: &[Row], changes: &Changes) -> String {
    let mut page = String::new();
    let parts = [
        head(measured),
        ratios(rows),
        changes.section(),
        latencies(measured),
        whole_history(measured),
        starts(measured),
        context(measured),
        network(measured),
        benchmarks(&measured.criterion),
        contenders(measured),
        meaning().to_owned(),
    ];
    for part in parts.into_iter().filter(|part| !part.is_empty()) {
        page.push_str(part.trim_end());
        page.push_str("\n\n");
    }
    page.truncate(page.trim_end().len());
    page.push('\n');
    page
}

fn head(measured: &Measured) -> String {
    let m = &measured.machine;
    let warning = if measured.quick {
        "\n**A quick run, to try the machinery: its numbers mean little.**\n"
    } else {
        ""
    };
    let machine = if m["virtual"] == true {
        "virtual machine"
    } else {
        "machine"
    };
    format!(
        "# Results\n{warning}\nWritten by `make bench` in {:.0} s on {} (commit {}), {machine} with {} cores of {} ({}; {}), Linux {}, load average {} \
         when the run ended. {}, lads {}. Paced runs: {}.\n\n\
         One thread everywhere, 32-bit weights and KV cache unless it names a format of the weights, to which belongs a KV cache of f16, the shipped kitchen policy, control steps with {CONTEXT} tokens in the context; *auto* is as its bundle is tuned. Policies of one entry, as robots' policy files have them, have random weights. Times move with the \
         machine: trust the ratios, which come from contenders that took turns within a second or two.",
        measured.seconds,
        text(&m["date"]),
        text(&m["commit"]),
        m["cores"],
        text(&m["cpu"]),
        list(&m["caches"]),
        list(&m["vectors"]),
        text(&m["kernel"]),
        text(&m["load_average"]),
        text(&m["rustc"]),
        text(&m["lads"]),
        measured.paced.granted,
    )
}

fn ratios(rows: &[Row]) -> String {
    let row = |row: &Row| {
        let shown = |of: fn(&Ratio) -> f64| {
            row.ratio.as_ref().map_or_else(
                || "not measured".into(),
                |r| format!("{} {}", plain(of(r)), row.unit).trim().to_owned(),
            )
        };
        let range = row.ratio.as_ref().map_or_else(
            || "–".into(),
            |r| format!("{} to {}", plain(r.low), plain(r.high)),
        );
        let target = row.target.map_or_else(
            || "–".into(),
            |target| {
                format!("≤ {} {}", bound(target), row.unit)
                    .trim()
                    .to_owned()
            },
        );
        let met = match row.met() {
            Some(true) => "met",
            Some(false) => "**missed**",
            None => "–",
        };
        let halves = row
            .halves
            .map_or_else(|| "–".into(), |x| format!("{:.1} %", x * 100.0));
        vec![
            row.label.clone(),
            shown(|r| r.median),
            target,
            met.into(),
            range,
            halves,
        ]
    };
    let worst = rows.iter().filter_map(|row| row.halves).fold(0.0, f64::max);
    format!(
        "## Ratios\n\n{}\nBelow 1 means that the first is faster. *Range*: quartiles over the rounds (for p99.9, the extremes of four parts of the run). *Halves*: \
         how far the ratios of the first and of the second half of the run are apart; the largest here is {:.1} %.",
        table(
            &["", "ratio", "target", "", "range", "halves"],
            rows.iter().map(row)
        ),
        worst * 100.0
    )
}

fn latencies(measured: &Measured) -> String {
    let mut text = String::from("## Latencies [us]\n");
    let mut runs = vec![
        (
            "Hot: one call after the other".to_owned(),
            &measured.hot,
            false,
        ),
        (
            "At 50 Hz, beside all peers".into(),
            &measured.paced_all,
            false,
        ),
        (
            "At 50 Hz, more calls, for the tails".into(),
            &measured.paced,
            true,
        ),
        (
            "At 50 Hz, beside a thread that thrashes the caches".into(),
            &measured.loaded,
            true,
        ),
    ];
    for policy in &measured.plain {
        let title = policy.title;
        runs.push((format!("{title}, hot"), &policy.hot, false));
        runs.push((format!("{title}, at 50 Hz"), &policy.paced, false));
    }
    for (title, run, tails) in runs {
        let row = |row: Value| {
            let mut cells = vec![
                format!(
                    "{}, {}",
                    crate::markdown::text(&row["contender"]),
                    crate::markdown::text(&row["kind"])
                ),
                row["calls"].to_string(),
            ];
            cells.extend(
                ["p50", "spread", "p90", "p99", "p99.9", "max"]
                    .iter()
                    .map(|name| number(&row[*name])),
            );
            if tails {
                cells.push(row["misses"].to_string());
            }
            cells
        };
        let header = [
            "",
            "calls",
            "p50",
            "± of rounds",
            "p90",
            "p99",
            "p99.9",
            "max",
            "missed deadlines",
        ];
        let header = if tails { &header[..] } else { &header[..8] };
        let rows = run
            .rows()
            .into_iter()
            .filter(|row| row["kind"] != "recompute");
        let _ = write!(text, "\n### {title}\n\n{}", table(header, rows.map(row)));
        if !tails {
            continue;
        }
        if title.contains("tails") {
            text.push_str("\n![](charts/paced-act.svg)\n![](charts/paced-step.svg)\n");
        }
    }
    text
}

fn whole_history(measured: &Measured) -> String {
    let rows = measured.hot.rows();
    let mut rows = rows
        .into_iter()
        .filter(|row| row["kind"] == "recompute")
        .peekable();
    if rows.peek().is_none() {
        return "## Without a KV cache\n\nNot measured: the model without a cache could not be exported.".into();
    }
    let cells = |row: Value| {
        vec![
            text(&row["contender"]),
            row["calls"].to_string(),
            number(&row["p50"]),
            number(&row["max"]),
        ]
    };
    format!(
        "## Without a KV cache\n\nWhat a plain export costs at the last step of an episode: the logits from the whole history at once [us].\n\n{}",
        table(&["", "calls", "p50", "max"], rows.map(cells))
    )
}

fn starts(measured: &Measured) -> String {
    let p = &measured.preparation;
    let mut text = String::from("## Before the first step\n\n");
    let entrants = measured.field["entrants"].as_array().into_iter().flatten();
    let row = |e: &Value| {
        let us = |name: &str| {
            e[name]
                .as_f64()
                .map_or_else(|| "–".into(), |ns| plain(ns / 1e3))
        };
        vec![
            crate::markdown::text(&e["name"]),
            us("first_ns"),
            us("again_ns"),
        ]
    };
    text.push_str("The first instruction and control step that a contender computes in the process, and the same again [us]:\n\n");
    text.push_str(&table(&["", "first", "again, p50"], entrants.map(row)));
    let _ = write!(
        text,
        "\nReading the bundle takes {} ms, compiling it {} ms. The images:\n\n",
        number(&p["read_ms"]["median"]),
        number(&p["compile_ms"]["median"])
    );
    let images = p["images"].as_array().into_iter().flatten().map(|image| {
        vec![
            crate::markdown::text(&image["weights"]),
            image["image_bytes"].to_string(),
            image["workspace_bytes"].to_string(),
            number(&image["open_ms"]["median"]),
        ]
    });
    text.push_str(&table(
        &[
            "weights",
            "image [B]",
            "controller's memory [B]",
            "open [ms]",
        ],
        images,
    ));
    text.push_str(
        "\nFresh processes, medians [us], in which other work took the caches before the first instruction; *hot* is the same step later in the same process. \
         Warming up is `Controller::warm`:\n\n",
    );
    let rows = ["without", "with"].into_iter().map(|warm| {
        let s = &measured.cold[warm];
        let cells = [
            "open_us",
            "warm_us",
            "instruct_us",
            "first_us",
            "hot_first_us",
            "second_us",
            "hot_second_us",
        ];
        let mut row = vec![format!("{warm} warming up")];
        row.extend(cells.iter().map(|name| number(&s[*name])));
        row
    });
    text.push_str(&table(
        &[
            "",
            "open",
            "warm up",
            "instruct",
            "first step",
            "hot",
            "second step",
            "hot",
        ],
        rows,
    ));
    text
}

fn context(measured: &Measured) -> String {
    let tokens: Vec<_> = measured
        .contexts
        .first()
        .map(|(_, points)| points.iter().map(|(x, _)| *x).collect())
        .unwrap_or_default();
    let mut header: Vec<String> = vec![String::new()];
    header.extend(tokens.iter().map(|tokens: &f64| format!("{tokens:.0}")));
    header.push("exponent (R²)".into());
    header.push("per 100 tokens".into());
    let header: Vec<_> = header.iter().map(String::as_str).collect();
    let walked = measured
        .contexts
        .iter()
        .filter(|(_, points)| !points.is_empty());
    let rows = walked.map(|(name, points)| {
        let mut row = vec![name.clone()];
        row.extend(points.iter().map(|(_, us)| plain(*us)));
        row.push(fitted(exponent(points)));
        let slope = match (points.first(), points.last()) {
            (Some((x0, y0)), Some((x1, y1))) if x1 > x0 => plain((y1 - y0) / (x1 - x0) * 100.0),
            _ => "–".into(),
        };
        row.push(slope);
        row
    });
    format!(
        "## Growth with the context\n\nOrdinary step, hot, p50 [us], at so many tokens (0 to 280 control steps). A step costs a constant plus so much per \
         token, so the exponent of a power law is well below 1.\n\n{}\n![](charts/context.svg)\n",
        table(&header, rows)
    )
}

fn fitted(fit: Option<(f64, f64)>) -> String {
    fit.map_or_else(|| "–".into(), |(e, r2)| format!("{e:.2} ({r2:.2})"))
}

/// Header of a column, and its value at a point.
type Column = (&'static str, fn(&Point) -> f64);

fn network(measured: &Measured) -> String {
    let mut text = String::from("## Growth with the network\n\n");
    if let Some(reason) = &measured.not_grown {
        let _ = write!(text, "Not measured: {reason}");
        return text;
    }
    text.push_str("Random bundles in which one dimension grows and the others are those of the kitchen policy. Exponents of fitted power laws, with R²:\n\n");
    let columns: [Column; 8] = [
        ("image", |p| p.image_bytes),
        ("memory", |p| p.workspace_bytes),
        ("act", |p| p.act[0]),
        ("ordinary step", |p| p.ordinary[0]),
        ("decision step", |p| p.decision[0]),
        ("ONNX Runtime: act", |p| p.act[1]),
        ("ordinary step", |p| p.ordinary[1]),
        ("decision step", |p| p.decision[1]),
    ];
    let mut header = vec!["grows"];
    header.extend(columns.iter().map(|(name, _)| *name));
    let exponents = measured.growth.iter().map(|series| {
        let mut row = vec![series.name.clone()];
        row.extend(columns.iter().map(|(_, of)| fitted(series.exponent(of))));
        row
    });
    text.push_str(&table(&header, exponents));
    text.push_str("\nThe points (bytes, then p50 in us):\n\n");
    let points = measured
        .growth
        .iter()
        .flat_map(|series| series.points.iter().map(move |point| (series, point)));
    let rows = points.map(|(series, point)| {
        let mut row = vec![format!("{} {}", series.name, point.value)];
        row.extend(columns.iter().map(|(_, of)| plain(of(point))));
        row
    });
    text.push_str(&table(&header, rows));
    text.push_str("\n![](charts/network.svg)\n");
    text
}

fn benchmarks(found: &[Value]) -> String {
    if found.is_empty() {
        return "## Criterion\n\nNothing there: run `cargo bench -p lads-benches` first (`make bench` does).".into();
    }
    let median = |name: &str| {
        found
            .iter()
            .find(|row| row["name"] == name)
            .and_then(|row| row["median_us"].as_f64())
    };
    let mut text = String::from(
        "## Criterion\n\nMedians of `cargo bench` [us] with 95 % confidence intervals. *Roofline*: against a bare sweep over the same bytes, measured in the same group.\n\n",
    );
    let rows = found.iter().map(|row| {
        let name = crate::markdown::text(&row["name"]);
        let (us, bytes) = (
            row["median_us"].as_f64().unwrap_or(f64::NAN),
            row["bytes"].as_f64(),
        );
        let sweep = name
            .strip_suffix("/kernel")
            .and_then(|group| median(&format!("{group}/sweep")));
        let rate = row["elements"]
            .as_f64()
            .map(|n| format!("{} /s", plain(n / us * 1e6)));
        let rate = rate.or_else(|| bytes.map(|bytes| format!("{} GB/s", plain(bytes / us / 1e3))));
        vec![
            name,
            plain(us),
            format!("{} to {}", number(&row["low_us"]), number(&row["high_us"])),
            rate.unwrap_or_else(|| "–".into()),
            sweep.map_or_else(|| "–".into(), |sweep| plain(us / sweep)),
        ]
    });
    text.push_str(&table(
        &["", "median", "interval", "rate", "roofline"],
        rows,
    ));
    text
}

fn contenders(measured: &Measured) -> String {
    let mut text = String::from(
        "## Contenders\n\nAll ran the same entries of `models/kitchen.onnx` over the first 60 control steps of its golden episode before anything was timed: plans equal, \
         actions within the tolerance of the recorded ones.\n\n",
    );
    let entrants = measured.field["entrants"].as_array().into_iter().flatten();
    let row = |e: &Value| {
        vec![
            crate::markdown::text(&e["name"]),
            crate::markdown::text(&e["detail"]),
            e["largest_error"]
                .as_f64()
                .map_or_else(|| "–".into(), |x| format!("{x:.1e}")),
        ]
    };
    text.push_str(&table(
        &[
            "",
            "version and settings",
            "largest difference of an action",
        ],
        entrants.map(row),
    ));
    for absent in measured.field["absent"].as_array().into_iter().flatten() {
        let _ = writeln!(text, "\nNot run: {}", crate::markdown::text(absent));
    }
    text
}

fn meaning() -> &'static str {
    "## What the numbers mean\n\n\
     - **act**: `low_level/act`, one observation and one plan to one action. For lads with its checks, the plan's lookup and the clipping.\n\
     - **ordinary step**: the previous action and the observation enter the KV cache, then the low level acts. Peers run `high_level/step` and `low_level/act`.\n\
     - **decision step**: the same, and a plan is picked from the logits. Peers add `codebook/lookup`.\n\
     - **instruct**: `high_level/instruct`, the words of a new instruction.\n\
     - **hot**: calls follow each other, caches are warm. This flatters everybody.\n\
     - **at 50 Hz**: the thread sleeps until an absolute deadline, calls once, and sleeps again: caches, predictors and clock are what a robot's are.\n\
     - **Turns**: in every round each contender gets a block of 20 calls (the first three of each block are not counted); the order is reversed from round to round. \
     A ratio is taken between two medians of the same round; the table shows the median over all rounds. What slows the machine for longer than a round cancels out.\n\
     - **Peers** repeat one step at a fixed context, with keys and values bound once (ONNX Runtime, to memory allocated beforehand). That flatters them: in use they would bind anew, or \
     allocate, as the context grows. lads walks through the episode, so its steps have 300 tokens on average. PyTorch and OpenVINO run in Python, whose overhead is in their numbers; \
     rten hands every call to a thread of its pool.\n\
     - **bare sweep**: a sum over as many bytes as the low level's weights have, with the widest vectors. No kernel that reads its weights can be faster.\n\
     - **p99.9** of fewer than a thousand calls is the longest.\n"
}

/// Formats a target by three digits at most.
fn bound(target: f64) -> String {
    let rounded = format!("{target:.3}");
    rounded
        .trim_end_matches('0')
        .trim_end_matches('.')
        .to_owned()
}
