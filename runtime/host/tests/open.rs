//! Tests policies opened in either form: their content, their behaviour, and refusals.
#![cfg(feature = "compile")]

use std::fs;
use std::path::{Path, PathBuf};

use lads_core::Instruction;
use lads_host::schedule::{Steps, period, places};
use lads_host::{Problem, from_bytes, open};
use lads_image::Tables;
use lads_image::records::Event;

fn tiny() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../compiler/tests/data/tiny.onnx")
}

#[test]
fn both_forms_are_the_same_policy() {
    let bundle = open(&tiny()).expect("the bundle is sound");
    assert!(bundle.is_bundle());
    assert_eq!(
        bundle.bundle().unwrap().contract().environment.id,
        "tiny-bench"
    );
    // The name does not matter.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("image.onnx");
    fs::write(&path, bundle.image()).unwrap();
    let image = open(&path).expect("the image is sound");
    assert!(!image.is_bundle() && image.bundle().is_none());
    assert_eq!(image.image(), bundle.image());
    let tested = [bundle, image].map(|opened| {
        let mut loaded = opened.load().expect("there is memory");
        loaded
            .controller()
            .self_test()
            .expect("it does as recorded")
    });
    assert_eq!(tested[0], tested[1]);
}

#[test]
fn memory_serves_one_controller_after_the_other() {
    let mut loaded = open(&tiny()).unwrap().load().unwrap();
    let number = loaded.opened().instruction("d").unwrap();
    let act = |controller: &mut lads_core::Controller| {
        controller.set_instruction(Instruction::Id(number)).unwrap();
        let mut action = [0.0; 3];
        controller.step(&[0.0; 5], &mut action).unwrap();
        action
    };
    let first = act(&mut loaded.controller());
    assert_eq!(act(&mut loaded.controller()), first);
}

#[test]
fn instructions_are_found_by_one_rule_in_both_forms() {
    let bundle = open(&tiny()).unwrap();
    let image = from_bytes(bundle.image()).unwrap();
    for opened in [&bundle, &image] {
        assert_eq!(
            opened.instruction(" OPEN the\tdrawer "),
            opened.instruction("d")
        );
        let unknown = opened.instruction("open the drower").unwrap_err();
        assert_eq!(unknown.nearest[0].0, "d");
        let said = unknown.to_string();
        assert!(said.contains("'open the drawer' (d)"), "{said}");
    }
}

#[test]
fn what_is_no_policy_is_refused_by_what_is_wrong() {
    let missing = open(Path::new("/no/such.onnx")).unwrap_err();
    assert!(matches!(missing.problem, Problem::Read(_)));
    assert!(missing.to_string().starts_with("/no/such.onnx: "));
    let image = open(&tiny()).unwrap();
    let mut bytes = image.image().to_vec();
    let cut = from_bytes(&bytes[..bytes.len() / 2]).unwrap_err();
    assert!(matches!(cut.problem, Problem::Image(_)), "{cut}");
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    let changed = from_bytes(&bytes).unwrap_err();
    assert!(matches!(changed.problem, Problem::Changed), "{changed}");
    let text = from_bytes(b"no model at all").unwrap_err();
    assert!(matches!(text.problem, Problem::Bundle(_)), "{text}");
}

#[test]
fn the_schedule_is_told_by_steps() {
    let opened = open(&tiny()).unwrap();
    let policy = opened.policy();
    let places = places(&policy);
    let of_steps = places.iter().filter(|place| place.event == Event::Step);
    let steps: Vec<_> = of_steps.map(|place| place.steps).collect();
    assert_eq!(steps, [Steps::First, Steps::Other, Steps::Every(4)]);
    assert_eq!(period(&Tables::new(opened.image()).unwrap()), 4);
    let work = |place: &lads_host::schedule::Place| place.cost().multiply_adds;
    // What an image states counts one for each operation, too.
    let worst = places.iter().map(work).max().unwrap();
    let stated = policy.contract().worst_work();
    assert!(
        (worst..worst + 1000).contains(&stated),
        "{worst} of {stated}"
    );
}
