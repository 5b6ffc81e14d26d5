//! Tests `lads-run --report` and `lads-run report`: the pages say what the JSON says, have every chart, and fetch nothing.
#![cfg(feature = "report")]

#[path = "common/lads_run.rs"]
mod lads_run;

use std::fs;
use std::path::Path;
use std::process::Command;

use lads_run::{assert_refused, project_file};
use serde_json::Value;

/// Makes the page and the JSON of one small run.
fn page(environment: &[(&str, &str)]) -> (String, Value) {
    let folder = tempfile::tempdir().unwrap();
    let [page, json] = ["r.html", "r.json"].map(|name| folder.path().join(name));
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/kitchen.onnx");
    let output = Command::new(env!("CARGO_BIN_EXE_lads-run"))
        .args(["--instruction", "kbls", "--episodes", "2", "--model"])
        .arg(model)
        .arg("--report")
        .arg(&page)
        .arg("--json")
        .arg(&json)
        .envs(environment.iter().copied())
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    let json = serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
    (fs::read_to_string(page).unwrap(), json)
}

/// Returns the part of the page between a headline and the next.
fn section<'p>(page: &'p str, title: &str) -> &'p str {
    let (_, rest) = page
        .split_once(&format!("<h2>{title}</h2>"))
        .unwrap_or_else(|| panic!("no section '{title}'"));
    rest.split("<h2>").next().unwrap()
}

#[test]
fn the_page_has_the_numbers_of_the_json_and_every_chart() {
    let (page, json) = page(&[]);
    let table = section(&page, "Success");
    let score = &json["splits"]["seen"];
    let cell = |value: &Value| format!("<td>{:.2}<small>", value.as_f64().unwrap());
    assert!(table.contains(&cell(&score["n_rate"])), "{table}");
    for rate in score["k_rate"].as_array().unwrap() {
        assert!(table.contains(&cell(rate)));
    }
    assert!(table.contains(&cell(&score["full_success"])));
    let instruction = &json["instructions"][0];
    for field in ["id", "text", "split"] {
        assert!(
            table.contains(instruction[field].as_str().unwrap()),
            "{field}"
        );
    }
    assert!(page.contains(json["bundle_sha256"].as_str().unwrap()));

    for title in [
        "K-rates",
        "Latent plans over an episode",
        "Plans at the start of an episode",
        "Gripper by plan",
        "Plans by word and by sub-task",
        "Latency of the controller",
    ] {
        let charts = section(&page, title).matches("<svg viewBox=").count();
        assert!(charts > 0, "{title}");
    }
    let words = section(&page, "Words by plan");
    assert!(words.contains("<b>plan ") && words.contains("<span>burner</span>"));
    // No instruction of this run is a part of another.
    for title in ["Gripper", "Plans at the start"] {
        let left_out = section(
            &page,
            &format!("{title} of a composite instruction and its parts"),
        );
        assert!(
            left_out.contains("Left out: no composite instruction") && !left_out.contains("<svg")
        );
    }
    // Every cell of a heat map says which it is.
    let cells: Vec<_> = page.split("<title>").skip(2).collect();
    let cells: Vec<_> = cells
        .iter()
        .filter_map(|cell| cell.split("</title>").next())
        .collect();
    assert!(cells.len() > 10);
    for cell in cells {
        let (row, rest) = cell
            .split_once(", plan ")
            .unwrap_or_else(|| panic!("'{cell}'"));
        assert!(!row.is_empty() && rest.contains(": "), "'{cell}'");
    }
    // Two episodes say little of an instruction, and no instruction here is made of others.
    assert!(table.contains("With 2 episodes of each instruction these are wide"));
    assert!(!section(&page, "Plans at the start of an episode").contains("composite"));
    let latency = section(&page, "Latency of the controller");
    assert!(latency.contains(">Duration of a control step<"));
    // The one chosen episode is a timeline with a line and a name for each completion.
    let timeline = section(&page, "Latent plans over an episode");
    assert_eq!(timeline.matches("<svg ").count(), 1);
    let runs = instruction["runs"].as_array().unwrap();
    let shown = runs
        .iter()
        .find(|run| run["success"] == false)
        .unwrap_or(&runs[0]);
    for done in shown["completions"].as_array().unwrap() {
        let name = done["sub_task"].as_str().unwrap();
        let asked = done["commanded"].as_bool().unwrap();
        let said = if asked { "" } else { ", not asked for" };
        let mark = format!("<span>{name}</span>, step {}{said}</li>", done["step"]);
        assert!(timeline.contains(&mark), "{mark}");
    }
    let films = section(&page, "Film strips");
    let pictures = films.matches("src=\"data:image/jpeg;base64,/9j/").count();
    if films.contains("None: ") {
        println!("skipped: no film strips here");
    } else {
        assert!(pictures >= 2, "start and end at least");
    }
    assert_eq!(page.matches("src=").count(), pictures);
    fetches_nothing(&page);
}

/// Asserts that addresses in the page are names of forms only.
fn fetches_nothing(page: &str) {
    let addresses = page.matches("http://").count() + page.matches("https://").count();
    assert_eq!(
        addresses,
        page.matches("xmlns=\"http://www.w3.org/2000/svg\"").count()
    );
    for fetched in ["href=", "@import", "url(http", "<script"] {
        assert!(!page.contains(fetched), "{fetched}");
    }
}

#[test]
fn without_egl_the_page_says_why_there_are_no_film_strips() {
    let (page, _) = page(&[("__EGL_VENDOR_LIBRARY_FILENAMES", "/dev/null")]);
    let films = section(&page, "Film strips");
    assert!(
        films.contains("None: ") && !films.contains("<img"),
        "{films}"
    );
}

/// Makes a `lads-run report` command of inputs, by their paths.
fn compare(inputs: &[&Path], page: &Path, options: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads-run"));
    command.arg("report").args(inputs).arg("-o").arg(page);
    command.args(options);
    command
}

#[test]
fn a_bundle_and_results_are_compared_chart_by_chart() {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("r.html");
    let [bundle, results] =
        ["models/lorel.onnx", "models/lorel-image.results.json"].map(project_file);
    let output = compare(&[&bundle, &results], &page, &["--episodes", "1"])
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    let page = fs::read_to_string(page).unwrap();
    fetches_nothing(&page);

    // What the results say of each split stands in the table, beside the bundle.
    let results: Value = serde_json::from_str(&fs::read_to_string(results).unwrap()).unwrap();
    let table = section(&page, "Success");
    let splits = ["atomic", "rephrased", "composite", "composite_corrected"];
    for split in splits {
        let score = &results["splits"][split];
        let [low, high] = [0, 1].map(|end| score["full_success_interval"][end].as_f64().unwrap());
        let rate = score["full_success"].as_f64().unwrap();
        let cell = format!("<td>{rate:.2}<small>{low:.2}–{high:.2}</small></td>");
        assert!(table.contains(&cell), "{split}: {cell}");
        assert!(table.contains(&format!(">{split}</td>")));
    }
    for name in ["lorel", "lorel-image"] {
        assert_eq!(
            table.matches(&format!("<td>{name}</td>")).count(),
            splits.len()
        );
    }
    let rates = section(&page, "K-rates");
    assert_eq!(rates.matches("<svg viewBox=").count(), splits.len());
    assert_eq!(
        rates.matches(">success rate<").count(),
        2,
        "one sub-task each"
    );
    assert_eq!(rates.matches(">K-rate<").count(), 2);

    // The paper's composite instruction and its parts, of the bundle alone.
    let composite = "open drawer and move black mug right";
    for (title, said) in [
        ("Gripper", ">x (m)<"),
        (
            "Plans at the start",
            "entries of the codebook (16 elements)",
        ),
    ] {
        let figure = section(
            &page,
            &format!("{title} of a composite instruction and its parts"),
        );
        assert!(figure.contains(&format!(">lorel: {composite}<")) && figure.contains(said));
        for part in ["open drawer", "move black mug right"] {
            assert!(figure.contains(&format!("</span> {part}</li>")), "{part}");
        }
        assert!(
            figure
                .contains("Left out: lorel-image: results hold no control steps; give the bundle.")
        );
    }
    // Both inputs have plans, and so words; what was decided is what the results list.
    let words = section(&page, "Words by plan");
    assert!(words.contains("<h3>lorel</h3>") && words.contains("<h3>lorel-image</h3>"));
    let (_, of_results) = words.split_once("<h3>lorel-image</h3>").unwrap();
    let instructions = results["instructions"].as_array().unwrap().iter();
    let runs = instructions.flat_map(|it| it["runs"].as_array().unwrap());
    let plans = runs.flat_map(|run| run["plans"].as_array().unwrap());
    let count = plans.filter(|plan| **plan == 3).count();
    assert!(
        count > 0 && of_results.contains(&format!("<b>plan 3 <small>{count} decisions</small>"))
    );
}

#[test]
fn bad_inputs_are_named_at_once_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("r.html");
    let [kitchen, lorel] =
        ["models/kitchen.results.json", "models/lorel.results.json"].map(project_file);
    let mixed = compare(&[&kitchen, &lorel], &page, &[]).output().unwrap();
    let parts = [
        "several environments",
        "franka-kitchen (",
        "kitchen.results.json)",
        "lorel-table (",
        "lorel.results.json)",
    ];
    assert_refused(&mixed, &parts);

    let other = project_file("models/lorel.instructions.json");
    let missing = folder.path().join("missing.onnx");
    let output = compare(&[&other, &missing, &lorel], &page, &[])
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    let lines: Vec<&str> = errors.lines().collect();
    let [first, second] = lines[..] else {
        panic!("one line for each: {errors}");
    };
    assert!(
        first.contains("lorel.instructions.json: its format is not stated"),
        "{first}"
    );
    assert!(
        second.contains("missing.onnx") && second.starts_with("error: "),
        "{second}"
    );

    let again = lorel.parent().unwrap().join("./lorel.results.json");
    let twice = compare(&[&lorel, &again], &page, &[]).output().unwrap();
    assert_refused(&twice, &["lorel.results.json", "given twice"]);
    let results = compare(&[&lorel], &lorel, &[]).output().unwrap();
    assert_refused(&results, &["lorel.results.json"]);
    let none = compare(&[&lorel], &page, &["--episodes", "0"])
        .output()
        .unwrap();
    assert_refused(&none, &["--episodes 0"]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}
