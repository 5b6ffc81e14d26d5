//! Hostile policies and descriptions: a case is every file that an import reads, and the edits of the policy.
//!
//! A case is [`PARTS`] parts with [`BREAK`] between them, in the order of [`Case`]; what is empty is not there. Any bytes are a case:
//! one of fewer parts is about the small biped of the examples. `tests/fuzz/cases.py` writes cases of real forms.

use std::fs;
use std::path::Path;

use lads_import::{ImportError, Request, import as imported, template};
use tempfile::TempDir;

use super::{open_and_drive, script};
use crate::wire;

/// Number of parts of a case.
pub const PARTS: usize = 7;

/// Bytes between the parts of a case.
pub const BREAK: &[u8] = b"\n----\n";

/// A policy that stands in where a case has none.
const BIPED: &[u8] = include_bytes!("../../../runtime/host/examples/biped/stand.onnx");

/// The parts of a case, in their order.
struct Case<'c> {
    /// Edits of the policy's protocol buffers.
    edits: &'c [u8],
    /// Lines of options: `action NAME`, `state INPUT=OUTPUT`, `wire OUTPUT=INPUT`, `twice` for a second file of the same policy.
    options: &'c [u8],
    robot: &'c [u8],
    deploy: &'c [u8],
    manifest: &'c [u8],
    recording: &'c [u8],
    policy: &'c [u8],
}

impl<'c> Case<'c> {
    fn of(bytes: &'c [u8]) -> Self {
        let mut rest = bytes;
        let mut parts = [&[][..]; PARTS];
        for part in &mut parts[..PARTS - 1] {
            let at = rest.windows(BREAK.len()).position(|bytes| bytes == BREAK);
            let (before, after) = at.map_or((rest, &[][..]), |at| {
                (&rest[..at], &rest[at + BREAK.len()..])
            });
            (*part, rest) = (before, after);
        }
        let [edits, options, robot, deploy, manifest, recording, _] = parts;
        Self {
            edits,
            options,
            robot,
            deploy,
            manifest,
            recording,
            policy: if rest.is_empty() { BIPED } else { rest },
        }
    }

    /// Returns the policy's bytes after the edits, which leave bytes that are not a message as they are.
    fn edited(&self) -> Vec<u8> {
        match wire::parse(self.policy) {
            Some(mut tree) if self.edits.len() >= super::EDIT_BYTES => {
                for edit in script(self.edits) {
                    wire::edit(&mut tree, edit);
                }
                wire::bytes(&tree)
            }
            _ => self.policy.to_vec(),
        }
    }
}

fn pair(text: &str) -> Option<(String, String)> {
    let (a, b) = text.split_once('=')?;
    Some((a.into(), b.into()))
}

/// Imports a case, drives the bundle's image, and prints the form for the same files; returns whether there was a bundle.
///
/// # Panics
///
/// When anything panics, a refusal says nothing or breaks a line, a form is not TOML, or a bundle does not compile.
pub fn import(bytes: &[u8]) -> bool {
    let case = Case::of(bytes);
    let folder = TempDir::new().expect("a folder for the case");
    let path = |name: &str| folder.path().join(name);
    let put = |name: &str, bytes: &[u8]| fs::write(path(name), bytes).expect("it is written");
    let policy = case.edited();
    put("policy.onnx", &policy);
    // External data of any form lies there too.
    put("policy.onnx.data", &policy);
    let texts = [
        ("robot.toml", case.robot),
        ("deploy.yaml", case.deploy),
        ("manifest.json", case.manifest),
        ("run.csv", case.recording),
    ];
    for (name, bytes) in texts.iter().filter(|(_, bytes)| !bytes.is_empty()) {
        put(name, bytes);
    }
    let options = String::from_utf8_lossy(case.options);
    let said = |word: &str| {
        let word = format!("{word} ");
        options
            .lines()
            .filter_map(move |line| Some(line.strip_prefix(&word)?.to_owned()))
    };
    let output = said("action").next_back();
    let twice = options.lines().any(|line| line == "twice");
    if twice {
        put("second.onnx", &policy);
    }
    let (first, second, robot, run) = (
        path("policy.onnx"),
        path("second.onnx"),
        path("robot.toml"),
        path("run.csv"),
    );
    let mut models: Vec<&Path> = vec![&first];
    models.extend(twice.then_some(second.as_path()));
    let request = Request {
        models,
        robot: (!case.robot.is_empty()).then_some(robot.as_path()),
        output: output.as_deref(),
        states: said("state").filter_map(|text| pair(&text)).collect(),
        wires: said("wire").filter_map(|text| pair(&text)).collect(),
        golden: (!case.recording.is_empty()).then_some(run.as_path()),
        ..Request::default()
    };
    match template(&request) {
        Ok(form) => {
            let parsed = toml::from_str::<toml::Table>(&form);
            assert!(parsed.is_ok(), "{form}\n{parsed:?}");
        }
        Err(error) => refused(&error),
    }
    match imported(&request) {
        Ok(made) => {
            let bundle = lads_compiler::Bundle::from_bytes(&made.bundle)
                .expect("a bundle that was made opens");
            let image = lads_compiler::compile(&bundle).expect("a bundle that was made compiles");
            open_and_drive(image.as_bytes());
            true
        }
        Err(error) => {
            refused(&error);
            false
        }
    }
}

/// Checks that a refusal says something, each problem in one line.
fn refused(error: &ImportError) {
    if let ImportError::Problems { problems } = error {
        assert!(
            !problems.is_empty(),
            "nothing is wrong, and nothing was made"
        );
        for problem in problems.all() {
            let line = format!("{}: {}", problem.about, problem.wrong);
            assert!(
                !line.contains('\n') && !problem.wrong.is_empty(),
                "{line:?}"
            );
        }
    } else {
        assert!(!error.to_string().is_empty(), "{error:?}");
    }
}
