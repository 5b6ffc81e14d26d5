//! Frames of the simulation: the same state gives the same bytes, what is asked for is what is drawn, and a cache goes on where it stopped.
//!
//! What the reference renderer draws of the same states is compared in `tests/parity/test_rendering.py`.
#![cfg(feature = "camera")]

#[path = "common/lads_run.rs"]
mod program;

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;

use lads_sim::assets::vendor_dir;
use lads_sim::environment::Environment;
use lads_sim::film::FilmError;
use lads_sim::frames::cache::{self, CacheError, States};
use lads_sim::frames::{Frames, Rendering};
use lads_sim::kitchen::{self, Kitchen, Noise};
use lads_sim::lorel::collect::{Settings, collect};
use lads_sim::lorel::{Lorel, Scene};
use program::lads_run;
use safetensors::SafeTensors;

fn scene() -> Scene {
    Scene::load(&vendor_dir()).unwrap()
}

fn rendering(lorel: &Lorel) -> Rendering {
    lorel.rendering().unwrap()
}

/// A dataset of a few trajectories.
fn dataset(scene: &Scene, path: &Path) -> States {
    let settings = Settings {
        episodes: 4,
        seed: 3,
        threads: 1.try_into().unwrap(),
    };
    let collected = collect(scene, &settings, |_| {}).unwrap();
    collected.write(path).unwrap();
    States::read(path).unwrap()
}

#[test]
fn a_frame_is_a_function_of_the_positions() {
    let mut lorel = Lorel::new(&scene());
    let rendering = rendering(&lorel);
    let mut frames = Frames::new(&lorel, &rendering).unwrap();
    let start = lorel.state().to_vec();
    let first = frames.draw(&start).unwrap().to_vec();
    assert_eq!(first.len(), rendering.frame_len());
    for _ in 0..5 {
        lorel.step(&[1.0, 0.5, -1.0, 0.0, 1.0]).unwrap();
    }
    let moved = frames.draw(lorel.state()).unwrap().to_vec();
    let differ = first.iter().zip(&moved).filter(|(a, b)| a != b).count();
    assert!(differ > first.len() / 50, "{differ} bytes");
    assert_eq!(frames.draw(&start).unwrap(), first);
    let mut others = Frames::new(&lorel, &rendering).unwrap();
    assert_eq!(others.draw(lorel.state()).unwrap(), moved);
}

#[test]
fn a_wider_picture_is_squeezed_to_the_size() {
    let lorel = Lorel::new(&scene());
    let narrow = Rendering {
        size: [16, 16],
        drawn: [64, 80],
        ..rendering(&lorel)
    };
    let mut frames = Frames::new(&lorel, &narrow).unwrap();
    assert_eq!(frames.draw(lorel.state()).unwrap().len(), 16 * 16 * 3);
}

#[test]
fn the_kitchen_has_frames_too() {
    let kitchen = Kitchen::new(&kitchen::Scene::load(&vendor_dir()).unwrap(), Noise::None);
    let rendering = kitchen.rendering().unwrap();
    assert_eq!(rendering.size, [224, 224]);
    let mut frames = Frames::new(&kitchen, &rendering).unwrap();
    let first = frames.draw(kitchen.state()).unwrap().to_vec();
    assert_eq!(first.len(), 224 * 224 * 3);
    // Not black, and not of one colour.
    let mean = first.iter().map(|&value| f64::from(value)).sum::<f64>() / first.len() as f64;
    let (low, high) = (first.iter().min(), first.iter().max());
    assert!((40.0..220.0).contains(&mean), "{mean}");
    assert!(low < Some(&30) && high > Some(&200), "{low:?} to {high:?}");
    assert_eq!(frames.draw(kitchen.state()).unwrap(), first);
}

#[test]
fn what_the_scene_does_not_have_is_named() {
    let lorel = Lorel::new(&scene());
    let refused = |change: fn(&mut Rendering)| {
        let mut bad = rendering(&lorel);
        change(&mut bad);
        Frames::new(&lorel, &bad).err().unwrap().to_string()
    };
    let tail = refused(|it| it.hidden.push("tail".to_owned()));
    assert!(tail.contains("no body 'tail'"), "{tail}");
    let null = refused(|it| it.hidden.push("a\0b".to_owned()));
    assert!(null.contains("null character"), "{null}");
    let none = refused(|it| it.size = [0, 64]);
    assert!(none.contains("[0, 64]"), "{none}");
    let mut frames = Frames::new(&lorel, &rendering(&lorel)).unwrap();
    let short = frames.draw(&[0.0; 3]).unwrap_err();
    assert!(matches!(&short, FilmError::Rendering(_)), "{short}");
    assert!(short.to_string().contains("15 positions"), "{short}");
}

#[test]
fn a_cache_goes_on_where_it_stopped_and_is_the_same() {
    let (scene, folder) = (scene(), tempfile::tempdir().unwrap());
    let path = |name: &str| folder.path().join(name);
    let states = dataset(&scene, &path("lorel.safetensors"));
    let open = || -> Box<dyn Environment> { Box::new(Lorel::new(&scene)) };
    let rendering = rendering(&Lorel::new(&scene));
    let make = |name: &str, threads, stop: &AtomicBool| {
        let all = (&states, &rendering);
        cache::make(all, &path(name), (&open, threads), stop, &mut |_| {})
    };
    let go = AtomicBool::new(false);
    let made = make("whole", 2, &go).unwrap();
    assert_eq!((made.done, made.all), (states.len(), states.len()));
    let whole = std::fs::read(path("whole")).unwrap();
    let frames = SafeTensors::deserialize(&whole).unwrap();
    let frames = frames.tensor("frames").unwrap();
    assert_eq!(frames.shape(), [states.len(), 64, 64, 3]);

    // Half a frame behind some whole ones, as a machine without power leaves it.
    let head = whole.len() - states.len() * rendering.frame_len();
    let begun = head + 7 * rendering.frame_len() + 100;
    std::fs::write(path("again.part"), &whole[..begun]).unwrap();
    let stopped = make("again", 1, &AtomicBool::new(true)).unwrap();
    assert_eq!(stopped.done, 7);
    assert!(!path("again").exists());
    assert_eq!(make("again", 1, &go).unwrap().done, states.len());
    assert_eq!(std::fs::read(path("again")).unwrap(), whole);

    // A file that lost its end, and one of somebody else that is shorter than a header.
    std::fs::write(path("short"), &whole[..whole.len() - 1]).unwrap();
    std::fs::write(path("mine.part"), b"notes").unwrap();
    for name in ["short", "mine"] {
        assert!(matches!(make(name, 1, &go), Err(CacheError::Other(_))));
    }
    assert_eq!(std::fs::read(path("mine.part")).unwrap(), b"notes");
    // Bytes behind the end are cut off.
    let longer = [whole.as_slice(), &whole].concat();
    std::fs::write(path("longer.part"), longer).unwrap();
    assert_eq!(make("longer", 1, &go).unwrap().done, states.len());
    assert_eq!(std::fs::read(path("longer")).unwrap(), whole);

    // A finished file would take a link's place.
    std::os::unix::fs::symlink(path("nowhere"), path("link")).unwrap();
    assert!(matches!(make("link", 1, &go), Err(CacheError::Io { .. })));
    assert!(path("link").is_symlink());

    let other = Rendering {
        samples: 0,
        ..rendering.clone()
    };
    let all = (&states, &other);
    let refused = cache::make(all, &path("again"), (&open, 1), &go, &mut |_| {});
    assert!(matches!(refused, Err(CacheError::Other(_))));
}

#[test]
fn the_shipped_policy_of_a_camera_does_what_it_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("results.json");
    let told = ["--instruction", "turn faucet right", "--episodes", "8"];
    let output = lads_run("lorel-image.onnx", &told)
        .arg("--json")
        .arg(&json)
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    let results: serde_json::Value = serde_json::from_slice(&fs::read(&json).unwrap()).unwrap();
    let done = results["splits"]["atomic"]["full_success_count"].as_u64();
    // Of some five; a policy that is told something else turns it in one of fifteen.
    assert!(done.unwrap() >= 2, "{done:?} of 8 episodes");
}

/// Names of the threads of `lads-run` while it waits for states to draw, started with a number of Mesa's threads or none.
#[cfg(target_os = "linux")]
fn threads(of_mesa: Option<&str>) -> Vec<String> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lads-run"));
    command.args(["frames", "--stream", "lorel-table"]);
    match of_mesa {
        Some(count) => command.env("LP_NUM_THREADS", count),
        None => command.env_remove("LP_NUM_THREADS"),
    };
    let (stdin, stdout) = (Stdio::piped(), Stdio::piped());
    let mut running = command.stdin(stdin).stdout(stdout).spawn().unwrap();
    let mut heading = String::new();
    let mut answers = BufReader::new(running.stdout.take().unwrap());
    answers.read_line(&mut heading).unwrap();
    assert!(heading.contains("positions"), "{heading}");
    let tasks = fs::read_dir(format!("/proc/{}/task", running.id())).unwrap();
    let names = tasks.map(|task| fs::read_to_string(task.unwrap().path().join("comm")).unwrap());
    let names = names.collect();
    drop(running.stdin.take());
    assert!(running.wait().unwrap().success());
    names
}

#[cfg(target_os = "linux")]
#[test]
fn the_renderer_has_no_threads_of_its_own_unless_it_is_told_to() {
    let mesa = |names: &[String]| names.iter().any(|name| name.starts_with("llvmpipe"));
    assert!(!mesa(&threads(None)));
    if !mesa(&threads(Some("2"))) {
        println!("skipped: this machine draws with other than Mesa's software renderer");
    }
}
