//! The program `lads` itself, on the small bundle of the compiler's tests: what it answers, and everything that it refuses.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use lads_compiler::{Bundle, compile};
use lads_core::{Golden, Policy, PolicyError, ScheduleError};
use lads_image::Tables;
use lads_image::codec::{Field, Reader, Writer};
use lads_image::format::{COUNT_WORD, CRC_WORD, TABLE_WORD, Tag, crc32};
use lads_image::op::{OP_WORDS, Op, Operand, Space, Span};
use lads_image::records::{ContractRecord, EntryRecord};
use serde_json::Value;

fn tiny() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../compiler/tests/data/tiny.onnx")
}

/// Runs `lads` with `input` on its stdin.
fn lads(arguments: &[&str], input: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads"));
    command
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    // A program that refused its arguments has closed its end.
    let _ = child.stdin.take().unwrap().write_all(input.as_bytes());
    child.wait_with_output().unwrap()
}

/// What `lads` prints when it succeeds.
fn answer(arguments: &[&str], input: &str) -> String {
    let output = lads(arguments, input);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    assert!(output.stderr.is_empty());
    String::from_utf8(output.stdout).unwrap()
}

/// Exit code 2 and one line on stderr with all `parts`; returns what was on stdout.
fn refused(arguments: &[&str], input: &str, parts: &[&str]) -> String {
    let output = lads(arguments, input);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(
        errors.starts_with("error: ") && !errors.contains("panicked"),
        "{errors}"
    );
    for part in parts {
        assert!(errors.contains(part), "'{part}' is not in: {errors}");
    }
    String::from_utf8(output.stdout).unwrap()
}

fn act<'a>(model: &'a str, rest: &[&'a str]) -> Vec<&'a str> {
    [&["act", "--model", model, "--instruction", "dl"], rest].concat()
}

fn with_golden(use_it: impl FnOnce(&Policy<'_>, Golden<'_>)) {
    let image = compile(&Bundle::open(&tiny()).unwrap()).unwrap();
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    use_it(&policy, policy.golden().unwrap());
}

fn csv(values: &[f32]) -> String {
    values
        .iter()
        .map(f32::to_string)
        .collect::<Vec<_>>()
        .join(",")
        + "\n"
}

fn numbers(line: &str) -> Vec<f32> {
    line.trim_matches(['[', ']'])
        .split(',')
        .map(|number| number.parse().unwrap())
        .collect()
}

/// A copy of the small bundle in which one text of its metadata is another of the same length.
fn altered(folder: &Path, from: &str, to: &str) -> String {
    assert_eq!(from.len(), to.len());
    let mut bytes = fs::read(tiny()).unwrap();
    let place = bytes
        .windows(from.len())
        .position(|window| window == from.as_bytes())
        .unwrap();
    bytes[place..place + to.len()].copy_from_slice(to.as_bytes());
    let path = folder.join("altered.onnx");
    fs::write(&path, bytes).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn act_answers_the_golden_episode_in_either_form() {
    let model = tiny().to_str().unwrap().to_owned();
    with_golden(|policy, golden| {
        let instruction = policy
            .contract()
            .instruction(golden.instruction().unwrap() as usize)
            .unwrap();
        let arguments = [
            "act",
            "--model",
            &model,
            "--instruction",
            instruction.text,
            "--plans",
        ];
        let asked: String = golden.steps().map(|step| csv(step.observation())).collect();
        let answered = answer(&arguments, &asked);
        assert_eq!(answered.lines().count(), golden.len());
        for (line, step) in answered.lines().zip(golden.steps()) {
            let (got_index, got) = numbers(line)
                .split_last()
                .map(|(&index, got)| (index, got.to_vec()))
                .unwrap();
            assert_eq!(got_index, step.selected.unwrap() as f32);
            assert_eq!(got.len(), step.action.len());
            assert!(
                got.iter()
                    .zip(step.action)
                    .all(|(a, b)| (a - b).abs() <= golden.tolerance()),
                "{line}"
            );
        }
        let in_json = |lines: &str| format!("[{}]\n", lines.trim().replace('\n', "]\n["));
        assert_eq!(answer(&arguments, &in_json(&asked)), in_json(&answered));
    });
}

#[test]
fn every_line_is_answered_before_the_next_is_sent() {
    let model = tiny().to_str().unwrap().to_owned();
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads"));
    let mut child = command
        .args(act(&model, &[]))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut asked = child.stdin.take().unwrap();
    let mut answered = std::io::BufReader::new(child.stdout.take().unwrap());
    for _ in 0..3 {
        asked.write_all(b"0,0,0,0,0\n").unwrap();
        let mut line = String::new();
        std::io::BufRead::read_line(&mut answered, &mut line).unwrap();
        assert_eq!(numbers(line.trim()).len(), 3);
    }
    drop(asked);
    assert!(child.wait().unwrap().success());
}

#[test]
fn an_empty_line_starts_a_new_episode() {
    let model = tiny().to_str().unwrap().to_owned();
    let episode = "0,0,0,0,0\n0.1,0,0.2,0,0\n0.2,0,0.3,0.5,0\n";
    let once = answer(&act(&model, &["--plans"]), episode);
    let twice = answer(&act(&model, &["--plans"]), &format!("{episode}\n{episode}"));
    assert_eq!(twice, once.repeat(2));
    // Without it the episode goes on: three steps are less than a horizon, so the second plan is drawn later.
    let sample = |seed: u32, asked: &str| {
        let seed = seed.to_string();
        answer(
            &act(&model, &["--plans", "--sample", "--seed", &seed]),
            asked,
        )
    };
    let two = format!("{episode}\n{episode}");
    assert!((0..8).any(|seed| sample(seed, &two) != sample(seed, &episode.repeat(2))));
}

#[test]
fn sampling_follows_its_seed() {
    let model = tiny().to_str().unwrap().to_owned();
    let asked = "0,0,0,0,0\n".repeat(60);
    let sample = |seed: &str| {
        answer(
            &act(&model, &["--plans", "--sample", "--seed", seed]),
            &asked,
        )
    };
    assert_eq!(sample("3"), sample("3"));
    assert_ne!(sample("3"), sample("4"));
}

#[test]
fn a_compiled_image_does_what_its_bundle_does() {
    let folder = tempfile::tempdir().unwrap();
    let (model, image) = (tiny(), folder.path().join("tiny.lads"));
    let (model, image) = (model.to_str().unwrap(), image.to_str().unwrap());
    let said = answer(&["compile", model, "-o", image], "");
    assert!(
        said.contains("tiny.lads") && said.contains("bytes"),
        "{said}"
    );
    assert_eq!(
        fs::read_dir(folder.path()).unwrap().count(),
        1,
        "no temporary file stays"
    );

    let asked = "0,0,0,0,0\n0.1,0,0.2,0,0\n";
    assert_eq!(
        answer(&act(image, &["--plans"]), asked),
        answer(&act(model, &["--plans"]), asked)
    );
    assert_eq!(
        answer(&["self-test", image], ""),
        answer(&["self-test", model], "")
    );
    let inspected = |path: &str| {
        serde_json::from_str::<Value>(&answer(&["inspect", path, "--json"], "")).unwrap()
    };
    let (mut of_bundle, mut of_image) = (inspected(model), inspected(image));
    assert_eq!(
        (of_bundle["form"].take(), of_image["form"].take()),
        ("bundle".into(), "image".into())
    );
    assert_ne!(of_bundle["file"].take(), of_image["file"].take());
    assert_eq!(of_bundle, of_image);
    refused(
        &["compile", image, "-o", "x.lads"],
        "",
        &["tiny.lads", "already", "bundle"],
    );
}

#[test]
fn inspect_tells_what_the_contract_and_the_image_hold() {
    let model = tiny().to_str().unwrap().to_owned();
    let text = answer(&["inspect", &model], "");
    let json: Value = serde_json::from_str(&answer(&["inspect", &model, "--json"], "")).unwrap();
    with_golden(|policy, golden| {
        let contract = policy.contract();
        let elements = contract.channels().flat_map(|channel| channel.elements());
        let names = elements.map(|element| element.name);
        for name in names.chain(contract.instructions().map(|known| known.text)) {
            assert!(text.contains(name), "{name} is not in: {text}");
        }
        let sizes = &json["sizes"];
        assert_eq!(sizes["image_bytes"], policy.image_bytes());
        let [arena, state] = [policy.arena_len(), policy.state_len()].map(|len| 4 * len);
        assert_eq!(sizes["arena_bytes"], arena);
        assert_eq!(sizes["state_bytes"], state);
        let workspace = sizes["workspace_bytes"].as_u64().unwrap() as usize;
        assert!((arena + state..arena + state + 4096).contains(&workspace));
        let tables = Tables::new(policy.image()).unwrap();
        assert_eq!(sizes["weights_bytes"], size_of_val(tables.weights()));
        assert_eq!(json["golden_steps"], golden.len());
        // All states, the action in both banks, and nothing else.
        let states = json["states"].as_array().unwrap().iter();
        let states: u64 = states.map(|state| state["bytes"].as_u64().unwrap()).sum();
        assert_eq!(states as usize + 2 * 4 * contract.action_len(), state);
        assert_eq!(json["worst_multiply_adds"], contract.worst_work());
    });
    let contract = &json["contract"];
    assert_eq!(contract["environment"]["id"], "tiny-bench");
    assert_eq!(contract["control_period_s"], 0.05);
    let channels = contract["channels"].as_array().unwrap();
    let channel = |role: &str| {
        let mut found = channels.iter().filter(|channel| channel["role"] == role);
        found.next().unwrap()
    };
    assert_eq!(channel("observation")["elements"][2]["min"], -0.1);
    assert_eq!(
        channel("observation")["elements"][0]["interface"],
        "position"
    );
    assert_eq!(channel("action")["elements"][2]["scale"], 0.4);
    assert_eq!(json["entries"].as_array().unwrap().len(), 7);
    assert_eq!(json["missing"]["operators"], Value::Array(vec![]));
    assert_eq!(json["missing"]["contract"], Value::Array(vec![]));
}

#[test]
fn inspect_shows_what_runs_at_which_step() {
    let model = tiny().to_str().unwrap().to_owned();
    let text = answer(&["inspect", &model], "");
    let json: Value = serde_json::from_str(&answer(&["inspect", &model, "--json"], "")).unwrap();
    let places = json["schedule"].as_array().unwrap();
    let place = |steps: &str| {
        let mut found = places.iter().filter(|place| place["steps"] == steps);
        found
            .next()
            .unwrap_or_else(|| panic!("no {steps}: {places:?}"))
    };
    let entries = |place: &Value| -> Vec<String> {
        let calls = place["calls"].as_array().unwrap().iter();
        calls
            .map(|call| call["entry"].as_str().unwrap().to_owned())
            .collect()
    };
    let first = ["high_level/start", "codebook/lookup", "low_level/act"];
    assert_eq!(entries(place("first")), first);
    let every = ["high_level/step", "codebook/lookup", "low_level/act"];
    assert_eq!(entries(place("every 4")), every);
    assert_eq!(
        entries(place("other")),
        ["high_level/record", "low_level/act"]
    );
    assert_eq!(place("every 4")["calls"][0]["selects_from"], "logits");
    for name in ["multiply_adds", "weight_bytes", "state_bytes"] {
        let cost = |place: &Value| place[name].as_u64().unwrap();
        let calls = place("every 4")["calls"].as_array().unwrap();
        assert_eq!(cost(place("every 4")), calls.iter().map(cost).sum::<u64>());
        assert!(cost(place("every 4")) > cost(place("other")), "{name}");
    }
    for part in [
        "every 4 steps",
        "high_level/step, selects from logits",
        "other steps",
        "multiply-adds",
        "context                  kv",
    ] {
        assert!(text.contains(part), "{part} is not in: {text}");
    }
}

/// A field of a protocol buffer: its number, and text or a message.
fn field(number: u8, content: &[u8]) -> Vec<u8> {
    let mut len = content.len();
    let mut bytes = vec![number << 3 | 2];
    while len > 127 {
        bytes.push(len as u8 | 128);
        len >>= 7;
    }
    bytes.push(len as u8);
    [bytes, content.to_vec()].concat()
}

/// A node of an ONNX graph.
fn node(operator: &str, name: &str, input: &str, output: &str) -> Vec<u8> {
    let [input, output] =
        [(1, input), (2, output)].map(|(number, text)| field(number, text.as_bytes()));
    let named = [field(3, name.as_bytes()), field(4, operator.as_bytes())].concat();
    field(1, &[input, output, named].concat())
}

/// An f32 value `[batch, len]` at the edge of an ONNX graph, by the number of the graph's field.
fn edge(number: u8, name: &str, len: u8) -> Vec<u8> {
    let dims = [field(1, &field(2, b"batch")), field(1, &[1 << 3, len])].concat();
    let tensor = [vec![1 << 3, 1], field(2, &dims)].concat();
    field(
        number,
        &[field(1, name.as_bytes()), field(2, &field(1, &tensor))].concat(),
    )
}

/// A recurrent policy as somebody else exports one: no contract, and operators of which three are not known.
fn stranger() -> Vec<u8> {
    let nodes = [
        node("Tanh", "squash", "obs", "a"),
        node("Mystery", "first/Mystery", "a", "b"),
        node("Relu", "", "b", "c"),
        node("Enigma", "second/Enigma", "c", "actions"),
        node("Mystery", "third/Mystery", "h_in", "h_out"),
    ];
    let edges = [
        edge(11, "obs", 5),
        edge(11, "h_in", 8),
        edge(12, "actions", 3),
        edge(12, "h_out", 8),
    ];
    let graph = [nodes.concat(), edges.concat()].concat();
    let opset = field(8, &[2 << 3, 17]);
    [vec![1 << 3, 8], field(7, &graph), opset].concat()
}

#[test]
fn inspect_lists_all_that_a_foreign_file_misses() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder
        .path()
        .join("foreign.onnx")
        .to_str()
        .unwrap()
        .to_owned();
    fs::write(&path, stranger()).unwrap();
    let json: Value = serde_json::from_str(&answer(&["inspect", &path, "--json"], "")).unwrap();
    assert_eq!(
        (&json["form"], &json["opset"]),
        (&"onnx".into(), &17.into())
    );
    let missing = &json["missing"];
    let operators = missing["operators"].as_array().unwrap();
    let named: Vec<_> = operators
        .iter()
        .map(|node| {
            (
                node["operator"].as_str().unwrap(),
                node["node"].as_str().unwrap(),
            )
        })
        .collect();
    let expected = [
        ("Mystery", "first/Mystery"),
        ("Enigma", "second/Enigma"),
        ("Mystery", "third/Mystery"),
    ];
    assert_eq!(named, expected);
    assert_eq!(operators[0]["inputs"][0]["shape"], "[1, 5]");
    assert_eq!(
        operators[1]["inputs"][0]["shape"], "?",
        "behind what is not known"
    );
    assert_eq!(operators[2]["inputs"][0]["shape"], "[1, 8]");
    let fields: Vec<_> = missing["contract"]
        .as_array()
        .unwrap()
        .iter()
        .map(|field| field["field"].as_str().unwrap())
        .collect();
    for field in [
        "family",
        "environment",
        "control_period_s",
        "channels[obs]",
        "channels[obs].shape[0]",
        "channels[h_in]",
        "channels[actions]",
        "entries",
        "lads.golden",
    ] {
        assert!(fields.contains(&field), "{field} is not in {fields:?}");
    }
    let text = answer(&["inspect", &path], "");
    for part in [
        "no policy yet",
        "obs: float32 [batch, 5]",
        "operators that are missing (3)",
        "Mystery `first/Mystery` of a [1, 5]",
        "Enigma `second/Enigma`",
        "an output feeds (h_out)",
        "`policy/act/obs`",
    ] {
        assert!(text.contains(part), "'{part}' is not in: {text}");
    }
    // What needs a policy refuses it, in one line.
    refused(
        &["self-test", &path],
        "",
        &["foreign.onnx", "lads.contract"],
    );
}

#[test]
fn inspect_lists_the_fields_that_a_contract_misses() {
    let folder = tempfile::tempdir().unwrap();
    let one = altered(
        folder.path(),
        r#""control_period_s""#,
        r#""control_perioD_s""#,
    );
    let json: Value = serde_json::from_str(&answer(&["inspect", &one, "--json"], "")).unwrap();
    assert_eq!(json["missing"]["operators"], Value::Array(vec![]));
    assert_eq!(json["missing"]["contract"].as_array().unwrap().len(), 1);
    assert_eq!(json["missing"]["contract"][0]["field"], "control_period_s");
}

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
fn bad_observations_are_refused_by_line() {
    let model = tiny().to_str().unwrap().to_owned();
    let arguments = act(&model, &[]);
    let good = "0,0,0,0,0\n";
    for (bad, parts) in [
        ("0,0,0\n", ["line 3", "3 values", "5 finite"]),
        ("0,0,0,nan,0\n", ["line 3", "value 4 is 'nan'", "inspect"]),
        (
            "[0,0,null,0,0]\n",
            ["line 3", "value 3 is 'null'", "element 2 `drawer`"],
        ),
        ("0,0,0,0,inf\n", ["line 3", "value 5 is 'inf'", "inspect"]),
        (
            "0,0,0,99,0\n",
            [
                "line 3",
                "channel `observation`, element 3 `lamp` is 99, its limits are -0.5 to 1.5",
                "inspect",
            ],
        ),
        ("hello\n", ["line 3", "1 values", "inspect"]),
    ] {
        let answered = refused(&arguments, &format!("{good}{good}{bad}{good}"), &parts);
        assert_eq!(
            answered.lines().count(),
            2,
            "the lines before it are answered"
        );
    }
}

#[test]
fn unknown_instructions_show_the_nearest() {
    let model = tiny().to_str().unwrap().to_owned();
    let arguments = ["act", "--model", &model, "--instruction", "open the drower"];
    refused(
        &arguments,
        "",
        &["'open the drower'", "nearest", "'open the drawer' (d)"],
    );
    // Case and white space do not matter.
    let arguments = [
        "act",
        "--model",
        &model,
        "--instruction",
        " Open  the drawer",
    ];
    assert_eq!(answer(&arguments, "0,0,0,0,0\n").lines().count(), 1);
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
            ["altered.onnx", "lads.contract", "export"],
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

/// First word of a section.
fn section(words: &[u32], tag: Tag) -> usize {
    let (rows, _) = words[TABLE_WORD..].as_chunks::<3>();
    let mut rows = rows.iter().take(words[COUNT_WORD] as usize);
    rows.find(|row| row[0] == tag as u32).unwrap()[1] as usize / 4
}

/// An image with an entry whose arena has `elements`, and, where it is to be used, an op over all of it.
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

#[test]
fn weights_of_fewer_bits_pass_a_gate() {
    let folder = tempfile::tempdir().unwrap();
    let (model, image) = (tiny(), folder.path().join("tiny.lads"));
    let (model, image) = (model.to_str().unwrap(), image.to_str().unwrap());
    let compile = |more: &[&'static str]| [&["compile", model, "-o", image], more].concat();
    // The bundle's tolerance is that of 32-bit sums.
    refused(
        &compile(&["--weights", "bf16"]),
        "",
        &["tiny.onnx", "bf16", "step 0", "tolerance"],
    );
    assert!(!Path::new(image).exists());
    let said = answer(&compile(&["--weights", "bf16", "--tolerance", "0.005"]), "");
    assert!(said.contains("bf16 weights: self-test passed"), "{said}");
    let tested = answer(&["self-test", image], "");
    assert!(tested.contains("tolerance 5e-3"), "{tested}");
    answer(&compile(&["--weights", "int8", "--force"]), "");
    refused(&["self-test", image], "", &["self-test failed"]);
    // What only helps to choose the plan takes fewer bits with no other tolerance, and the self-test says so.
    let smaller = ["--weights", "f16", "--low-level", "f32", "--cache", "f16"];
    let said = answer(&compile(&smaller), "");
    let stored = "f16 weights (low level f32) and an f16 cache: self-test passed";
    assert!(said.contains(stored), "{said}");
    answer(&["self-test", image], "");
    for (flag, value, known) in [
        ("--weights", "f8", "f32, int16, f16, bf16, int8"),
        ("--low-level", "f64", "f32, int16, f16, bf16, int8"),
        ("--cache", "bf16", "f32, f16"),
        ("--tolerance", "0", "positive"),
    ] {
        refused(&compile(&[flag, value]), "", &[value, known]);
    }
}

#[test]
fn a_failed_compile_overwrites_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out.lads");
    fs::write(&output, "from before").unwrap();
    let broken = altered(folder.path(), "lads.contract", "some.contract");
    refused(
        &["compile", &broken, "-o", output.to_str().unwrap()],
        "",
        &["altered.onnx"],
    );
    assert_eq!(fs::read_to_string(&output).unwrap(), "from before");
    let nowhere = folder.path().join("no/folder/out.lads");
    let tiny = tiny();
    for place in [nowhere.as_path(), folder.path()] {
        let place = place.to_str().unwrap();
        refused(
            &["compile", tiny.to_str().unwrap(), "-o", place],
            "",
            &[place, "writable folder"],
        );
    }
}

#[test]
fn outputs_are_never_what_is_read_nor_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    fs::copy(tiny(), path("x.onnx")).unwrap();
    let before = fs::read(tiny()).unwrap();
    let (model, same) = (path("x.onnx"), path("sub/../x.onnx"));
    fs::create_dir(path("sub")).unwrap();
    for output in [&model, &same] {
        for option in ["-o", "--emit-c", "--emit-rust"] {
            refused(
                &["compile", &model, option, output],
                "",
                &[option, "x.onnx", "reads", "another file"],
            );
        }
    }
    let c = path("x.c");
    refused(
        &["compile", &model, "-o", &c, "--emit-c", &c],
        "",
        &["--emit-c", "x.c", "-o writes the same file"],
    );
    refused(
        &["compile", &model, "--emit-c", &c, "--emit-rust", &c],
        "",
        &["--emit-rust", "x.c", "--emit-c writes the same file"],
    );
    assert_eq!(fs::read(&model).unwrap(), before, "it was not touched");
    assert!(!Path::new(&c).exists());
}

#[cfg(unix)]
#[test]
fn devices_and_links_stay_what_they_are() {
    use std::os::unix::fs::{FileTypeExt as _, symlink};

    let (tiny, folder) = (tiny(), tempfile::tempdir().unwrap());
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let model = tiny.to_str().unwrap();
    fs::create_dir(path("there")).unwrap();
    symlink("there/a.lads", path("link.lads")).unwrap();
    symlink("/dev/null", path("null.lads")).unwrap();
    answer(&["compile", model, "-o", &path("link.lads")], "");
    answer(&["compile", model, "-o", &path("null.lads")], "");
    answer(&["compile", model, "-o", "/dev/null"], "");
    assert!(
        fs::metadata("/dev/null")
            .unwrap()
            .file_type()
            .is_char_device()
    );
    for link in ["link.lads", "null.lads"] {
        assert!(
            fs::symlink_metadata(path(link)).unwrap().is_symlink(),
            "{link}"
        );
    }
    answer(&["self-test", &path("there/a.lads")], "");
    // The image, and after it the line about it.
    let output = lads(&["compile", model, "-o", "/dev/stdout"], "");
    let image = fs::read(path("there/a.lads")).unwrap();
    assert!(output.status.success() && output.stdout.starts_with(&image));
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
fn observations_of_the_golden_episode_go_through_the_pipe() {
    let tiny = tiny();
    let model = tiny.to_str().unwrap();
    let observations = answer(&["inspect", model, "--observations"], "");
    with_golden(|_, golden| {
        let written: String = golden.steps().map(|step| csv(step.observation())).collect();
        assert_eq!(observations, written);
        assert_eq!(
            answer(&act(model, &[]), &observations).lines().count(),
            golden.len()
        );
    });
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

#[test]
fn bench_measures_every_kind_of_step() {
    let tiny = tiny();
    let tiny = tiny.to_str().unwrap();
    let short = [
        "bench",
        "--model",
        tiny,
        "--rate",
        "2000",
        "--seconds",
        "0.2",
    ];
    let text = answer(&short, "");
    for part in [
        "ordinary", "decision", "instruct", "act", "wake-up", "misses",
    ] {
        assert!(text.contains(part), "no '{part}' in:\n{text}");
    }
    let report: Value =
        serde_json::from_str(&answer(&[&short[..], &["--json"]].concat(), "")).unwrap();
    let contender = &report["contenders"][0];
    assert_eq!(contender["name"], "lads f32");
    let latency = &contender["latency_us"];
    for kind in ["act", "ordinary", "decision", "instruct"] {
        let [p50, max] = ["p50", "max"].map(|q| latency[kind][q].as_f64().unwrap());
        assert!(p50 > 0.0 && p50 <= max, "{kind}: {latency}");
    }
    assert!(contender["largest_error"].as_f64().unwrap() < 1e-4);
    // 24 control steps in parts of two horizons of 4.
    let growth = contender["growth_us"].as_array().unwrap();
    assert!(!growth.is_empty() && growth[0][0] == 0, "{growth:?}");
}

#[test]
fn bench_refuses_what_makes_no_sense() {
    let tiny = tiny();
    let tiny = tiny.to_str().unwrap();
    for (arguments, parts) in [
        (&["--rate", "0"][..], &["--rate", "0.1 to 10000"][..]),
        (&["--rate", "nan"], &["--rate", "0.1 to 10000"]),
        (&["--seconds=-1"], &["--seconds", "0.1 to 86400"]),
        (&["--load", "100000"], &["--load", "at most"]),
    ] {
        refused(
            &[&["bench", "--model", tiny], arguments].concat(),
            "",
            parts,
        );
    }
    refused(&["bench", "--model", "no.onnx"], "", &["no.onnx"]);
}
