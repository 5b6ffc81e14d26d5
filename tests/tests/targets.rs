//! Runs the self-test of the small kitchen policy on aarch64, armv7 and Cortex-M under qemu, the biped's control loop on those with Linux, and
//! the kernels' own tests on aarch64, where tools and targets are installed; what is missing is named.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::Command;

use lads_core::{Isa, Policy};
use lads_host::Memory;
use lads_tests::{biped, compiled, project_path};

/// What the script says of the small policy's image and of the biped's.
fn run_on_targets(bytes: &[u8]) -> String {
    // As `lads compile --emit-c` writes it.
    let mut text = format!(
        "extern const unsigned char policy_image[{len}];\n__attribute__((aligned(64)))\nconst unsigned char policy_image[{len}] = {{\n",
        len = bytes.len()
    );
    for byte in bytes {
        write!(text, "{byte},").expect("a string takes everything");
    }
    text.push_str("};\n");
    let source = Path::new(env!("CARGO_TARGET_TMPDIR")).join("policy.c");
    fs::write(&source, text).expect("it can be written");
    let walking = biped().map(|(name, _, image)| {
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}.on-targets.lads"));
        fs::write(&path, image.as_bytes()).expect("it can be written");
        path
    });
    let output = Command::new(project_path("runtime/ffi/examples/targets/run.sh"))
        .arg(&source)
        .args(walking)
        .env("LADS_OPS", "lads,integer-weights,half-cache")
        .output()
        .expect("the script runs");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    println!("{text}");
    assert!(output.status.success(), "{text}{errors}");
    skipped(&text);
    text
}

#[test]
fn other_targets_give_the_same_bits_and_take_what_the_page_says() {
    let image = compiled(&project_path("models/kitchen-small.onnx"));
    let bytes = image.as_bytes();
    let text = run_on_targets(bytes);
    compare_with_the_page(&text, bytes.len());
    // Rust's own kernels on this machine, the portable ones too, agree with the library that the script has built.
    let policy = Policy::new_checked(bytes).expect("the image is sound");
    let mut memory = Memory::of(&policy).expect("there is memory");
    for isa in [Isa::portable(), Isa::detect()] {
        let mut controller = memory
            .controller_with(&policy, isa)
            .expect("it was made for it");
        let passed = controller.self_test().expect("the policy is sound");
        let said = format!("self-test passed, actions {:08x}", passed.digest);
        assert!(text.contains(&said), "{said}: {text}");
    }
}

/// The numbers in a text, commas in them left out.
fn numbers(text: &str) -> Vec<f64> {
    let plain = text.replace(',', "");
    plain
        .split(|c: char| !c.is_ascii_digit())
        .filter_map(|digits| digits.parse().ok())
        .collect()
}

/// What docs/firmware.md says of the linked program, beside what it takes: within a tenth, by which compilers differ. The image's size is exact.
fn compare_with_the_page(said: &str, image: usize) {
    let page = fs::read_to_string(project_path("docs/firmware.md")).expect("the page is there");
    let row = |start: &str| {
        let line = page
            .lines()
            .find(|line| line.starts_with(&format!("| {start}")));
        let line = line.unwrap_or_else(|| panic!("docs/firmware.md has no row `{start}`"));
        let amount = line.rsplit('|').nth(1).expect("two columns");
        numbers(amount)[0]
    };
    assert_eq!(row("of which the policy's image"), image as f64);
    let after = |line: &str, word: &str| {
        let (_, rest) = line.split_once(word).expect("the script says it");
        numbers(rest)[0]
    };
    let Some(sizes) = said.lines().find(|line| line.starts_with("Cortex-M: ")) else {
        println!("skipped: docs/firmware.md was compared with no program for Cortex-M");
        return;
    };
    let mut measured = vec![
        ("flash, all in all", after(sizes, "flash ")),
        ("RAM", after(sizes, "RAM ")),
    ];
    let boards = said.lines().filter(|line| line.starts_with("mps2-"));
    for board in boards {
        measured.push(("stack", after(board, "stack ")));
        measured.push((
            "instructions of a control step, mean",
            after(board, "step "),
        ));
        measured.push((
            "instructions of a control step, at most",
            after(board, "mean"),
        ));
    }
    assert_eq!(measured.len(), 8, "two boards: {said}");
    for (what, amount) in measured {
        let written = row(what);
        assert!(
            (amount - written).abs() <= 0.1 * written,
            "docs/firmware.md says {written} for {what}, it is {amount}"
        );
    }
}

#[test]
fn kernels_equal_their_twins_on_aarch64() {
    let output = Command::new(project_path("runtime/kernels/targets.sh"))
        .output()
        .expect("the script runs");
    let text = String::from_utf8_lossy(&output.stdout);
    println!("{text}");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}{errors}");
    if skipped(&text) {
        return;
    }
    assert_eq!(text.matches("test result: ok").count(), 16, "{text}");
}

/// Whether a script lacked its tools; where `LADS_REQUIRE_TOOLS` is set, that is a failure.
fn skipped(text: &str) -> bool {
    let skipped = text.contains("skipped: ");
    let required = std::env::var_os("LADS_REQUIRE_TOOLS").is_some();
    assert!(!(skipped && required), "{text}");
    skipped
}
