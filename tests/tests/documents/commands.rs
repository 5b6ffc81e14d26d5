//! Tests every block of commands: short ones are run here, long ones with the full suite, and for the others it is checked what they would
//! do.
//!
//! Short blocks run in a folder of their own, whose entries lead to the project's, with the `lads` of this build. The full suite runs
//! short and long ones, document after document, in a copy of the project, built as a user builds it: hours on a slow machine.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use lads_tests::documents::{Block, When, documents};
use lads_tests::{built, project_path};

/// Languages of blocks that hold no commands.
const QUIET: [&str; 7] = ["rust", "c", "cpp", "json", "toml", "text", "python"];

/// First words of lines that are commands.
const PROGRAMS: [&str; 13] = [
    "make ",
    "cargo ",
    "rustup ",
    "lads ",
    "lads-run ",
    "lads-collect ",
    "target/release/",
    "runtime/",
    "python",
    "pip ",
    "cc ",
    "c++ ",
    "export ",
];

fn blocks() -> Vec<Block> {
    let documents = documents();
    let blocks = documents.into_iter().flat_map(|document| document.blocks);
    blocks.collect()
}

/// Runs a script; returns its output as an error if it fails.
fn run(folder: &Path, script: &str) -> Result<String, String> {
    let mut bash = Command::new("bash");
    bash.args(["-euo", "pipefail", "-c", script]);
    // Those of the test's own build are not a user's.
    for variable in ["CARGO_TARGET_DIR", "MAKEFLAGS", "MAKELEVEL", "RUSTFLAGS"] {
        bash.env_remove(variable);
    }
    let output = bash.current_dir(folder).output().expect("there is bash");
    let [out, err] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    let text = format!("{out}{err}");
    if output.status.success() {
        Ok(text)
    } else {
        Err(format!("{}\n{text}", output.status))
    }
}

#[test]
fn every_block_of_commands_says_when_it_is_run() {
    let mut wrong = vec![];
    for block in blocks() {
        let typed = |line: &str| PROGRAMS.iter().any(|program| line.starts_with(program));
        let has_commands = block.language() == "sh" || block.text.lines().any(typed);
        let fits = if has_commands {
            block.when().is_some()
        } else {
            block.info.is_empty() || QUIET.contains(&block.language())
        };
        if !fits && !QUIET.contains(&block.language()) {
            wrong.push(format!("{}: ```{}", block.place(), block.info));
        }
    }
    assert!(
        wrong.is_empty(),
        "write ```sh short, ```sh long, or ```sh manual and why: {wrong:#?}"
    );
}

#[test]
fn every_make_that_is_shown_would_do_something() {
    let mut count = 0;
    for block in blocks().iter().filter(|block| block.when().is_some()) {
        for command in block
            .commands()
            .iter()
            .filter(|command| command.starts_with("make "))
        {
            let said = would_run(command);
            let said = said.unwrap_or_else(|error| panic!("{}: {command}: {error}", block.place()));
            assert!(
                said.lines().any(|line| !line.starts_with("make:")),
                "{}: {command} does nothing: {said}",
                block.place()
            );
            count += 1;
        }
    }
    assert!(count > 20, "they are found: {count}");
    for document in documents() {
        for code in document
            .inline
            .iter()
            .filter(|code| code.starts_with("make "))
        {
            // What the reader fills in.
            let command = code.replace("...", "x");
            would_run(&command)
                .unwrap_or_else(|error| panic!("{}: {command}: {error}", document.name));
        }
    }
}

/// Returns what the `make` that a line begins with would run; what follows it in the line, like `&& pip install`, is left alone.
fn would_run(command: &str) -> Result<String, String> {
    let alone = command.split(['&', '|', ';']).next().unwrap_or(command);
    let script = format!("make() {{ command make -n \"$@\"; }}\n{alone}");
    run(&project_path("."), &script)
}

#[test]
fn to_see_what_make_would_do_runs_nothing() {
    let folder = tempfile::tempdir().expect("there is room");
    let file = folder.path().join("run");
    for then in ["&&", ";", "|"] {
        would_run(&format!("make help {then} touch {}", file.display())).expect("a rule");
        assert!(!file.exists(), "{then} was run");
    }
}

/// Programs that short commands run, by their folders in `target/release`.
const BUILT: [&str; 2] = ["lads", "examples/biped"];

/// Makes a folder that looks like the project and takes what commands write; with the programs of an up-to-date build.
fn folder() -> tempfile::TempDir {
    let built = built(&["--bin", "lads", "--example", "biped"]);
    let folder = tempfile::tempdir().expect("there is room");
    let root = project_path(".").canonicalize().expect("it is there");
    for entry in fs::read_dir(&root).expect("it can be read") {
        let name = entry.expect("it can be read").file_name();
        if name != "target" && name != "out" {
            symlink(root.join(&name), folder.path().join(&name)).expect("links can be made");
        }
    }
    let release = folder.path().join("target/release");
    fs::create_dir_all(release.join("examples")).expect("there is room");
    for program in BUILT {
        symlink(built.join(program), release.join(program)).expect("links can be made");
    }
    folder
}

#[test]
fn short_commands_run_as_typed() {
    let blocks = blocks();
    let short: Vec<_> = blocks
        .iter()
        .filter(|block| block.when() == Some(When::Always))
        .collect();
    assert!(short.len() >= 3, "there are some");
    let folder = folder();
    for block in short {
        // What they build is here already.
        let commands = block
            .commands()
            .into_iter()
            .filter(|command| !command.starts_with("cargo build "));
        let script = commands.collect::<Vec<_>>().join("\n");
        run(folder.path(), &script)
            .unwrap_or_else(|error| panic!("{}:\n{script}\n{error}", block.place()));
    }
}

/// Asks `lads` for help behind every command of it that a document shows or speaks of: it comes after the options before it were
/// understood.
#[test]
fn every_option_of_lads_exists() {
    let program = built(&["--bin", "lads"]).join("lads");
    let mut count = 0;
    for document in documents() {
        for arguments in document.calls("lads") {
            let script = format!("'{}' {arguments} --help", program.display());
            if let Err(error) = run(&project_path("."), &script) {
                let spoken_of = error.contains("a value is required");
                assert!(spoken_of, "{}: lads {arguments}: {error}", document.name);
            }
            count += 1;
        }
    }
    assert!(count > 30, "they are found: {count}");
}

/// Copies the project's files, with what was fetched.
fn copy() -> PathBuf {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .parent()
        .expect("it lies in the target folder");
    let folder = target.join("documents");
    fs::create_dir_all(&folder).expect("there is room");
    let root = project_path(".").canonicalize().expect("it is there");
    let script = format!(
        "git ls-files -z --cached --others --exclude-standard | xargs -0 cp -p --parents -t '{folder}'\n\
         for there in vendor .venv; do [ ! -e $there ] || ln -sfn '{root}'/$there '{folder}'/$there; done",
        root = root.display(),
        folder = folder.display()
    );
    run(&root, &script).unwrap_or_else(|error| panic!("the project cannot be copied: {error}"));
    folder
}

#[test]
#[ignore = "builds and runs everything that the documents show: make test-full"]
fn all_commands_run_as_typed() {
    let folder = copy();
    let mut failed = vec![];
    for block in blocks() {
        if !matches!(block.when(), Some(When::Always | When::Full)) {
            continue;
        }
        println!("{}", block.place());
        let script = block.commands().join("\n");
        if let Err(error) = run(&folder, &script) {
            let tail: Vec<_> = error.lines().rev().take(20).collect();
            let tail = tail.into_iter().rev().collect::<Vec<_>>().join("\n");
            println!("FAILED\n{script}\n{tail}");
            failed.push(block.place());
        }
    }
    assert!(failed.is_empty(), "{failed:#?}");
}
