//! Tests that the work of a control step does not depend on what is observed: under `callgrind`, the same number of instructions for random
//! observations at the same place in the schedule. Skipped where `valgrind` is missing.
//!
//! The kitchen's policy: an ordinary step and one that decides or draws its plan, with 32-bit weights and with integers. Random policies
//! of every family, where the parity tests have made them: every step from the start of a context to the second selection and beyond, and
//! over the restart of a context that is full.
//!
//! The tests run their own binary once more under `callgrind`, which counts what [`one_control_step`] executes and writes one file
//! for each call. Valgrind knows no AVX-512, so what is counted are the AVX2 kernels, or on older processors the portable ones.
#![cfg(target_os = "linux")]

use std::collections::{BTreeMap, BTreeSet};
use std::hint::black_box;
use std::path::Path;
use std::process::Command;

use lads_compiler::{Bundle, Options, Storage, WeightFormat, compile_with};
use lads_core::{
    ChannelId, Contract, Controller, DType, Data, Decision, Instruction, Policy, StepReport,
};
use lads_host::{Aligned, Memory};
use lads_tests::episode::{folder, kinds};
use lads_tests::project_path;

/// Environment variable that names the image to the program under `callgrind`.
const IMAGE: &str = "LADS_IMAGE_UNDER_CALLGRIND";

/// Environment variable that names the number of the case to the program under `callgrind`.
const CHILD: &str = "LADS_STEPS_UNDER_CALLGRIND";

/// Rule of the cases in which plans are drawn.
const DRAWN: Decision = Decision::Sample {
    temperature: 1.0,
    seed: 5,
};

/// Cases of an episode that decides in every tenth step: format, `None` as the bundle is tuned, rule, and the number of steps before the one
/// that is counted.
const CASES: [(Option<WeightFormat>, Decision, usize); 7] = [
    (None, Decision::Argmax, 1),
    (None, Decision::Argmax, 10),
    (Some(WeightFormat::F32), Decision::Argmax, 1),
    (Some(WeightFormat::F32), Decision::Argmax, 10),
    (Some(WeightFormat::F32), DRAWN, 10),
    (Some(WeightFormat::Int16), Decision::Argmax, 1),
    (Some(WeightFormat::Int16), Decision::Argmax, 10),
];

/// Number of observations whose steps are counted.
const OBSERVATIONS: usize = 100;

/// Number of episodes of a random policy.
const EPISODES: usize = 4;

/// Returns the number of steps of an episode: two selections, as no random policy selects more seldom than in every tenth step, and all
/// of a context with the first steps of the next.
fn episode_len(policy: &Policy<'_>) -> usize {
    let context = policy.contract().context_steps();
    context.map_or(0, |steps| steps + 2).max(22)
}

/// Function whose instructions are counted, with a name that the tool can be told.
#[inline(never)]
#[unsafe(no_mangle)]
#[expect(
    clippy::no_mangle_with_rust_abi,
    reason = "no other program calls it; the tool looks for the name"
)]
fn one_control_step(
    controller: &mut Controller<'_, '_>,
    inputs: &[(ChannelId, Data<'_>)],
    action: &mut [f32],
) -> StepReport {
    controller.step_with(black_box(inputs), action).unwrap()
}

/// Generator of numbers from 0 to 1, always the same ones.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 40) as f32 / (1_u64 << 24) as f32
    }
}

/// Random values of every observation channel, and the steps that see them.
struct Observed<'p> {
    contract: Contract<'p>,
    floats: Vec<(ChannelId, Vec<f32>)>,
    bytes: Vec<(ChannelId, Vec<u8>)>,
    integers: Vec<(ChannelId, Vec<i32>)>,
}

impl<'p> Observed<'p> {
    fn new(policy: &Policy<'p>) -> Self {
        Self {
            contract: *policy.contract(),
            floats: vec![],
            bytes: vec![],
            integers: vec![],
        }
    }

    /// Draws values from all over the contract's limits.
    fn draw(&mut self, random: &mut Random) {
        self.floats.clear();
        self.bytes.clear();
        self.integers.clear();
        for channel in self.contract.observations() {
            // Limits may be as wide as all numbers; a machine's are not.
            let values = channel.limits().map(|limits| {
                let (min, max) = (limits.min.max(-10.0), limits.max.min(10.0));
                min + (max - min) * random.next()
            });
            match channel.dtype() {
                DType::F32 => self.floats.push((channel.id(), values.collect())),
                DType::U8 => {
                    let bytes = values.map(|x| x as u8).collect();
                    self.bytes.push((channel.id(), bytes));
                }
                DType::I32 => {
                    let integers = values.map(|x| x as i32).collect();
                    self.integers.push((channel.id(), integers));
                }
            }
        }
    }

    fn inputs(&self) -> Vec<(ChannelId, Data<'_>)> {
        let floats = self.floats.iter();
        let floats = floats.map(|(id, values)| (*id, Data::F32(values)));
        let bytes = self.bytes.iter();
        let bytes = bytes.map(|(id, values)| (*id, Data::U8(values)));
        let integers = self.integers.iter();
        let integers = integers.map(|(id, values)| (*id, Data::I32(values)));
        floats.chain(bytes).chain(integers).collect()
    }
}

/// Opens the image that the parent process wrote.
fn with_image(work: impl FnOnce(&Policy<'_>)) {
    let path = std::env::var_os(IMAGE).expect("the parent names it");
    let image = Aligned::new(&std::fs::read(path).unwrap());
    work(&Policy::new_checked(image.as_bytes()).unwrap());
}

/// Runs one step of an episode of the kitchen's policy, over and over.
fn steps((_, decision, before): (Option<WeightFormat>, Decision, usize), policy: &Policy<'_>) {
    let mut memory = Memory::of(policy).expect("there is memory");
    let mut controller = memory.controller(policy).unwrap();
    controller.set_decision(decision);
    let mut action = vec![0.0; policy.contract().action_len()];
    let first = policy.golden().unwrap().step(0).unwrap();
    controller.set_instruction(Instruction::Id(0)).unwrap();
    let (mut random, mut observed) = (Random(1), Observed::new(policy));
    for _ in 0..OBSERVATIONS {
        controller.reset();
        for _ in 0..before {
            controller.step(first.observation(), &mut action).unwrap();
        }
        observed.draw(&mut random);
        let report = one_control_step(&mut controller, &observed.inputs(), &mut action);
        let selected = report.selected.expect("it selects plans");
        assert_eq!(selected.fresh, before % 10 == 0);
    }
}

/// Runs the first steps of a random policy's contexts, each with observations of its own.
fn episodes(policy: &Policy<'_>) {
    let mut memory = Memory::of(policy).expect("there is memory");
    let mut controller = memory.controller(policy).unwrap();
    let mut action = vec![0.0; policy.contract().action_len()];
    if policy.contract().instruction_channel().is_some() {
        controller.set_instruction(Instruction::Id(0)).unwrap();
    }
    let (mut random, mut observed) = (Random(1), Observed::new(policy));
    for _ in 0..EPISODES {
        controller.reset();
        for step in 0..episode_len(policy) {
            observed.draw(&mut random);
            let report = one_control_step(&mut controller, &observed.inputs(), &mut action);
            let context = policy.contract().context_steps();
            let timestep = context.map_or(step, |steps| step % steps);
            assert_eq!(report.timestep as usize, timestep);
        }
    }
}

#[test]
fn a_step_executes_the_same_number_of_instructions_whatever_it_observes() {
    const NAME: &str = "a_step_executes_the_same_number_of_instructions_whatever_it_observes";
    if let Some(case) = std::env::var_os(CHILD) {
        let case: usize = case.to_str().and_then(|case| case.parse().ok()).unwrap();
        return with_image(|policy| steps(CASES[case], policy));
    }
    let bundle = Bundle::open(&project_path("models/kitchen.onnx")).unwrap();
    for (number, case) in CASES.iter().enumerate() {
        let options = Options {
            storage: case.0.map(Storage::of_weights),
            tolerance: Some(0.1),
            ..Options::default()
        };
        let image = compile_with(&bundle, &options).unwrap();
        let Some(counts) = counts(NAME, number, image.as_bytes()) else {
            println!("skipped: valgrind is not installed");
            return;
        };
        assert_eq!(counts.len(), OBSERVATIONS);
        let different: BTreeSet<u64> = counts.into_iter().collect();
        println!("instructions of a step, {case:?}: {different:?}");
        assert_eq!(different.len(), 1, "{case:?}: {different:?}");
    }
}

#[test]
#[ignore = "needs random bundles: tests/parity/test_families.py makes them and runs this"]
fn every_place_in_the_schedule_of_every_family_takes_one_number_of_instructions() {
    const NAME: &str =
        "every_place_in_the_schedule_of_every_family_takes_one_number_of_instructions";
    if std::env::var_os(CHILD).is_some() {
        return with_image(episodes);
    }
    for (number, kind) in kinds().iter().enumerate() {
        let bundle = Bundle::open(&folder().join(format!("{kind}.onnx"))).unwrap();
        let image = compile_with(&bundle, &Options::default()).unwrap();
        let Some(counts) = counts(NAME, number, image.as_bytes()) else {
            println!("skipped: valgrind is not installed");
            return;
        };
        let steps = episode_len(&Policy::new_checked(image.as_bytes()).unwrap());
        assert_eq!(counts.len(), EPISODES * steps, "{kind}");
        for step in 0..steps {
            let here = counts.iter().skip(step).step_by(steps);
            let different: BTreeSet<u64> = here.copied().collect();
            assert_eq!(different.len(), 1, "{kind}, step {step}: {different:?}");
        }
        println!("instructions of {kind}'s steps: {:?}", &counts[..steps]);
    }
}

/// Returns the numbers of instructions of all calls in their order; `None` without `valgrind`.
fn counts(test: &str, case: usize, image: &[u8]) -> Option<Vec<u64>> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("image");
    std::fs::write(&path, image).unwrap();
    let counted = Command::new("valgrind")
        .args(["--tool=callgrind", "--toggle-collect=one_control_step"])
        .arg("--dump-after=one_control_step")
        .arg(format!(
            "--callgrind-out-file={}/counts",
            folder.path().display()
        ))
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", test, "--include-ignored"])
        .env(CHILD, case.to_string())
        .env(IMAGE, &path)
        .output();
    let output = counted.ok()?;
    assert!(output.status.success(), "{output:?}");
    // One file per call, numbered from 1, and a last one when the program ends, in which nothing was counted.
    let counts: BTreeMap<usize, u64> = std::fs::read_dir(folder.path())
        .unwrap()
        .filter_map(|entry| {
            let path = entry.unwrap().path();
            let count = total(&path)?;
            let number = path.extension()?.to_str()?.parse().ok()?;
            Some((number, count)).filter(|&(_, count)| count > 0)
        })
        .collect();
    Some(counts.into_values().collect())
}

/// Reads the count from a file of `callgrind`.
fn total(path: &Path) -> Option<u64> {
    let text = String::from_utf8(std::fs::read(path).ok()?).ok()?;
    let mut lines = text.lines();
    let total = lines.find_map(|line| line.strip_prefix("totals: "))?;
    total.trim().parse().ok()
}
