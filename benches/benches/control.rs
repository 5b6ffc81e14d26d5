//! Measures a control period, and what comes before it: opening, compiling, setting an instruction.
//!
//! Control steps are measured with 300 tokens in the context (the words and two tokens per step), which is the middle of a kitchen
//! episode. A step changes its context, so every measured step is preceded by the unmeasured ones that fill it.

use std::hint::black_box;
use std::time::{Duration, Instant};

use criterion::{Criterion, criterion_group, criterion_main};
use lads_benches::bundle;
use lads_compiler::{Bundle, compile};
use lads_core::{Controller, Data, Instruction, Policy, Role};
use lads_host::schedule;
use lads_image::Tables;

/// Tokens in the context of a measured control step.
const CONTEXT: usize = 300;

/// Number of control steps after which the schedule repeats.
fn period(policy: &Policy<'_>) -> usize {
    Tables::new(policy.image()).map_or(1, |tables| schedule::period(&tables) as usize)
}

/// Finds the first control step that begins a period with at least [`CONTEXT`] tokens, or the last that does in a shorter context.
fn deciding_step(policy: &Policy<'_>, words: usize) -> usize {
    let steps = policy.contract().context_steps();
    let (period, last) = (period(policy), steps.map_or(CONTEXT, |steps| steps - 1));
    let wanted = CONTEXT
        .saturating_sub(words)
        .div_ceil(2)
        .next_multiple_of(period);
    wanted.min(last - last % period)
}

fn control(criterion: &mut Criterion) {
    let opened = lads_host::open(&bundle()).expect("the bundle that ships opens");
    let mut loaded = opened.load().expect("there is memory for it");
    let mut controller = loaded.controller();
    let policy = *controller.policy();
    controller
        .set_instruction(Instruction::Id(0))
        .expect("there is one");

    let words = policy
        .contract()
        .instruction(0)
        .map_or(0, |known| known.words.len() / policy.contract().word_dim());
    let decides = deciding_step(&policy, words);
    let period = period(&policy);
    let mut group = criterion.benchmark_group("control_step");
    // Most of the time goes into the steps before the measured ones.
    group.sample_size(10);
    group.bench_function("decision/300", |bencher| {
        bencher
            .iter_custom(|iterations| measure(&mut controller, decides..decides + 1, iterations));
    });
    group.bench_function("ordinary/300", |bencher| {
        bencher.iter_custom(|iterations| {
            measure(&mut controller, decides + 1..decides + period, iterations)
        });
    });
    group.finish();

    entries(criterion, &mut controller);
    let mut group = criterion.benchmark_group("self_test");
    group.sample_size(10);
    group.bench_function("whole episode", |bencher| {
        bencher.iter(|| controller.self_test());
    });
    group.finish();
}

/// Measures the entries that can be called on their own.
fn entries(criterion: &mut Criterion, controller: &mut Controller<'_, '_>) {
    let policy = *controller.policy();
    let (contract, golden) = (policy.contract(), policy.golden());
    let golden = golden.expect("the bundle that ships has a golden episode");
    let steps: Vec<_> = golden.steps().take(period(&policy)).collect();
    let observations: Vec<f32> = steps
        .iter()
        .flat_map(lads_core::GoldenStep::observation)
        .copied()
        .collect();
    let actions: Vec<f32> = steps.iter().flat_map(|step| step.action).copied().collect();
    let (seen, index) = (steps[0].observations(), steps[0].selected.unwrap_or(0));
    let demonstration: Vec<_> = contract
        .channels()
        .filter(|channel| channel.role() == Role::Demonstration)
        .map(|channel| match channel.name() {
            "actions" => (channel.id(), Data::F32(&actions)),
            _ => (channel.id(), Data::F32(&observations)),
        })
        .collect();
    let mut action = vec![0.0; contract.action_len()];
    let mut group = criterion.benchmark_group("entry");
    group.bench_function("high_level/instruct", |bencher| {
        bencher.iter(|| controller.set_instruction(black_box(Instruction::Id(0))));
    });
    group.bench_function("low_level/act", |bencher| {
        bencher.iter(|| controller.follow(black_box(seen), index, &mut action));
    });
    group.bench_function("trajectory_encoder/encode", |bencher| {
        bencher.iter(|| controller.encode(black_box(&demonstration)));
    });
    group.finish();
}

/// Measures `iterations` control steps, all of them in `measured` of one episode after the other.
fn measure(
    controller: &mut Controller<'_, '_>,
    measured: std::ops::Range<usize>,
    iterations: u64,
) -> Duration {
    let policy = *controller.policy();
    let golden = policy
        .golden()
        .expect("the bundle that ships has a golden episode");
    let mut action = vec![0.0; policy.contract().action_len()];
    let (mut total, mut left) = (Duration::ZERO, iterations);
    while left > 0 {
        controller.reset();
        let episodes = std::iter::repeat_with(|| golden.steps()).flatten();
        for (step, recorded) in episodes.enumerate().take(measured.end) {
            let observation = recorded.observation();
            let start = Instant::now();
            let report = controller.step(black_box(observation), &mut action);
            let elapsed = start.elapsed();
            black_box(report.expect("recorded observations are accepted"));
            if measured.contains(&step) && left > 0 {
                total += elapsed;
                left -= 1;
            }
        }
    }
    total
}

fn preparation(criterion: &mut Criterion) {
    let path = bundle();
    let bytes = std::fs::read(&path).expect("the bundle that ships can be read");
    let bundle = Bundle::from_bytes(&bytes).expect("it opens");
    let image = compile(&bundle).expect("it compiles");
    let mut group = criterion.benchmark_group("preparation");
    group.sample_size(10);
    group.bench_function("bundle", |bencher| {
        bencher.iter(|| Bundle::from_bytes(black_box(&bytes)));
    });
    group.bench_function("compile", |bencher| {
        bencher.iter(|| compile(black_box(&bundle)));
    });
    group.bench_function("open", |bencher| {
        bencher.iter(|| Policy::new_checked(black_box(image.as_bytes())));
    });
    group.finish();
}

criterion_group!(benches, control, preparation);
criterion_main!(benches);
