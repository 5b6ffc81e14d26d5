//! Tests `lads-run --report`: the page says what the JSON says, has every chart, and fetches nothing.
#![cfg(feature = "report")]

use std::fs;
use std::path::Path;
use std::process::Command;

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
    // Nothing is fetched: addresses are names of forms only, sources are inside.
    let addresses = page.matches("http://").count() + page.matches("https://").count();
    assert_eq!(
        addresses,
        page.matches("xmlns=\"http://www.w3.org/2000/svg\"").count()
    );
    assert_eq!(page.matches("src=").count(), pictures);
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
