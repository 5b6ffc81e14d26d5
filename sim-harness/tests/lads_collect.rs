//! Tests what `lads-collect` refuses, before any work: one line that names the thing and the remedy, exit code 2, nothing written.

use std::process::Command;

fn assert_refused(arguments: &[&str], parts: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_lads-collect"))
        .args(arguments)
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(output.stdout.is_empty());
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(errors.starts_with("error: "), "{errors}");
    for part in parts {
        assert!(errors.contains(part), "'{part}' is not in: {errors}");
    }
}

#[test]
fn refusals_are_one_line_and_write_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("d.safetensors");
    let file = file.to_str().unwrap();
    assert_refused(&["--env", "attic"], &["attic", "kitchen"]);
    assert_refused(
        &["-o", file, "--episodes-per-instruction", "0"],
        &["at least 1"],
    );
    assert_refused(&["-o", file, "--recovery-noise=-1"], &["between 0 and 1"]);
    assert_refused(&["-o", folder.path().to_str().unwrap()], &["folder", "-o"]);
    // A file where a folder is needed.
    std::fs::write(file, "old").unwrap();
    assert_refused(&["-o", &format!("{file}/d")], &["cannot be written", "-o"]);
    assert_eq!(std::fs::read_to_string(file).unwrap(), "old");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
