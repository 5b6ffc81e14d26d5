//! The self-test of a small policy on aarch64 and Cortex-M under qemu, where tools and targets are there; what is missing is named.

use std::fs;
use std::path::Path;
use std::process::Command;

use lads_core::Policy;
use lads_tests::{compiled, project_path};

#[test]
fn other_targets_give_the_same_bits() {
    let image = compiled(&project_path("runtime/compiler/tests/data/tiny.onnx"));
    let bytes = image.as_bytes();
    let policy = Policy::new_checked(bytes).expect("the image is sound");
    assert!(
        bytes.len() < 512 * 1024,
        "the image does not fit a microcontroller"
    );
    let workspace = 4 * (policy.arena_len() + policy.state_len());
    assert!(
        workspace < 60 * 1024,
        "the workspace does not fit a microcontroller"
    );
    let values: Vec<_> = bytes.iter().map(u8::to_string).collect();
    let source = Path::new(env!("CARGO_TARGET_TMPDIR")).join("policy.c");
    let text = format!(
        "__attribute__((aligned(64))) const unsigned char policy_image[{}] = {{{}}};\n",
        bytes.len(),
        values.join(",")
    );
    fs::write(&source, text).expect("it can be written");
    let output = Command::new(project_path("runtime/ffi/examples/targets/run.sh"))
        .arg(&source)
        .arg(bytes.len().to_string())
        .output()
        .expect("the script runs");
    let text = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    println!("{text}");
    assert!(output.status.success(), "{text}{errors}");
    assert!(text.contains("self-test passed"), "{text}");
}
