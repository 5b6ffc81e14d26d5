//! Tests of `lads act`: observations in, actions out, through a pipe.

mod common;

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};

use serde_json::Value;

use common::{act, answer, csv, numbers, refused, tiny, with_golden};

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
    // Without it the episode continues: three steps are less than a horizon, so the second plan is drawn later.
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

/// The observations of the golden episode twice, with a new episode between, and what is answered.
fn two_episodes(arguments: &[&str]) -> (Vec<String>, Vec<String>) {
    let episode = answer(&["inspect", tiny().to_str().unwrap(), "--observations"], "");
    let answered = answer(arguments, &format!("{episode}\n{episode}"));
    let lines = |text: &str| text.lines().map(str::to_owned).collect();
    (lines(&episode), lines(&answered))
}

#[test]
fn a_log_holds_every_step_of_every_episode() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flight.mcap");
    let model = tiny().to_str().unwrap().to_owned();
    let arguments = act(&model, &["--plans", "--log", path.to_str().unwrap()]);
    let (asked, answered) = two_episodes(&arguments);
    let log = lads_record::read(&path).unwrap();
    with_golden(|policy, _| {
        assert_eq!(log.origin, lads_record::Origin::of(policy));
        assert_eq!(log.origin.period, Some(4), "of the contract");
        assert_eq!(log.origin.observation_names[3], "lamp");
    });
    assert_eq!(log.flights.len(), 2);
    let mut answered = answered.iter();
    for (number, flight) in (0..).zip(&log.flights) {
        assert_eq!(
            (flight.instruction_id.as_str(), flight.trace.episode),
            ("dl", number)
        );
        assert_eq!(flight.trace.continued, number > 0);
        assert_eq!(flight.trace.steps.len(), asked.len());
        for ((step, asked), answered) in flight.trace.steps.iter().zip(&asked).zip(&mut answered) {
            let mut answer = numbers(answered);
            assert_eq!(step.plan.map(|plan| plan as f32), answer.pop());
            assert_eq!(
                (&step.observation, &step.action),
                (&numbers(asked), &answer)
            );
            assert_eq!(step.executed, step.action);
            assert_eq!(step.scores.is_empty(), !step.decided);
            assert!(step.controller_ns > 0);
        }
    }
    assert_eq!(
        fs::read_dir(folder.path()).unwrap().count(),
        1,
        "no draft is left"
    );
}

#[cfg(unix)]
#[test]
fn a_log_is_whole_after_an_interrupt() {
    let folder = tempfile::tempdir().unwrap();
    let model = tiny().to_str().unwrap().to_owned();
    for signal in ["-INT", "-TERM"] {
        let path = folder.path().join(format!("flight{signal}.mcap"));
        // As under `nohup`: a hang-up that is switched off stays off.
        let mut child = Command::new("sh")
            .args(["-c", "trap '' HUP; exec \"$@\"", "sh"])
            .arg(env!("CARGO_BIN_EXE_lads"))
            .args(act(&model, &["--log", path.to_str().unwrap()]))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let pid = child.id().to_string();
        let kill = |signal: &str| {
            let sent = Command::new("kill").arg(signal).arg(&pid).status();
            assert!(sent.unwrap().success());
        };
        let mut stdin = child.stdin.take().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap()).lines();
        // Three are recorded for certain: a step is once it has been answered.
        for _ in 0..4 {
            stdin.write_all(b"0,0,0,0,0\n").unwrap();
            stdout.next().unwrap().unwrap();
            kill("-HUP");
        }
        assert!(!path.exists(), "its path is untouched while it runs");
        kill(signal);
        assert_eq!(child.wait().unwrap().code(), Some(130), "{signal}");
        let log = lads_record::read(&path).unwrap();
        assert!(log.flights[0].trace.steps.len() >= 3, "{signal}");
    }
}

#[test]
fn a_log_ends_before_what_is_refused_and_is_refused_itself_where_it_cannot_be() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flight.mcap");
    let model = tiny().to_str().unwrap().to_owned();
    let arguments = act(&model, &["--log", path.to_str().unwrap()]);
    refused(&arguments, "0,0,0,0,0\n0,0,0,99,0\n", &["line 2"]);
    let log = lads_record::read(&path).unwrap();
    assert_eq!(log.flights[0].trace.steps.len(), 1);
    // Nothing came: a log without an episode.
    assert_eq!(answer(&arguments, ""), "");
    assert!(lads_record::read(&path).unwrap().flights.is_empty());

    let absent = folder.path().join("absent/flight.mcap");
    let good = "0,0,0,0,0\n";
    let absent = absent.to_str().unwrap();
    let answered = refused(&act(&model, &["--log", absent]), good, &["--log", "folder"]);
    assert_eq!(answered, "", "it is refused before the first step");
    refused(
        &act(&model, &["--log", &model]),
        good,
        &["--log", "--model"],
    );
    let full = refused(&act(&model, &["--log", "/dev/full"]), good, &["/dev/full"]);
    assert_eq!(full.lines().count(), 1, "the policy answers all the same");
}

#[cfg(unix)]
#[test]
fn a_log_that_may_not_grow_ends_alone() {
    const STEPS: usize = 400;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flight.mcap");
    let model = tiny().to_str().unwrap().to_owned();
    // Blocks of 512 bytes.
    let mut child = Command::new("sh")
        .args(["-c", "ulimit -f 8; exec \"$@\"", "sh"])
        .arg(env!("CARGO_BIN_EXE_lads"))
        .args(act(&model, &["--log", path.to_str().unwrap()]))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let asks = std::thread::spawn(move || stdin.write_all("0,0,0,0,0\n".repeat(STEPS).as_bytes()));
    let output = child.wait_with_output().unwrap();
    asks.join().unwrap().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("goes on without it"), "{said}");
    let answers = String::from_utf8_lossy(&output.stdout);
    assert_eq!(answers.lines().count(), STEPS);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[cfg(unix)]
#[test]
fn a_log_is_neither_what_is_read_nor_what_is_answered() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file");
    let model = tiny().to_str().unwrap().to_owned();
    for [read, written] in [[true, false], [false, true]] {
        fs::write(&path, "0,0,0,0,0\n").unwrap();
        let file = || {
            fs::OpenOptions::new()
                .read(true)
                .append(true)
                .open(&path)
                .unwrap()
        };
        let mut command = Command::new(env!("CARGO_BIN_EXE_lads"));
        command.args(act(&model, &["--log", path.to_str().unwrap()]));
        command.stdin(if read { file().into() } else { Stdio::null() });
        command.stdout(if written {
            file().into()
        } else {
            Stdio::null()
        });
        let output = command.stderr(Stdio::piped()).output().unwrap();
        let errors = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{errors}");
        assert!(
            errors.contains("--log") && errors.contains("the command"),
            "{errors}"
        );
        assert_eq!(fs::read_to_string(&path).unwrap(), "0,0,0,0,0\n");
    }
}

#[cfg(unix)]
#[test]
fn a_log_on_its_way_to_a_pipe_that_nobody_reads_can_be_interrupted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pipe");
    let made = Command::new("mkfifo").arg(&path).status().unwrap();
    assert!(made.success());
    let model = tiny().to_str().unwrap().to_owned();
    let mut child = Command::new(env!("CARGO_BIN_EXE_lads"))
        .args(act(&model, &["--log", path.to_str().unwrap()]))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // Its input ends after one answer; what is left is the log.
    let mut stdin = child.stdin.take().unwrap();
    stdin.write_all(b"0,0,0,0,0\n").unwrap();
    BufReader::new(child.stdout.take().unwrap())
        .read_line(&mut String::new())
        .unwrap();
    drop(stdin);
    let killed = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status();
    assert!(killed.unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130));
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(
        errors.contains("--log"),
        "it says that there is none: {errors}"
    );
}
