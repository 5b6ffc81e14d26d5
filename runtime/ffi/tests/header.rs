//! The header that is checked in is the one that cbindgen makes of the crate.

use std::path::Path;

/// To write the header anew: `LADS_WRITE_HEADER=1 cargo test -p lads-ffi --test header`
const WRITE: &str = "LADS_WRITE_HEADER";

#[test]
fn the_header_is_not_stale() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config::from_file(root.join("cbindgen.toml")).expect("it is sound");
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
        std::fs::create_dir_all(root.join("include")).expect("the folder can be made");
        std::fs::write(&path, &made).expect("the header can be written");
    }
    let kept = std::fs::read(&path).unwrap_or_default();
    assert!(
        kept == made,
        "include/lads.h is stale; {WRITE}=1 cargo test -p lads-ffi --test header"
    );
}
