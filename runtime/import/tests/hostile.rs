//! Applies random edits to policies, descriptions and the files beside them: every outcome is a
//! bundle or a report, never a panic.
//!
//! `LADS_FUZZ_SECONDS` sets the duration, and `LADS_FORMS` further inputs: a folder with more
//! policies and a description of each, `NAME.onnx` and `NAME.toml`
//! (`tests/parity/test_import.py FOLDER` writes one).

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use lads_import::{ImportError, Request, import, template};
use tempfile::TempDir;

/// Number of edit scripts without `LADS_FUZZ_SECONDS`.
const SCRIPTS: usize = 300;

/// Texts with a meaning to a reader of one of the forms.
const TOKENS: [&str; 14] = [
    "\n[[term]]\n",
    "nan",
    "-1",
    "1e999",
    "[[",
    "]]",
    "&a *a",
    "!!python/object:os.system ",
    "history = 1024\n",
    "\"",
    "{",
    "}",
    ": ",
    "from = \"gravity\"\n",
];

/// Linear congruential generator, of whose numbers the high bits are used.
struct Random(u64);

impl Random {
    fn below(&mut self, most: usize) -> usize {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % most.max(1)
    }

    /// Applies a few edits: a bit, a byte, a token, a piece cut out or doubled.
    fn edit(&mut self, bytes: &mut Vec<u8>) {
        for _ in 0..=self.below(4) {
            let at = self.below(bytes.len());
            let len = self.below(24).min(bytes.len() - at);
            match self.below(5) {
                _ if bytes.is_empty() => bytes.extend_from_slice(b"x"),
                0 => bytes[at] ^= 1 << self.below(8),
                1 => bytes[at] = self.below(256) as u8,
                2 => drop(bytes.drain(at..at + len)),
                3 => {
                    let piece = bytes[at..at + len].to_vec();
                    bytes.splice(at..at, piece);
                }
                _ => {
                    let token = TOKENS[self.below(TOKENS.len())].bytes();
                    bytes.splice(at..at, token);
                }
            }
        }
    }
}

/// Returns policies, each with its description.
fn policies() -> Vec<[Vec<u8>; 2]> {
    let biped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/examples/biped");
    let mut folders = vec![biped];
    folders.extend(std::env::var_os("LADS_FORMS").map(PathBuf::from));
    let mut found: Vec<PathBuf> = folders
        .iter()
        .flat_map(|folder| fs::read_dir(folder).expect("a folder"))
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "onnx"))
        .collect();
    found.sort();
    let described = |path: PathBuf| {
        let own = path.with_extension("toml");
        let common = path.with_file_name("robot.toml");
        let robot = if own.is_file() { own } else { common };
        [path, robot].map(|path| fs::read(path).expect("a file"))
    };
    found.into_iter().map(described).collect()
}

#[test]
fn edited_files_are_imported_or_reported() {
    let deploy = b"step_dt: 0.02\njoint_ids_map: [1, 0]\nstiffness: [10, 20]\nactions: {JointPositionAction: {scale: 0.25, offset: [0, 0], clip: null}}\n\
        observations:\n  joint_pos_rel: {scale: [1.0, 1.0], clip: [-1, 1], history_length: 5}\n";
    let policies = policies();
    let seconds = std::env::var("LADS_FUZZ_SECONDS")
        .ok()
        .and_then(|text| text.parse().ok());
    let until = seconds.map(|seconds| Instant::now() + Duration::from_secs(seconds));
    let folder = TempDir::new().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let (mut random, mut scripts, mut imported) = (Random(7), 0, 0);
    while until.map_or(scripts < SCRIPTS, |until| Instant::now() < until) {
        let [policy, robot] = policies[random.below(policies.len())].clone();
        let mut files = [policy, robot, deploy.to_vec()];
        let edited = random.below(4);
        if let Some(file) = files.get_mut(edited) {
            random.edit(file);
        }
        let named = [path("policy.onnx"), path("robot.toml"), path("beside.yaml")];
        for (path, bytes) in named.iter().zip(&files) {
            fs::write(path, bytes).expect("it is written");
        }
        let mut request = Request {
            models: vec![&named[0]],
            robot: Some(&named[1]),
            ..Request::default()
        };
        // What lies beside contradicts the description, so it comes in only where it is the one that was edited.
        if edited == 2 {
            request.beside = vec![&named[2]];
            request.robot = None;
        }
        let _ = template(&request);
        match import(&request) {
            Ok(_) => imported += 1,
            Err(ImportError::Problems { problems }) => {
                assert!(!problems.is_empty(), "script {scripts}");
            }
            Err(error) => assert!(!error.to_string().is_empty(), "script {scripts}"),
        }
        scripts += 1;
    }
    println!("{scripts} scripts, {imported} imported");
    assert!(
        imported > scripts / 20,
        "most edits break nothing that matters: {imported} of {scripts}"
    );
}
