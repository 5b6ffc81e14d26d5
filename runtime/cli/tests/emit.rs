//! Tests that images as source compile to the image, byte for byte, at an address where an image
//! may start.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use lads_compiler::{Bundle, compile};

fn tiny() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../compiler/tests/data/tiny.onnx")
}

fn image() -> Vec<u8> {
    let bundle = Bundle::open(&tiny()).expect("the bundle is sound");
    compile(&bundle).expect("it compiles").as_bytes().to_vec()
}

/// Runs `lads compile` on the small bundle.
fn emit(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lads"))
        .arg("compile")
        .arg(tiny())
        .args(arguments)
        .output()
        .expect("it runs")
}

/// Returns the bytes that a compiler's program prints.
fn printed(compiler: &mut Command, program: &Path) -> Vec<u8> {
    let output = compiler.output().expect("the compiler runs");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    let output = Command::new(program).output().expect("the program runs");
    assert!(output.status.success(), "the array is not aligned");
    output.stdout
}

#[test]
fn c_and_cpp_compilers_make_the_image_of_it() {
    let folder = tempfile::tempdir().expect("there is room");
    let source = folder.path().join("My-tiny.c");
    let output = emit(&["--emit-c", &source.to_string_lossy()]);
    assert!(output.status.success());
    let main = folder.path().join("main.c");
    let len = image().len();
    let text = format!(
        "#include <stdint.h>\n#include <stdio.h>\n\
         #ifdef __cplusplus\nextern \"C\" {{\n#endif\n\
         extern const unsigned char my_tiny_image[{len}];\n\
         #ifdef __cplusplus\n}}\n#endif\n\
         int main(void) {{\n\
         if ((uintptr_t)my_tiny_image % 64 != 0) {{ return 1; }}\n\
         return fwrite(my_tiny_image, 1, {len}, stdout) != {len};\n}}\n"
    );
    fs::write(&main, text).expect("it can be written");
    for (compiler, language, standard) in [
        ("cc", "c", "-std=c99"),
        ("cc", "c", "-std=c11"),
        ("c++", "c++", "-std=c++17"),
    ] {
        if Command::new(compiler).arg("--version").output().is_err() {
            eprintln!("skipped: {compiler} is not installed");
            continue;
        }
        let program = folder.path().join("program");
        let mut command = Command::new(compiler);
        command
            .args([
                "-Wall",
                "-Wextra",
                "-Werror",
                "-pedantic",
                standard,
                "-x",
                language,
            ])
            .args([&source, &main])
            .arg("-o")
            .arg(&program);
        assert!(
            printed(&mut command, &program) == image(),
            "{compiler} {standard}"
        );
    }
}

#[test]
fn rustc_makes_the_image_of_it() {
    let folder = tempfile::tempdir().expect("there is room");
    let output = folder.path().join("tiny.lads");
    let source = folder.path().join("tiny.rs");
    let made = emit(&[
        "-o",
        &output.to_string_lossy(),
        "--emit-rust",
        &source.to_string_lossy(),
    ]);
    assert!(made.status.success());
    assert!(fs::read(&output).expect("it was written") == image());
    let main = folder.path().join("main.rs");
    let text = "mod tiny;\nuse std::io::Write;\nfn main() {\n\
        assert!(std::ptr::from_ref(&tiny::TINY_IMAGE).addr() % 64 == 0);\n\
        std::io::stdout().write_all(&tiny::TINY_IMAGE.0).unwrap();\n}\n";
    fs::write(&main, text).expect("it can be written");
    let program = folder.path().join("program");
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let mut command = Command::new(rustc);
    command
        .args(["--edition", "2024", "-o"])
        .arg(&program)
        .arg(&main);
    assert!(printed(&mut command, &program) == image());
}

#[test]
fn what_cannot_be_emitted_is_refused_before_anything_is_written() {
    let folder = tempfile::tempdir().expect("there is room");
    let image = folder.path().join("tiny.lads");
    let image = image.to_string_lossy();
    let source = folder.path().join("1.c");
    let refused = |arguments: &[&str], part: &str| {
        let output = emit(arguments);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{errors}");
        assert!(
            errors.lines().count() == 1 && errors.contains(part),
            "{errors}"
        );
    };
    refused(
        &["-o", &image, "--emit-c", &source.to_string_lossy()],
        "start with a letter",
    );
    refused(&[], "--output");
    assert_eq!(fs::read_dir(folder.path()).expect("it is there").count(), 0);
}
