//! What a control period costs, and what comes before it: opening, compiling, setting an instruction.
//!
//! Control steps are measured with 300 tokens in the context (the words and two tokens per step), which is the middle of a kitchen
//! episode. A step changes its context, so every measured step is preceded by the unmeasured ones that fill it.

use std::hint::black_box;
use std::time::{Duration, Instant};

use criterion::{Criterion, criterion_group, criterion_main};
use lads_benches::bundle;
use lads_compiler::{Bundle, compile};
use lads_core::{Controller, Instruction, PlanIndex, Policy, Workspace};

/// Tokens in the context of a measured control step.
const CONTEXT: usize = 300;

/// The first control step that decides with at least [`CONTEXT`] tokens, or the last that decides in a shorter context.
fn deciding_step(policy: &Policy<'_>, words: usize) -> usize {
    let contract = policy.contract();
    let (horizon, last) = (contract.horizon(), contract.context_steps() - 1);
    let wanted = CONTEXT
        .saturating_sub(words)
        .div_ceil(2)
        .next_multiple_of(horizon);
    wanted.min(last - last % horizon)
}

fn control(criterion: &mut Criterion) {
    let bundle = Bundle::open(&bundle()).expect("the bundle that ships opens");
    let image = compile(&bundle).expect("it compiles");
    let policy = Policy::new_checked(image.as_bytes()).expect("its image is sound");
    let mut arena = vec![0.0; policy.arena_len()];
    let mut state = vec![0.0; policy.state_len()];
    let workspace = Workspace::new(&policy, &mut arena, &mut state).expect("it is large enough");
    let mut controller = Controller::new(policy, workspace);
    controller
        .set_instruction(Instruction::Id(0))
        .expect("there is one");

    let words = policy
        .contract()
        .instruction(0)
        .map_or(0, |known| known.words.len() / policy.contract().word_dim());
    let decides = deciding_step(&policy, words);
    let horizon = policy.contract().horizon();
    let mut group = criterion.benchmark_group("control_step");
    // Most of the time goes into the steps before the measured ones.
    group.sample_size(10);
    group.bench_function("decision/300", |bencher| {
        bencher
            .iter_custom(|iterations| measure(&mut controller, decides..decides + 1, iterations));
    });
    group.bench_function("ordinary/300", |bencher| {
        bencher.iter_custom(|iterations| {
            measure(&mut controller, decides + 1..decides + horizon, iterations)
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

/// The entries that a call of its own reaches.
fn entries(criterion: &mut Criterion, controller: &mut Controller<'_, '_>) {
    let policy = *controller.policy();
    let (contract, golden) = (policy.contract(), policy.golden());
    let golden = golden.expect("the bundle that ships has a golden episode");
    let horizon = contract.horizon();
    let steps: Vec<_> = golden.steps().take(horizon).collect();
    let observations: Vec<f32> = steps.iter().flat_map(|step| step.0).copied().collect();
    let actions: Vec<f32> = steps.iter().flat_map(|step| step.2).copied().collect();
    let (observation, plan, _) = steps[0];
    let mut action = vec![0.0; contract.action_len()];
    let mut group = criterion.benchmark_group("entry");
    group.bench_function("high_level/instruct", |bencher| {
        bencher.iter(|| controller.set_instruction(black_box(Instruction::Id(0))));
    });
    group.bench_function("low_level/act", |bencher| {
        bencher.iter(|| controller.act(black_box(observation), PlanIndex(plan), &mut action));
    });
    group.bench_function("trajectory_encoder/encode", |bencher| {
        bencher.iter(|| controller.encode(black_box(&observations), &actions));
    });
    group.finish();
}

/// Time of `iterations` control steps, all of them in `measured` of one episode after the other.
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
        for (step, (observation, _, _)) in episodes.enumerate().take(measured.end) {
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
