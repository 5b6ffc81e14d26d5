//! Tests that the Makefile has the rules that documents mention.

use std::collections::BTreeSet;
use std::fs;

use lads_tests::documents::files;
use lads_tests::project_path;

fn makefile() -> String {
    fs::read_to_string(project_path("Makefile")).expect("the project has a Makefile")
}

/// Returns the names before a colon that begins a rule.
fn rules(text: &str) -> BTreeSet<&str> {
    let lines = text.lines().filter(|line| {
        !line.starts_with(['\t', '#', ' ']) && !line.starts_with(".PHONY") && !line.contains(":=")
    });
    let heads = lines.filter_map(|line| line.split_once(':'));
    heads
        .flat_map(|(names, _)| names.split_whitespace())
        .collect()
}

/// Returns the rules behind every `make ` in inline code; and those where people are told to run one.
fn spoken_of(text: &str) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    for (place, _) in text.match_indices("make ") {
        let before = text[..place].trim_end_matches(' ');
        let in_code = before.ends_with('`');
        let told = ["run", "run \"", "run \\\"", "(by"];
        if !in_code && !told.iter().any(|mark| before.ends_with(mark)) {
            continue;
        }
        let typed = text[place + 5..].split(['`', '"', '\\', '\n', '#', ';', ',', '.', ')', '(']);
        let words = typed.take(1).flat_map(str::split_whitespace);
        let rules = words.take_while(|word| {
            let mut letters = word.chars();
            letters.all(|c| c.is_ascii_lowercase() || c == '-')
        });
        let most = if in_code { usize::MAX } else { 1 };
        names.extend(rules.take(most).map(str::to_owned));
    }
    names
}

#[test]
fn every_phony_name_has_a_rule() {
    let text = makefile();
    let rules = rules(&text);
    let phony = text.lines().find_map(|line| line.strip_prefix(".PHONY:"));
    let phony: Vec<_> = phony.expect("there is a list").split_whitespace().collect();
    assert!(phony.len() > 10);
    let missing: Vec<_> = phony
        .iter()
        .filter(|name| !rules.contains(**name))
        .collect();
    assert!(missing.is_empty(), "in .PHONY without a rule: {missing:?}");
    // A file or folder with the name of a rule would keep it from running.
    let hidden: Vec<_> = rules
        .iter()
        .filter(|rule| !rule.contains(['$', '%', '/', '.']) && !phony.contains(rule))
        .collect();
    assert!(
        hidden.is_empty(),
        "rules that are not in .PHONY: {hidden:?}"
    );
}

/// Tests that nobody waits for a build of minutes without a word.
#[test]
fn every_release_build_says_what_it_takes() {
    let text = makefile();
    let lines: Vec<_> = text.lines().collect();
    let builds = |line: &str| {
        ["run", "build"].iter().any(|command| {
            let words = line.trim_start_matches('\t').strip_prefix("cargo ");
            words.is_some_and(|words| words.starts_with(&format!("{command} --release")))
        })
    };
    let (mut found, mut silent) = (0, vec![]);
    for pair in lines.windows(2) {
        if let [before, line] = pair
            && builds(line)
        {
            found += 1;
            if !before.starts_with("\t$(call first-build,") {
                silent.push(line);
            }
        }
    }
    assert!(found > 10 && silent.is_empty(), "{found}: {silent:#?}");
}

#[test]
fn every_rule_with_a_help_line_is_there() {
    let text = makefile();
    let rules = rules(&text);
    let helped = text.lines().filter_map(|line| line.strip_prefix("## "));
    let helped: Vec<_> = helped.filter_map(|line| line.split_once(':')).collect();
    assert!(helped.len() > 10);
    for (name, _) in helped {
        assert!(
            name.starts_with(' ') || rules.contains(name),
            "help of `{name}`, which is not a rule"
        );
    }
}

#[test]
fn every_rule_that_is_spoken_of_is_there() {
    let text = makefile();
    let rules = rules(&text);
    let mut count = 0;
    let mut missing = vec![];
    let kinds = [
        "md", "rs", "py", "toml", "sh", "h", "hpp", "c", "cpp", "html", "Makefile",
    ];
    for path in files(&kinds) {
        if path.ends_with("tests/documents/makefile.rs") {
            continue;
        }
        let text = fs::read_to_string(project_path(".").join(&path)).unwrap_or_default();
        for name in spoken_of(&text) {
            count += 1;
            if !rules.contains(&*name) {
                missing.push(format!("{}: make {name}", path.display()));
            }
        }
    }
    assert!(count > 20, "the places are found: {count}");
    assert!(missing.is_empty(), "no such rule: {missing:#?}");
}

#[test]
fn names_are_found_where_people_are_told_to_type_them() {
    let text = "`make collect train export` (`ENV=lorel`), run \"make setup\" again; run make verify, or\nmake tea, `make run ARGS=\"-x\"`";
    let found: Vec<_> = spoken_of(text).into_iter().collect();
    assert_eq!(
        found,
        ["collect", "export", "run", "setup", "train", "verify"]
    );
}
