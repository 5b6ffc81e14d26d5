//! Tests that names of the C interface in comments and documents exist, and that C in documents compiles.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use lads_tests::documents::{documents, files};
use lads_tests::project_path;

/// Words that begin like a name of the interface but are not one.
const OTHER: [&str; 8] = [
    // Environment variables.
    "LADS_CACHE",
    "LADS_OPS",
    "LADS_REQUIRE_TOOLS",
    "LADS_TALLY",
    "LADS_WRITE_HEADER",
    "LADS_WRITE_IMAGE",
    // The package that a program's CMake asks for.
    "lads_VERSION",
    // The package in Python.
    "lads_exporter",
];

/// Collects everything that looks like a name of the interface.
fn names(text: &str) -> BTreeSet<&str> {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    words
        .filter(|word| word.len() > "lads_".len())
        .filter(|word| word.starts_with("LADS_") || word.starts_with("lads_"))
        .collect()
}

/// Returns the comments of a source in C, C++ or Rust; a text without its code.
fn comments(source: &str) -> String {
    let mut found = String::new();
    let mut inside = false;
    for line in source.lines() {
        let opened = line.find("/*");
        let text = if inside {
            Some(line)
        } else {
            opened.or_else(|| line.find("//")).map(|at| &line[at..])
        };
        found.extend(text.into_iter().flat_map(|text| [text, "\n"]));
        inside = (inside || opened.is_some()) && !line.contains("*/");
    }
    found
}

/// Returns the names that the headers declare.
fn declared(header: &str) -> BTreeSet<&str> {
    let comments = comments(header);
    let in_comments = names(&comments);
    let mut code = names(header);
    // A name that stands in comments only would vouch for itself.
    code.retain(|name| !in_comments.contains(name) || outside_comments(header, name));
    code
}

fn outside_comments(header: &str, name: &str) -> bool {
    let mut inside = false;
    header.lines().any(|line| {
        let comment =
            inside || line.trim_start().starts_with("/*") || line.trim_start().starts_with('*');
        inside = (inside || line.contains("/*")) && !line.contains("*/");
        !comment && names(line).contains(name)
    })
}

fn text(path: &Path) -> String {
    fs::read_to_string(project_path(".").join(path)).unwrap_or_default()
}

/// Returns the crates and test helpers that are called `lads_*` in Rust and Python.
fn modules() -> BTreeSet<String> {
    let manifests = files(&["toml"]);
    let manifests = manifests.iter().filter(|path| path.ends_with("Cargo.toml"));
    let package = |path: &PathBuf| {
        let text = text(path);
        let name = text.lines().find_map(|line| line.strip_prefix("name = \""));
        name.map(|name| name.trim_end_matches('"').replace('-', "_"))
    };
    manifests.filter_map(package).collect()
}

#[test]
fn every_name_of_the_interface_in_a_comment_exists() {
    let header = text(Path::new("runtime/ffi/include/lads.h"));
    let declared = declared(&header);
    assert!(declared.contains("lads_step") && declared.contains("LADS_STATUS_OK"));
    let modules = modules();
    let mut missing = vec![];
    let mut look = |place: String, text: &str| {
        for name in names(text) {
            let own = name.starts_with("LADS_") && name.ends_with("PP") || name == "LADS_H";
            let known =
                declared.contains(name) || OTHER.contains(&name) || own || modules.contains(name);
            if !known {
                missing.push(format!("{place}: {name}"));
            }
        }
    };
    for path in files(&["h", "hpp", "c", "cpp"]) {
        look(path.display().to_string(), &comments(&text(&path)));
    }
    for path in files(&["rs"]) {
        if path.starts_with("runtime") && !path.components().any(|part| part.as_os_str() == "tests")
        {
            look(path.display().to_string(), &comments(&text(&path)));
        }
    }
    for document in documents() {
        document
            .inline
            .iter()
            .for_each(|code| look(document.name.clone(), code));
        document
            .blocks
            .iter()
            .for_each(|block| look(block.place(), &block.text));
    }
    assert!(missing.is_empty(), "no such name: {missing:#?}");
}

#[test]
fn the_header_declares_only_the_interface() {
    let header = text(Path::new("runtime/ffi/include/lads.h"));
    let code = header
        .lines()
        .filter(|line| line.contains("(void)") || line.ends_with('('));
    for line in code.filter(|line| !line.starts_with([' ', '*'])) {
        assert!(
            line.contains(" lads_") || line.contains("*lads_"),
            "no name of lads: {line}"
        );
    }
    assert!(
        !header.contains("lads_a_panic_is_reachable"),
        "nobody defines it"
    );
    assert!(
        !header.contains("rust_eh_personality"),
        "it is the archive's own"
    );
}

/// Code around the documents' examples, which they leave to the reader.
const AROUND: [&str; 2] = [
    "#include <lads.h>\n#include <stdlib.h>\nvoid fail(const char *text);\n\
     lads_status shown(const uint8_t *image, size_t image_bytes, const float *observation, size_t n, lads_tick tick, float *action, size_t m);\n\
     lads_status shown(const uint8_t *image, size_t image_bytes, const float *observation, size_t n, lads_tick tick, float *action, size_t m) {\n",
    "\n    return status;\n}\n",
];

fn compiles(what: &str, code: &str) {
    let [before, after] = AROUND;
    let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join("shown.c");
    fs::write(&file, format!("{before}{code}{after}")).expect("it can be written");
    let output = Command::new("cc")
        .args(["-std=c11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only"])
        .arg("-I")
        .arg(project_path("runtime/ffi/include"))
        .arg(&file)
        .output()
        .expect("there is a C compiler");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{what}\n{errors}");
}

#[test]
fn c_in_documents_compiles_as_typed() {
    let documents = documents();
    let blocks = documents.iter().flat_map(|document| &document.blocks);
    let blocks: Vec<_> = blocks.filter(|block| block.language() == "c").collect();
    assert!(!blocks.is_empty(), "README shows C");
    for block in blocks {
        compiles(&block.place(), &block.text);
    }
    let source = text(Path::new("runtime/ffi/src/lib.rs"));
    let shown = source
        .split("//! ```c\n")
        .nth(1)
        .and_then(|rest| rest.split("//! ```").next());
    let shown = shown
        .expect("the crate's documentation shows C")
        .replace("//! ", "");
    compiles("runtime/ffi/src/lib.rs", &shown);
}
