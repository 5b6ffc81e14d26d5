//! Tests that the examples of controllers build as strictly as compilers can and do what they say.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use lads_tests::{built, compiled, project_path};

const STRICT: [&str; 5] = ["-O2", "-Wall", "-Wextra", "-Werror", "-pedantic"];

fn scratch(path: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(path)
}

fn output(command: &mut Command) -> (bool, String) {
    let Output {
        status,
        stdout,
        stderr,
    } = command
        .output()
        .unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let text = [stdout, stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    (status.success(), text.concat())
}

/// Runs a command that has to succeed and returns its output.
fn run(command: &mut Command) -> String {
    let (success, text) = output(command);
    assert!(success, "{command:?}\n{text}");
    text
}

/// Installs the library once and returns its folder.
fn prefix() -> &'static Path {
    static PREFIX: OnceLock<PathBuf> = OnceLock::new();
    PREFIX.get_or_init(|| {
        let prefix = scratch("prefix");
        run(Command::new(project_path("runtime/ffi/install.sh")).arg(&prefix));
        prefix
    })
}

/// Compiles the shipped policy to a file once and returns its path.
fn kitchen() -> &'static Path {
    static IMAGE: OnceLock<PathBuf> = OnceLock::new();
    IMAGE.get_or_init(|| {
        let image = compiled(&project_path("models/kitchen.onnx"));
        fs::write(scratch("kitchen.lads"), image.as_bytes()).expect("it can be written");
        scratch("kitchen.lads")
    })
}

fn build(compiler: &str, standard: &str, source: &str, more: &[String]) -> Command {
    let program = scratch(&source.replace(['/', '.'], "_"));
    let root = prefix().display();
    run(Command::new(compiler)
        .args(STRICT)
        .arg(standard)
        .arg(format!("-I{root}/include"))
        .arg(project_path("runtime/ffi/examples").join(source))
        .arg("-o")
        .arg(&program)
        .args([format!("-L{root}/lib"), "-llads".into()])
        .args(more));
    Command::new(program)
}

fn kitchen_c(arguments: &[&str]) -> (bool, String) {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    let mujoco = project_path("vendor/mujoco");
    let mujoco = mujoco.canonicalize().expect("make setup has fetched it");
    let mujoco = mujoco.display();
    let more = [
        format!("-isystem{mujoco}/include"),
        format!("-L{mujoco}/lib"),
        "-lmujoco".into(),
        format!("-Wl,-rpath,{mujoco}/lib"),
        "-lm".into(),
    ];
    let program = PROGRAM.get_or_init(|| {
        let command = build("cc", "-std=c99", "c/kitchen.c", &more);
        command.get_program().into()
    });
    let scene = "vendor/assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml";
    output(
        Command::new(program)
            .arg(kitchen())
            .arg(project_path(scene))
            .args(arguments),
    )
}

#[test]
fn the_kitchen_in_c_completes_sub_tasks() {
    let (_, text) = kitchen_c(&["kbls", "--fast"]);
    let completed = text
        .lines()
        .filter(|line| line.contains(" s  ") && !line.contains("nobody asked"))
        .count();
    println!("{text}");
    // All four on the machine that this was written on; trajectories differ in their last bits between machines.
    assert!(completed >= 2, "{text}");
    assert!(text.contains(" 0 missed"), "{text}");
}

#[test]
fn the_kitchen_in_c_keeps_the_real_control_period() {
    // Ten periods of 80 ms: nothing can be completed yet, and whether one is missed is the machine's affair.
    let started = std::time::Instant::now();
    let (success, text) = kitchen_c(&["kbls", "--steps", "10"]);
    assert!(
        !success && text.contains("4 sub-tasks left; 10 periods"),
        "{text}"
    );
    assert!(started.elapsed().as_millis() >= 800);
}

#[test]
fn the_kitchen_in_c_refuses_in_one_line() {
    for (arguments, part) in [
        (&["make tea"][..], "does not know this instruction"),
        (&["kbls", "--slow"][..], "unknown argument"),
    ] {
        let (success, text) = kitchen_c(arguments);
        assert!(
            !success && text.lines().count() == 1 && text.contains(part),
            "{text}"
        );
    }
}

#[test]
fn the_cpp_loop_allocates_nothing() {
    if Command::new("c++").arg("--version").output().is_err() {
        eprintln!("skipped: c++ is not installed");
        return;
    }
    let text = run(build("c++", "-std=c++17", "cpp/loop.cpp", &[])
        .arg(kitchen())
        .args(["kbls", "25"]));
    assert!(
        text.contains("25 cycles of 80.0 ms") && text.contains("0 allocations in the loop"),
        "{text}"
    );
}

#[test]
fn the_rust_loop_runs() {
    let program = built(&["--example", "controller"]).join("examples/controller");
    let text = run(Command::new(program)
        .arg(project_path("models/kitchen.onnx"))
        .args(["kbls", "25"]));
    assert!(
        text.contains("25 cycles") && text.contains("periods: 25"),
        "{text}"
    );
}

/// Returns the number behind `digest` in a program's output.
fn digest(text: &str) -> &str {
    text.lines()
        .find_map(|line| line.strip_prefix("digest "))
        .unwrap_or_else(|| panic!("no digest in {text}"))
}

#[test]
fn the_biped_stands_and_walks_alike_in_rust_and_in_c() {
    for (name, bundle, image) in lads_tests::biped() {
        fs::write(scratch(&format!("{name}.lads.onnx")), bundle).expect("it can be written");
        fs::write(scratch(&format!("{name}.lads")), image.as_bytes()).expect("it can be written");
    }
    let biped = built(&["--example", "biped"]).join("examples/biped");
    let rust = run(Command::new(biped)
        .args([scratch("stand.lads.onnx"), scratch("walk.lads.onnx")])
        .args(["150", "--fast"]));
    let c = run(build("cc", "-std=c11", "c/biped.c", &[])
        .args([scratch("stand.lads"), scratch("walk.lads")])
        .arg("150"));
    assert_eq!(digest(&rust), digest(&c), "{rust}\n{c}");
    // Every 40th read is lost, and the last action bridges it.
    assert!(c.contains("3 coasted"), "{c}");
    assert!(c.matches("the last action again").count() == 3, "{c}");
}
