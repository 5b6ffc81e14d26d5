//! Runs the self-test of the small kitchen policy on aarch64 and Cortex-M under qemu, and the kernels' own tests on aarch64, where tools
//! and targets are installed; what is missing is named.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::Command;

use lads_core::{Isa, Policy};
use lads_host::Memory;
use lads_tests::{compiled, project_path};

#[test]
fn other_targets_give_the_same_bits() {
    let image = compiled(&project_path("models/kitchen-small.onnx"));
    let bytes = image.as_bytes();
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
    let output = Command::new(project_path("runtime/ffi/examples/targets/run.sh"))
        .arg(&source)
        .output()
        .expect("the script runs");
    let text = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    println!("{text}");
    assert!(output.status.success(), "{text}{errors}");
    skipped(&text);
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
    assert_eq!(text.matches("test result: ok").count(), 10, "{text}");
}

/// Whether a script lacked its tools; where `LADS_REQUIRE_TOOLS` is set, that is a failure.
fn skipped(text: &str) -> bool {
    let skipped = text.contains("skipped: ");
    let required = std::env::var_os("LADS_REQUIRE_TOOLS").is_some();
    assert!(!(skipped && required), "{text}");
    skipped
}
