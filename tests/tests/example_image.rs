//! The image in the example of lads-core is what the compiler makes of the small bundle today.
//!
//! After a change of the format or of the compiler: `LADS_WRITE_IMAGE=1 cargo test -p lads-tests --test example_image` writes it anew.

use std::fs;

use lads_tests::{compiled, project_path};

#[test]
fn the_example_has_the_image_of_today() {
    let image = compiled(&project_path("runtime/compiler/tests/data/tiny.onnx"));
    let path = project_path("runtime/core/tests/data/tiny.lads");
    if std::env::var_os("LADS_WRITE_IMAGE").is_some() {
        fs::write(&path, image.as_bytes()).expect("it can be written");
    }
    let there = fs::read(&path).expect("it is there");
    assert!(
        there == image.as_bytes(),
        "{} is another image; LADS_WRITE_IMAGE=1 writes it anew",
        path.display()
    );
}
