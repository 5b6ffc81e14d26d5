//! Links inside the project lead somewhere, and the book has every page of `docs/`.

use std::fs;
use std::path::Path;

use lads_tests::documents::{Document, documents};
use lads_tests::project_path;

/// Why a link leads nowhere; `None` for one that is sound or leads out of the project.
fn dead(document: &Document, to: &str, all: &[Document]) -> Option<String> {
    if to.contains("://") || to.starts_with("mailto:") {
        return None;
    }
    let (path, anchor) = to.split_once('#').unwrap_or((to, ""));
    let folder = Path::new(&document.name).parent().unwrap_or(Path::new(""));
    let target = project_path(".").join(folder).join(path);
    if path.is_empty() {
        let found = document.anchors.contains(anchor);
        return (!found).then(|| format!("no heading has the anchor #{anchor}"));
    }
    let Ok(target) = target.canonicalize() else {
        return Some("there is no such file".into());
    };
    if anchor.is_empty() {
        return None;
    }
    let named = |other: &&Document| {
        let path = project_path(".").join(&other.name).canonicalize();
        path.is_ok_and(|path| path == target)
    };
    match all.iter().find(named) {
        Some(other) if other.anchors.contains(anchor) => None,
        Some(other) => Some(format!("no heading of {} is #{anchor}", other.name)),
        None => Some("it has an anchor and leads to no document".into()),
    }
}

#[test]
fn every_link_inside_the_project_leads_somewhere() {
    let all = documents();
    let (mut count, mut wrong) = (0, vec![]);
    for document in &all {
        for link in &document.links {
            count += 1;
            if let Some(why) = dead(document, &link.to, &all) {
                wrong.push(format!(
                    "{}:{}: {}: {why}",
                    document.name, link.line, link.to
                ));
            }
        }
    }
    assert!(count > 20, "they are found: {count}");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn a_dead_link_is_found() {
    let all = documents();
    let readme = all.iter().find(|document| document.name == "README.md");
    let readme = readme.expect("the project has one");
    for to in [
        "nowhere.md",
        "#nothing",
        "ARCHITECTURE.md#nothing",
        "LICENSE-MIT#top",
    ] {
        assert!(dead(readme, to, &all).is_some(), "{to}");
    }
    for to in [
        "docs",
        "docs/import.md",
        "https://example.org/x",
        "#licence",
    ] {
        assert_eq!(dead(readme, to, &all), None, "{to}");
    }
}

#[test]
fn the_book_has_every_page() {
    let all = documents();
    let summary = all
        .iter()
        .find(|document| document.name == "docs/SUMMARY.md");
    let summary = summary.expect("mdBook reads it");
    for entry in fs::read_dir(project_path("docs")).expect("it is there") {
        let name = entry.expect("it can be read").file_name();
        let name = name.to_string_lossy();
        let page = name.ends_with(".md") && name != "SUMMARY.md";
        let listed = summary.links.iter().any(|link| *link.to == *name);
        assert!(!page || listed, "docs/SUMMARY.md does not list {name}");
    }
}
