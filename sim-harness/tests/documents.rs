//! Tests that the options of `lads-run` and `lads-collect` in the documents exist.

use std::path::Path;
use std::process::Command;

use lads_tests::documents::documents;

fn bash(script: &str) -> (bool, String) {
    let output = Command::new("bash")
        .args(["-c", script])
        .current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(".."))
        .env_remove("MAKEFLAGS")
        .output()
        .expect("there is bash");
    let [out, err] =
        [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    (output.status.success(), out + &err)
}

#[test]
fn every_option_that_is_shown_exists() {
    let programs = [
        ("lads-run", env!("CARGO_BIN_EXE_lads-run")),
        ("lads-collect", env!("CARGO_BIN_EXE_lads-collect")),
    ];
    let mut count = 0;
    for document in documents() {
        let shown = document
            .blocks
            .iter()
            .flat_map(lads_tests::documents::Block::commands);
        let inline = document
            .inline
            .iter()
            .filter(|code| !code.contains("..."))
            .cloned();
        // Only what make would run is asked for; nothing else of a line may be run.
        let single = shown.chain(inline).flat_map(|line| {
            let parts = line.split("&&").map(|part| part.trim().to_owned());
            parts.collect::<Vec<_>>()
        });
        for command in single.filter(|command| command.starts_with("make ")) {
            let (_, would_run) = bash(&format!("make() {{ command make -n \"$@\"; }}; {command}"));
            for line in would_run.lines() {
                for (name, program) in programs {
                    let Some((_, arguments)) = line.split_once(&format!("--bin {name} -- ")) else {
                        continue;
                    };
                    // Help comes after the options before it were understood.
                    let (known, text) = bash(&format!("'{program}' {arguments} --help"));
                    assert!(known, "{}: {command}\n{arguments}\n{text}", document.name);
                    count += 1;
                }
            }
        }
    }
    assert!(count > 15, "they are found: {count}");
    count = 0;
    for document in documents() {
        for (name, program) in programs {
            for arguments in document.calls(name) {
                let (known, text) = bash(&format!("'{program}' {arguments} --help"));
                // An option may be spoken of without its value.
                let spoken_of = known || text.contains("a value is required");
                assert!(spoken_of, "{}: {name} {arguments}\n{text}", document.name);
                count += 1;
            }
        }
    }
    assert!(count > 5, "they are found: {count}");
}
