use std::fs;
use std::io::{Read as _, Write as _};
use std::os::unix::fs::{FileTypeExt as _, PermissionsExt as _, symlink};
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, FileType, Mode, mknodat};

use super::*;

fn scratch() -> (tempfile::TempDir, impl Fn(&str) -> PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().to_owned();
    (folder, move |name| root.join(name))
}

fn entries(folder: &Path) -> usize {
    fs::read_dir(folder).unwrap().count()
}

#[test]
fn a_file_is_replaced_as_a_whole() {
    let (folder, path) = scratch();
    let target = path("r.json");
    fs::write(&target, "something much longer than what comes").unwrap();
    fs::set_permissions(&target, fs::Permissions::from_mode(0o640)).unwrap();
    write(&target, b"new").unwrap();
    assert_eq!(fs::read(&target).unwrap(), b"new");
    let mode = fs::metadata(&target).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o640, "it keeps its mode");
    assert_eq!(entries(folder.path()), 1, "no temporary file stays");
}

#[test]
fn what_is_not_committed_leaves_the_old_file() {
    let (folder, path) = scratch();
    let target = path("r.json");
    fs::write(&target, "old").unwrap();
    let mut begun = draft(&target).unwrap();
    begun.write_all(b"half of").unwrap();
    drop(begun);
    assert_eq!(fs::read(&target).unwrap(), b"old");
    assert_eq!(entries(folder.path()), 1, "no temporary file stays");
    assert!(draft(folder.path()).is_err(), "a folder is no target");
    assert!(draft(&path("no/such/r.json")).is_err());
    draft_with_folder(&path("no/such/r.json"))
        .unwrap()
        .commit()
        .unwrap();
    assert!(path("no/such/r.json").is_file());
}

#[test]
fn a_link_is_followed_and_stays() {
    let (_folder, path) = scratch();
    fs::create_dir(path("there")).unwrap();
    fs::write(path("there/a"), "old").unwrap();
    symlink("there/a", path("link")).unwrap();
    symlink("link", path("link to link")).unwrap();
    symlink("there/new", path("dangling")).unwrap();
    write(&path("link to link"), b"new").unwrap();
    write(&path("dangling"), b"made").unwrap();
    assert_eq!(fs::read(path("there/a")).unwrap(), b"new");
    assert_eq!(fs::read(path("there/new")).unwrap(), b"made");
    for link in ["link", "link to link", "dangling"] {
        assert!(
            fs::symlink_metadata(path(link)).unwrap().is_symlink(),
            "{link}"
        );
    }
    symlink("round", path("round")).unwrap();
    assert!(write(&path("round"), b"x").is_err());
}

#[test]
fn a_fifo_is_written_into() {
    let (_folder, path) = scratch();
    let fifo = path("fifo");
    mknodat(CWD, &fifo, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
    let from = fifo.clone();
    let reader = std::thread::spawn(move || {
        let mut got = vec![];
        fs::File::open(from).unwrap().read_to_end(&mut got).unwrap();
        got
    });
    write(&fifo, b"through").unwrap();
    assert_eq!(reader.join().unwrap(), b"through");
    assert!(fs::metadata(&fifo).unwrap().file_type().is_fifo());
}

#[test]
fn a_device_is_written_into() {
    write(Path::new("/dev/null"), b"gone").unwrap();
    assert!(
        fs::metadata("/dev/null")
            .unwrap()
            .file_type()
            .is_char_device()
    );
    let (_folder, path) = scratch();
    symlink("/dev/null", path("null")).unwrap();
    write(&path("null"), b"gone").unwrap();
    assert!(fs::symlink_metadata(path("null")).unwrap().is_symlink());
    // As root, one of its own: nothing of the machine is at stake.
    let node = path("node");
    let made = mknodat(
        CWD,
        &node,
        FileType::CharacterDevice,
        Mode::from_raw_mode(0o600),
        rustix::fs::makedev(1, 3),
    );
    if made.is_ok() && fs::OpenOptions::new().append(true).open(&node).is_ok() {
        write(&node, b"gone").unwrap();
        assert!(fs::metadata(&node).unwrap().file_type().is_char_device());
    }
}

#[test]
fn one_file_under_two_names_is_found() {
    let (_folder, path) = scratch();
    fs::write(path("model.onnx"), "model").unwrap();
    fs::create_dir(path("sub")).unwrap();
    symlink("model.onnx", path("link.onnx")).unwrap();
    fs::hard_link(path("model.onnx"), path("hard.onnx")).unwrap();
    symlink("new.json", path("dangling")).unwrap();
    let refused = |input: &str, outputs: &[&str]| {
        let (input, outputs): (_, Vec<_>) =
            (path(input), outputs.iter().map(|it| path(it)).collect());
        let options = ["-o", "--json"];
        let outputs: Vec<Named> = options
            .into_iter()
            .zip(&outputs)
            .map(|(o, p)| (o, p.as_path()))
            .collect();
        check(&[("", &input)], &outputs)
            .err()
            .map(|error| error.to_string())
    };
    for same in ["model.onnx", "sub/../model.onnx", "link.onnx", "hard.onnx"] {
        let line = refused("model.onnx", &[same]).unwrap();
        assert!(
            line.contains(same) && line.contains("the command reads"),
            "{line}"
        );
    }
    for pair in [["new.json", "sub/../new.json"], ["new.json", "dangling"]] {
        let line = refused("model.onnx", &pair).unwrap();
        assert!(
            line.contains("--json") && line.contains("-o writes the same file"),
            "{line}"
        );
    }
    assert_eq!(refused("model.onnx", &["a", "b"]), None);
    let null = Path::new("/dev/null");
    assert!(
        check(&[("", null)], &[("-o", null), ("--json", null)]).is_ok(),
        "it takes from everybody"
    );
    let line = refused("model.onnx", &["no/such"]).unwrap();
    assert!(line.contains("writable folder"), "{line}");
    assert_eq!(fs::read(path("model.onnx")).unwrap(), b"model");
}
