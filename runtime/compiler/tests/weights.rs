//! Tests of weights and caches of fewer bits: the image's content, its behaviour, and its gate.

use std::path::Path;

use lads_compiler::{
    Bundle, CacheFormat, CompileError, Image, Options, Storage, WeightFormat, compile_with,
};
use lads_core::{Controller, Instruction, Isa, Policy, SelfTest, SelfTestError, Workspace};
use lads_image::Tables;
use lads_image::op::Op;

fn tiny() -> Bundle {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/tiny.onnx");
    Bundle::open(Path::new(path)).unwrap()
}

fn options(weights: WeightFormat, tolerance: f32) -> Options {
    Options {
        storage: Some(Storage::of_weights(weights)),
        tolerance: Some(tolerance),
        ..Options::default()
    }
}

/// Runs a policy in memory of its own.
fn at_work<T>(policy: &Policy, isa: Isa, work: impl FnOnce(&mut Controller) -> T) -> T {
    let (mut arena, mut state) = (vec![0.0; policy.arena_len()], vec![0.0; policy.state_len()]);
    let workspace = Workspace::new(policy, &mut arena, &mut state).unwrap();
    work(&mut Controller::with_isa(*policy, workspace, isa))
}

#[expect(
    clippy::redundant_closure_for_method_calls,
    reason = "the method itself is for one lifetime only"
)]
fn self_test(policy: &Policy) -> Result<SelfTest, SelfTestError> {
    at_work(policy, Isa::detect(), |controller| controller.self_test())
}

/// Replays the golden episode on a chosen instruction set and returns every action and the margin
/// of every decision.
fn replayed(image: &Image, isa: Isa) -> (Vec<f32>, Vec<f32>) {
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    let golden = policy.golden().unwrap();
    at_work(&policy, isa, |controller| {
        let instruction = golden.instruction().map(Instruction::Id).unwrap();
        controller.set_instruction(instruction).unwrap();
        let mut action = vec![0.0; policy.contract().action_len()];
        let (mut actions, mut margins) = (vec![], vec![]);
        for step in golden.steps() {
            let report = controller.step(step.observation(), &mut action).unwrap();
            actions.extend_from_slice(&action);
            margins.push(report.selected.unwrap().margin);
        }
        (actions, margins)
    })
}

fn actions(image: &Image, isa: Isa) -> Vec<f32> {
    replayed(image, isa).0
}

/// Returns the storage formats of the dense layers of an entry.
fn layers(image: &Image, name: &str) -> Vec<WeightFormat> {
    let tables = Tables::new(image.as_bytes()).unwrap();
    let mut entries = (0..tables.entries_len()).map(|i| tables.entry(i).unwrap());
    let entry = entries.find(|entry| tables.text(entry.name) == name);
    let ops = tables.ops(&entry.expect("an entry of this name"));
    let format = |words| match Op::decode(words).expect("an op") {
        Op::Linear(op) => Some(op.format),
        _ => None,
    };
    ops.iter().filter_map(format).collect()
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
    let exact = compile_with(&bundle, &Options::exact()).unwrap();
    let reference = actions(&exact, Isa::detect());
    let mut bytes = exact.as_bytes().len();
    // From the largest difference that this bundle shows, doubled.
    for (format, tolerance) in [
        (WeightFormat::Int16, 3e-4),
        (WeightFormat::F16, 4e-4),
        (WeightFormat::Bf16, 4e-3),
        (WeightFormat::Int8, 7e-3),
    ] {
        let image = compile_with(&bundle, &options(format, tolerance)).unwrap();
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        assert_eq!(policy.golden().unwrap().tolerance(), tolerance);
        let passed = self_test(&policy).unwrap();
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
        let layers = layers(&image, "low_level/act");
        assert_eq!(layers[1..], vec![format; layers.len() - 1]);
        // The first layer weighs sensors of different units, for which one step is too coarse.
        let first = if format.is_scaled() {
            WeightFormat::F32
        } else {
            format
        };
        assert_eq!(layers[0], first);
    }
}

#[test]
fn what_changes_the_policy_is_refused_unless_forced() {
    let bundle = tiny();
    let default = Options {
        storage: Some(Storage::of_weights(WeightFormat::Bf16)),
        ..Options::default()
    };
    let refused = compile_with(&bundle, &default).unwrap_err();
    assert!(
        matches!(
            refused,
            CompileError::Gate {
                error: SelfTestError::Action { .. },
                tolerance,
                ..
            } if tolerance == bundle.golden().tolerance
        ),
        "{refused}"
    );
    let text = refused.to_string();
    assert!(text.starts_with("with bf16 weights the golden") && text.lines().count() == 1);
    let forced = Options {
        force: true,
        ..default
    };
    let image = compile_with(&bundle, &forced).unwrap();
    let policy = Policy::new_checked(image.as_bytes()).unwrap();
    assert!(self_test(&policy).is_err());
}

/// Alters a weight after the recording: more bits would not help.
#[test]
fn what_does_not_replay_at_all_is_not_told_as_too_few_bits() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/tiny.onnx");
    let mut bytes = std::fs::read(path).unwrap();
    // A tensor's name, and the head of its 12 bytes of values.
    let head = b"low_level.layer.6.bias\x4a\x0c";
    let at = bytes.windows(head.len()).position(|part| part == head);
    let values = at.unwrap() + head.len();
    bytes[values..values + 4].copy_from_slice(&0.5_f32.to_le_bytes());
    let bundle = Bundle::from_bytes(&bytes).unwrap();
    for (format, tolerance) in [(WeightFormat::Bf16, 1e-4), (WeightFormat::F16, 1e-9)] {
        let refused = compile_with(&bundle, &options(format, tolerance)).unwrap_err();
        assert!(
            matches!(refused, CompileError::Unlike { .. }),
            "{format:?}: {refused}"
        );
    }
    // A tolerance that no format meets is not the bundle's fault.
    let refused = compile_with(&tiny(), &options(WeightFormat::F16, 1e-9)).unwrap_err();
    assert!(matches!(refused, CompileError::Gate { .. }), "{refused}");
}

/// Rounds weights that no action depends on, the cache and all but the low level's, which may only
/// change the chosen plan.
#[test]
fn what_only_chooses_plans_may_take_fewer_bits_and_no_tolerance() {
    let bundle = tiny();
    let exact = compile_with(&bundle, &Options::exact()).unwrap();
    let (reference, margins) = replayed(&exact, Isa::detect());
    let halves = Storage::default().with_cache(CacheFormat::F16);
    let integers = Storage::default().with_cache(CacheFormat::Int8);
    let mixed = Storage::of_weights(WeightFormat::F16)
        .with_part("low_level/act", WeightFormat::F32)
        .with_cache(CacheFormat::F16);
    let compiled = |storage: &Storage| {
        let options = Options {
            storage: Some(storage.clone()),
            ..Options::default()
        };
        compile_with(&bundle, &options).unwrap()
    };
    let state = |image: &Image| {
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        policy.state_len()
    };
    for (storage, text) in [
        (&halves, "f32 weights and an f16 cache"),
        (&integers, "f32 weights and an int8 cache"),
        (&mixed, "f16 weights (low_level/act f32) and an f16 cache"),
    ] {
        assert_eq!(
            (storage.to_string().as_str(), storage.is_exact()),
            (text, false)
        );
        let image = compiled(storage);
        let own = replayed(&image, Isa::portable());
        assert!(Isa::all().all(|isa| replayed(&image, isa) == own), "{text}");
        assert_eq!(
            own.0, reference,
            "{text}: the same plans give the same bits"
        );
        assert_ne!(own.1, margins, "{text}: it is the exact policy");
        let [half, full] = [&image, &exact].map(state);
        assert!(half < full * 3 / 5, "{text}: {half} of {full} words");
    }
    let image = compiled(&mixed);
    let of = |program, format| {
        let layers = layers(&image, program);
        !layers.is_empty() && layers.iter().all(|&found| found == format)
    };
    assert!(of("low_level/act", WeightFormat::F32));
    assert!(of("high_level/step", WeightFormat::F16));
    assert!(image.as_bytes().len() < exact.as_bytes().len());
}
