//! The header that is checked in is the one that cbindgen makes of the crate, and what its comments name exists.

use std::collections::BTreeSet;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use lads_ffi::Status;

/// To write the header anew: `LADS_WRITE_HEADER=1 cargo test -p lads-ffi --test header`
const WRITE: &str = "LADS_WRITE_HEADER";

fn crate_path(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// `NotSetUp` as `NOT_SET_UP`.
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

/// The statuses in C. They come out of a macro, which cbindgen does not look into.
fn statuses() -> String {
    let sized = "defined(__cplusplus) || __STDC_VERSION__ >= 202311L";
    let mut out = format!(
        "/**\n * What came of a call; 0 is good. The numbers are stable: none ever changes its meaning.\n */\n\
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
    let mut config =
        cbindgen::Config::from_file(root.join("cbindgen.toml")).expect("it is sound");
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

/// What looks like a name of the interface: `LADS_` or `lads_` and more.
fn names(text: &str) -> BTreeSet<String> {
    let part = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let words = text.split(|c| !part(c));
    let ours = words.filter(|word| word.starts_with("LADS_") || word.starts_with("lads_"));
    ours.map(str::to_owned).collect()
}

/// A C text without its comments.
fn code(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once("/*") {
        out.push_str(before);
        rest = after.split_once("*/").map_or("", |(_, rest)| rest);
    }
    out + rest
}

/// Every file below a folder of the crate.
fn files(folder: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![crate_path(folder)];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).expect("the folder is there") {
            let path = entry.expect("it can be listed").path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.push(path);
            }
        }
    }
    found
}

#[test]
fn every_name_in_a_comment_exists() {
    let header = fs::read_to_string(crate_path("include/lads.h")).expect("it is there");
    let declared = names(&code(&header));
    for internal in ["lads_a_panic_is_reachable", "rust_eh_personality"] {
        assert!(!header.contains(internal), "{internal} is in the header");
    }
    assert!(declared.len() > 100, "{declared:?}");
    // Crates, files, and what tests and scripts are told by.
    let others = [
        "lads_core",
        "lads_image",
        "lads_kernels",
        "lads_compiler",
        "lads_ffi",
        "lads_controller.hpp",
        "lads_controller",
        "lads_a_panic_is_reachable",
        "LADS_OPS",
        "LADS_HPP",
        "LADS_H",
        "LADS_CONTROLLER_HPP",
    ];
    let known = |name: &str| {
        // A group of names is written with its common beginning.
        let group = name.ends_with('_') && declared.iter().any(|full| full.starts_with(name));
        declared.contains(name) || others.contains(&name) || group
    };
    let mut texts = files("src");
    texts.extend(files("examples"));
    texts.extend(["include/lads.h", "include/lads.hpp", "archive.sh"].map(crate_path));
    for path in texts {
        let text = fs::read_to_string(&path).expect("it is text");
        let wrong: Vec<_> = names(&text).into_iter().filter(|name| !known(name)).collect();
        assert!(wrong.is_empty(), "{}: {wrong:?}", path.display());
    }
}
