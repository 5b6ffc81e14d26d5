//! Tests that the checked-in header is the one that cbindgen makes of the crate.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use lads_ffi::Status;

/// Environment variable to write the header anew:
/// `LADS_WRITE_HEADER=1 cargo test -p lads-ffi --test header`
const WRITE: &str = "LADS_WRITE_HEADER";

fn crate_path(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// Converts `NotSetUp` to `NOT_SET_UP`.
fn screaming(name: &str) -> String {
    let mut out = String::new();
    for (i, letter) in name.chars().enumerate() {
        if i > 0 && letter.is_uppercase() {
            out.push('_');
        }
        out.push(letter.to_ascii_uppercase());
    }
    out
}

/// Formats the statuses in C. They come out of a macro, which cbindgen does not expand.
fn statuses() -> String {
    let sized = "defined(__cplusplus) || __STDC_VERSION__ >= 202311L";
    let mut out = format!(
        "/**\n * Result of a call; 0 means success. The numbers are stable: no number ever changes its meaning.\n */\n\
         enum lads_status\n#if {sized}\n  : int32_t\n#endif // {sized}\n {{\n"
    );
    for &(status, text) in Status::ALL {
        let text = text.to_str().expect("the text is ASCII");
        let (first, rest) = text.split_at(1);
        let (name, number) = (screaming(&format!("{status:?}")), status as i32);
        let first = first.to_uppercase();
        write!(
            out,
            "    /**\n     * {first}{rest}.\n     */\n    LADS_STATUS_{name} = {number},\n"
        )
        .expect("a string takes everything");
    }
    out + "};\n#ifndef __cplusplus\n#if __STDC_VERSION__ >= 202311L\ntypedef enum lads_status lads_status;\n#else\n\
           typedef int32_t lads_status;\n#endif // __STDC_VERSION__ >= 202311L\n#endif // __cplusplus\n"
}

#[test]
fn the_header_is_not_stale() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut config = cbindgen::Config::from_file(root.join("cbindgen.toml")).expect("it is sound");
    config.after_includes = Some(statuses());
    let builder = cbindgen::Builder::new()
        .with_crate(root)
        .with_config(config);
    let mut made = Vec::new();
    builder
        .generate()
        .expect("cbindgen reads the crate")
        .write(&mut made);
    let path = root.join("include/lads.h");
    if std::env::var_os(WRITE).is_some() {
        fs::create_dir_all(root.join("include")).expect("the folder can be made");
        fs::write(&path, &made).expect("the header can be written");
    }
    let kept = fs::read(&path).unwrap_or_default();
    assert!(
        kept == made,
        "include/lads.h is stale; {WRITE}=1 cargo test -p lads-ffi --test header"
    );
}

/// Internal items of the archive are not declared in the header.
#[test]
fn nothing_internal_is_declared() {
    let header = fs::read_to_string(crate_path("include/lads.h")).expect("it is there");
    assert!(header.contains("lads_step_channels("));
    for internal in ["lads_a_panic_is_reachable", "rust_eh_personality"] {
        assert!(!header.contains(internal), "{internal} is in the header");
    }
}
