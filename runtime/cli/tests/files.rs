//! Tests of files and arguments that no command accepts, and of the self-test.

mod common;

use std::fs;
use std::path::Path;
use std::process::Command;

use lads_compiler::{Bundle, compile};
use lads_core::{Policy, PolicyError, ScheduleError};
use lads_image::Tables;
use lads_image::codec::{Field, Reader, Writer};
use lads_image::format::{COUNT_WORD, CRC_WORD, TABLE_WORD, Tag, crc32};
use lads_image::op::{OP_WORDS, Op, Operand, Space, Span};
use lads_image::records::{ContractRecord, EntryRecord};

use common::{act, altered, answer, refused, tiny};

#[test]
fn self_test_passes_and_a_changed_golden_episode_fails() {
    let model = tiny().to_str().unwrap().to_owned();
    let said = answer(&["self-test", &model], "");
    assert!(said.starts_with("self-test passed: 24 steps"), "{said}");

    let folder = tempfile::tempdir().unwrap();
    let image = folder.path().join("tiny.lads");
    answer(&["compile", &model, "-o", image.to_str().unwrap()], "");
    let image = image.to_str().unwrap();
    let mut bytes = fs::read(image).unwrap();
    // The last word of an image is the last element of the last recorded action.
    let last = bytes.len() - 1;
    bytes[last] ^= 0x40;
    fs::write(image, &bytes).unwrap();
    let parts = ["tiny.lads", "checksum", "compile it again"];
    refused(&["self-test", image], "", &parts);
    // With the checksum put right, the comparison has to find it.
    let crc = crc32(&bytes);
    bytes[4 * CRC_WORD..4 * CRC_WORD + 4].copy_from_slice(&crc.to_le_bytes());
    fs::write(image, &bytes).unwrap();
    let parts = ["tiny.lads", "self-test failed", "step 23", "export"];
    refused(&["self-test", image], "", &parts);
    let answered = refused(&act(image, &[]), "0,0,0,0,0\n", &parts);
    assert!(answered.is_empty(), "it is not let near a motor");
}

#[test]
fn bad_files_are_refused_by_every_command() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let bytes = fs::read(tiny()).unwrap();
    fs::write(path("text.onnx"), "no model at all\n").unwrap();
    fs::write(path("half.onnx"), &bytes[..bytes.len() / 2]).unwrap();
    fs::write(path("empty.onnx"), "").unwrap();
    answer(
        &[
            "compile",
            tiny().to_str().unwrap(),
            "-o",
            &path("whole.lads"),
        ],
        "",
    );
    let image = fs::read(path("whole.lads")).unwrap();
    fs::write(path("half.lads"), &image[..image.len() / 2]).unwrap();
    let cases = [
        (path("none.onnx"), ["none.onnx", "No such file", "bundle"]),
        (path("text.onnx"), ["text.onnx", "ONNX", "exporter"]),
        (path("empty.onnx"), ["empty.onnx", "ONNX", "exporter"]),
        (path("half.onnx"), ["half.onnx", "truncated", "again"]),
        (
            path("half.lads"),
            ["half.lads", "bytes", "compile it again"],
        ),
        (
            altered(folder.path(), "lads.contract", "some.contract"),
            ["altered.onnx", "lads.contract", "lads import"],
        ),
    ];
    for (model, parts) in cases {
        let output = path("out.lads");
        if parts[0] == "altered.onnx" {
            // An ONNX model all the same, whose lack is listed.
            let listed = answer(&["inspect", &model], "");
            assert!(
                listed.contains("operators that are missing (0)"),
                "{listed}"
            );
        } else {
            refused(&["inspect", &model], "", &parts);
        }
        refused(&["self-test", &model], "", &parts);
        refused(&["compile", &model, "-o", &output], "", &parts);
        refused(&act(&model, &[]), "", &parts);
        assert!(!Path::new(&output).exists());
    }
    let newer = altered(
        folder.path(),
        r#"{"version": 2, "family""#,
        r#"{"version": 7, "family""#,
    );
    refused(
        &["inspect", &newer],
        "",
        &["altered.onnx", "version 7", "version 2"],
    );
    let older = altered(
        folder.path(),
        r#"{"version": 2, "family""#,
        r#"{"version": 1, "family""#,
    );
    let parts = ["altered.onnx", "version 1", "lads_exporter upgrade"];
    refused(&["inspect", &older], "", &parts);
}

/// Returns the first word of a section.
fn section(words: &[u32], tag: Tag) -> usize {
    let (rows, _) = words[TABLE_WORD..].as_chunks::<3>();
    let mut rows = rows.iter().take(words[COUNT_WORD] as usize);
    rows.find(|row| row[0] == tag as u32).unwrap()[1] as usize / 4
}

/// Makes an image with an entry whose arena has `elements`, and, if it is to be used, an op over
/// all of it.
fn greedy(image: &[u8], elements: u32, used: bool) -> Vec<u8> {
    let tables = Tables::new(image).unwrap();
    let mut entries = (0..tables.entries_len()).map(|i| tables.entry(i).unwrap());
    let named = |entry: &EntryRecord| tables.text(entry.name) == "trajectory_encoder/encode";
    let index = entries.position(|entry| named(&entry)).unwrap();
    let (words, _) = image.as_chunks::<4>();
    let mut words: Vec<u32> = words.iter().map(|&word| u32::from_le_bytes(word)).collect();
    let at = section(&words, Tag::Entries) + index * EntryRecord::WORDS;
    let mut record = EntryRecord::take(&mut Reader::new(&words[at..])).unwrap();
    record.arena_len = elements;
    record.put(&mut Writer::new(&mut words[at..]));
    if used {
        let first = section(&words, Tag::Ops) + record.first_op as usize * OP_WORDS;
        let (ops, _) = words[first..].as_chunks_mut::<OP_WORDS>();
        let unary = ops.iter_mut().find_map(|words| match Op::decode(words) {
            Some(Op::Unary(op)) => Some((words, op)),
            _ => None,
        });
        let (words, mut op) = unary.expect("the trajectory encoder has such an op");
        let len = elements / 2;
        op.x = Operand {
            space: Space::Arena,
            offset: 0,
            len,
        };
        op.y = Span { offset: len, len };
        *words = Op::Unary(op).encode();
    }
    let sealed = |words: &[u32]| {
        let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        let crc = crc32(&bytes);
        bytes[CRC_WORD * 4..][..4].copy_from_slice(&crc.to_le_bytes());
        bytes
    };
    // It says truly what that costs.
    let bytes = lads_host::Aligned::new(&sealed(&words));
    if let Err(PolicyError::Schedule(ScheduleError::Work { counted, .. })) =
        Policy::new_checked(bytes.as_bytes())
    {
        let at = section(&words, Tag::Contract);
        let mut record = ContractRecord::take(&mut Reader::new(&words[at..])).unwrap();
        record.worst_work = counted;
        record.put(&mut Writer::new(&mut words[at..]));
    }
    sealed(&words)
}

#[test]
fn an_image_that_asks_for_gigabytes_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder
        .path()
        .join("greedy.lads")
        .to_str()
        .unwrap()
        .to_owned();
    let image = compile(&Bundle::open(&tiny()).unwrap()).unwrap();
    let write =
        |elements, used| fs::write(&path, greedy(image.as_bytes(), elements, used)).unwrap();
    for elements in [1 << 30, u32::MAX] {
        write(elements, false);
        let parts = [
            "greedy.lads",
            "larger arena than it uses",
            "compile it again",
        ];
        refused(&["inspect", &path], "", &parts);
        refused(&["self-test", &path], "", &parts);
        refused(&act(&path, &[]), "", &parts);
    }
    for elements in [1 << 28, u32::MAX - 1] {
        write(elements, true);
        assert!(answer(&["inspect", &path], "").contains(&(u64::from(elements) * 4).to_string()));
        let parts = ["greedy.lads", "workspace of", "at most 1073741824"];
        refused(&["self-test", &path], "", &parts);
        refused(&act(&path, &[]), "", &parts);
    }
}

#[cfg(unix)]
#[test]
fn what_has_no_end_is_not_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let fifo = folder.path().join("fifo.onnx");
    let made = Command::new("mkfifo").arg(&fifo).status().unwrap();
    assert!(made.success());
    for model in ["/dev/zero", fifo.to_str().unwrap()] {
        for arguments in [
            &["self-test", model][..],
            &["inspect", model],
            &act(model, &[]),
        ] {
            refused(arguments, "", &[model, "not a regular file"]);
        }
    }
    // Three elements and the rest of a line, and no memory for what never ends.
    let tiny = tiny();
    let endless = "1".repeat(1 << 20);
    refused(
        &act(tiny.to_str().unwrap(), &[]),
        &endless,
        &["line 1", "longer than", "bytes"],
    );
}

#[test]
fn bad_arguments_are_one_line() {
    let tiny = tiny();
    refused(
        &["act", "--model", tiny.to_str().unwrap()],
        "",
        &["--instruction", "takes an instruction", "inspect"],
    );
    refused(&["act"], "", &["--model", "--help"]);
    refused(&["dance"], "", &["dance", "--help"]);
    refused(&[], "", &["subcommand", "self-test", "--help"]);
    refused(
        &["act", "--model", "m", "--instruction", "x", "--seed", "3"],
        "",
        &["--sample"],
    );
    assert!(answer(&["--help"], "").contains("self-test"));
}
