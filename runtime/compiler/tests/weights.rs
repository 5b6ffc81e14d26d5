//! Weights of fewer bits: what an image with them holds, does, and has to pass.

use std::path::Path;

use lads_compiler::{Bundle, CompileError, Image, Memory, Options, WeightFormat, compile_with};
use lads_core::image::ProgramKind;
use lads_core::op::Op;
use lads_core::{Controller, Isa, Policy, SelfTestError, Workspace};

fn tiny() -> Bundle {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/tiny.onnx");
    Bundle::open(Path::new(path)).unwrap()
}

fn options(weights: WeightFormat, tolerance: f32) -> Options {
    Options {
        weights,
        tolerance: Some(tolerance),
        force: false,
    }
}

/// Every action of the golden episode, on chosen instructions.
fn actions(image: &Image, isa: Isa) -> Vec<f32> {
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    let golden = policy.golden().unwrap();
    let mut memory = Memory::of(&policy).expect("there is memory");
    let workspace = Workspace::new(&policy, &mut memory.arena, &mut memory.state).unwrap();
    let mut controller = Controller::with_isa(policy, workspace, isa);
    let instruction = lads_core::Instruction::Id(golden.instruction());
    controller.set_instruction(instruction).unwrap();
    let mut action = vec![0.0; policy.contract().action_len()];
    let steps = golden.steps().flat_map(|(observation, _, _)| {
        controller.step(observation, &mut action).unwrap();
        action.clone()
    });
    steps.collect()
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max)
}

#[test]
fn fewer_bits_are_admitted_inside_a_tolerance() {
    let bundle = tiny();
    let exact = compile_with(&bundle, Options::default()).unwrap();
    let reference = actions(&exact, Isa::detect());
    let mut bytes = exact.as_bytes().len();
    // From the largest difference that this bundle shows, doubled.
    for (format, tolerance) in [
        (WeightFormat::F16, 4e-4),
        (WeightFormat::Bf16, 4e-3),
        (WeightFormat::Int8, 7e-3),
    ] {
        let image = compile_with(&bundle, options(format, tolerance)).unwrap();
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        assert_eq!(policy.golden().unwrap().tolerance(), tolerance);
        let mut memory = Memory::of(&policy).expect("there is memory");
        let passed = memory.controller(&policy).unwrap().self_test().unwrap();
        assert!(
            passed.largest_error > tolerance / 20.0,
            "{passed:?} says nothing"
        );
        // Bit for bit the same on all instruction sets, and not those of 32-bit weights.
        let own = actions(&image, Isa::portable());
        assert!(
            Isa::all().all(|isa| actions(&image, isa) == own),
            "{format:?}"
        );
        let difference = largest_difference(&own, &reference);
        assert!(
            difference > 0.0 && difference < tolerance,
            "{format:?}: {difference}"
        );
        if format != WeightFormat::Bf16 {
            assert!(image.as_bytes().len() < bytes, "{format:?}");
            bytes = image.as_bytes().len();
        }
        let mut layers = policy
            .program(ProgramKind::Act)
            .ops()
            .filter_map(|op| match op {
                Op::Linear(op) => Some(op.format),
                _ => None,
            });
        assert!(layers.next().is_some() && layers.all(|found| found == format));
    }
}

#[test]
fn what_changes_the_policy_is_refused_unless_forced() {
    let bundle = tiny();
    let default = Options {
        weights: WeightFormat::Bf16,
        ..Options::default()
    };
    let refused = compile_with(&bundle, default).unwrap_err();
    assert!(
        matches!(
            refused,
            CompileError::Gate {
                format: "bf16",
                error: SelfTestError::Action { .. },
                tolerance
            } if tolerance == bundle.golden().tolerance
        ),
        "{refused}"
    );
    assert_eq!(refused.to_string().lines().count(), 1);
    let forced = Options {
        force: true,
        ..default
    };
    let image = compile_with(&bundle, forced).unwrap();
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    let mut memory = Memory::of(&policy).expect("there is memory");
    assert!(memory.controller(&policy).unwrap().self_test().is_err());
}
