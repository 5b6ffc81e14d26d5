//! Tests the texts of library crates: what they print may be read anywhere, so it names no make target and no option of a command. The command adds
//! its own remedy.

use std::fs;
use std::path::{Path, PathBuf};

use lads_tests::project_path;

/// Crates that are libraries, by the folder of their sources.
const LIBRARIES: [&str; 11] = [
    "runtime/kernels/src",
    "runtime/image/src",
    "runtime/core/src",
    "runtime/compiler/src",
    "runtime/host/src",
    "runtime/import/src",
    "runtime/pace/src",
    "runtime/language/src",
    "runtime/record/src",
    "runtime/ffi/src",
    "sim-harness/proof/src",
];

/// Lists the sources below a folder that are not tests.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("the folder is there") {
        let path = entry.expect("it can be read").path();
        let is_tests = path.file_stem().is_some_and(|name| name == "tests");
        if path.is_dir() && !is_tests {
            sources(&path, found);
        } else if path.extension().is_some_and(|it| it == "rs") && !is_tests {
            found.push(path);
        }
    }
}

/// Texts of a source that a program can print: its string literals, without comments and without the tests at its end.
fn texts(source: &str) -> Vec<String> {
    let inline = "#[cfg(test)]\nmod tests {";
    let source = source.split(inline).next().unwrap_or(source);
    let (mut texts, mut rest) = (Vec::new(), source);
    while let Some(at) = rest.find(['"', '/', '\'']) {
        let found = &rest[at..];
        rest = if found.starts_with("//") {
            found.split_once('\n').map_or("", |(_, after)| after)
        } else if let Some(after) = found.strip_prefix("'\"'") {
            after
        } else if let Some(after) = found.strip_prefix('"') {
            let mut escaped = false;
            let end = after.find(|letter| {
                let ends = letter == '"' && !escaped;
                escaped = letter == '\\' && !escaped;
                ends
            });
            let end = end.unwrap_or(after.len());
            texts.push(after[..end].to_owned());
            after.get(end + 1..).unwrap_or_default()
        } else {
            &found[1..]
        };
    }
    texts
}

/// Targets that the Makefile explains.
fn targets() -> Vec<String> {
    let makefile = fs::read_to_string(project_path("Makefile")).expect("it is there");
    let explained = makefile.lines().filter_map(|line| line.strip_prefix("## "));
    let names = explained.filter_map(|line| line.split_once(": "));
    names.map(|(name, _)| name.to_owned()).collect()
}

/// What a text names that a library does not know: a make target, or an option.
fn command(text: &str, targets: &[String]) -> Option<String> {
    let words: Vec<&str> = text
        .split(|letter: char| !(letter.is_alphanumeric() || "-_".contains(letter)))
        .collect();
    let makes = words.windows(2).find_map(|pair| match *pair {
        ["make", target] if targets.iter().any(|known| known == target) => {
            Some(format!("make {target}"))
        }
        _ => None,
    });
    let is_option = |word: &&&str| {
        let name = word.strip_prefix("--");
        name.is_some_and(|name| name.starts_with(|first: char| first.is_ascii_lowercase()))
    };
    makes.or_else(|| words.iter().find(is_option).map(|&it| it.to_owned()))
}

#[test]
fn a_library_names_no_make_target_and_no_option() {
    let targets = targets();
    assert!(targets.len() > 20, "{targets:?}");
    let mut wrong = Vec::new();
    for library in LIBRARIES {
        let (mut paths, mut seen) = (Vec::new(), 0);
        sources(&project_path(library), &mut paths);
        for path in paths {
            let source = fs::read_to_string(&path).expect("it can be read");
            for text in texts(&source) {
                seen += 1;
                if let Some(named) = command(&text, &targets) {
                    wrong.push(format!("{}: `{named}` in {text:?}", path.display()));
                }
            }
        }
        assert!(seen > 0, "no texts in {library}");
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn what_a_text_names_is_found() {
    let source = r#"
        // "make reference" in a comment
        const A: &str = "say \"it\", make reference";
        const B: char = '"';
        #[error("{path}: give --plans")]
        const C: &str = "make one, a - b, make room";
        #[cfg(test)]
        mod tests { const D: &str = "make reference"; }
    "#;
    let source = source.replace("        ", "");
    let texts = texts(&source);
    assert_eq!(texts.len(), 3, "{texts:?}");
    let targets = ["reference".to_owned()];
    let named: Vec<_> = texts.iter().map(|text| command(text, &targets)).collect();
    let wanted = [Some("make reference"), Some("--plans"), None];
    assert_eq!(named, wanted.map(|it| it.map(str::to_owned)));
}
