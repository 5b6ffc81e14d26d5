//! Workflows call rules of the Makefile that exist, and nothing of the project's besides, so that what CI does can be typed.

use std::fs;
use std::process::Command;

use lads_tests::project_path;

#[test]
fn workflows_call_rules_that_exist() {
    let folder = project_path(".github/workflows");
    let (mut count, mut wrong) = (0, vec![]);
    for entry in fs::read_dir(folder).expect("there are workflows") {
        let path = entry.expect("it can be read").path();
        let text = fs::read_to_string(&path).expect("it is text");
        for line in text.lines() {
            let line = line.trim().trim_start_matches("- ");
            let Some(command) = line.strip_prefix("run: make ") else {
                continue;
            };
            count += 1;
            let mut make = Command::new("make");
            make.arg("-n").args(command.split_whitespace());
            make.env_remove("MAKEFLAGS").env_remove("MAKELEVEL");
            let output = make.current_dir(project_path(".")).output();
            let output = output.expect("there is make");
            if !output.status.success() {
                let said = String::from_utf8_lossy(&output.stderr).into_owned();
                wrong.push(format!("{}: make {command}: {said}", path.display()));
            }
        }
    }
    assert!(count >= 5, "they are found: {count}");
    assert!(wrong.is_empty(), "{wrong:#?}");
}
