//! Measures a simulated control step, a camera's frame, and how many control steps an evaluation makes in a second, with the simulator that
//! `make setup` fetches.

use std::sync::atomic::AtomicBool;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lads_benches::bundle;
use lads_compiler::{Bundle, compile};
use lads_core::{Decision, Isa, Policy};
use lads_sim::assets::vendor_dir;
use lads_sim::environment::{Environment, EpisodeSeed};
use lads_sim::evaluate::{Assignment, Evaluation};
use lads_sim::frames::Frames;
use lads_sim::registry;
use lads_sim::rollout::Actor;

/// Number of control steps of an episode.
const STEPS: usize = 280;

const START: EpisodeSeed = EpisodeSeed {
    seed: 0,
    instruction: 0,
    episode: 0,
};

fn environment(criterion: &mut Criterion) {
    let open = registry::load("franka-kitchen", "v0", &vendor_dir())
        .expect("make setup has fetched the simulator");
    let mut kitchen = open();
    let command = vec![0.1; kitchen.action_len()];
    let mut group = criterion.benchmark_group("environment");
    group.sample_size(10);
    group.bench_function("reset", |bencher| {
        bencher.iter(|| kitchen.reset(START, &[])[0]);
    });
    group.bench_function("step", |bencher| {
        kitchen.reset(START, &[]);
        bencher.iter(|| {
            if kitchen.steps() == STEPS {
                kitchen.reset(START, &[]);
            }
            kitchen.step(&command).expect("the command is finite")[0]
        });
    });
    group.finish();
}

fn evaluation(criterion: &mut Criterion) {
    let open = registry::load("franka-kitchen", "v0", &vendor_dir())
        .expect("make setup has fetched the simulator");
    let bundle = Bundle::open(&bundle()).expect("the bundle that ships opens");
    let image = compile(&bundle).expect("it compiles");
    let policy = Policy::new_checked(image.as_bytes()).expect("its image is sound");
    let kitchen: Box<dyn Environment> = open();
    let (asked, _) = bundle.contract().evaluated(0);
    let commanded = asked
        .iter()
        .filter_map(|task| kitchen.sub_tasks().iter().position(|known| known == task))
        .collect();
    let assignments = [Assignment {
        instruction: 0,
        commanded,
        max_steps: STEPS,
    }];
    let evaluation = Evaluation {
        policy,
        contract: bundle.contract(),
        assignments: &assignments,
        episodes: 1,
        seed: 0,
        decision: Decision::Argmax,
        actor: Actor::Policy,
        isa: Isa::detect(),
        threads: 1,
        setup: lads_sim::evaluate::Setup::default(),
    };
    let run = || {
        let evaluated = evaluation.run(&*open, &AtomicBool::new(false), &|| ());
        let evaluated = evaluated.expect("an episode runs to its end");
        evaluated.episodes.concat().iter().map(|e| e.steps).sum()
    };
    let steps: usize = run();
    let mut group = criterion.benchmark_group("evaluation");
    group.sample_size(10);
    group.throughput(Throughput::Elements(steps as u64));
    group.bench_function("control steps of an episode, 1 thread", |bencher| {
        bencher.iter(run);
    });
    group.finish();
}

/// Frames as policies with a camera see them. No time of a control step has one in; with this it is the whole of a simulated one.
fn frame(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("frame");
    group.sample_size(10);
    for id in ["lorel-table", "franka-kitchen"] {
        let noise = registry::default_noise(id).unwrap_or("none");
        let open = registry::load(id, noise, &vendor_dir());
        let scene = open.expect("make setup has fetched the simulator")();
        let rendering = scene.rendering().expect("it has a camera");
        let mut frames = match Frames::new(scene.as_ref(), &rendering) {
            Ok(frames) => frames,
            Err(error) => {
                eprintln!("frame/{id}: not measured: {error}");
                continue;
            }
        };
        let [rows, columns] = rendering.size;
        group.bench_function(format!("{id}, {rows}x{columns}"), |bencher| {
            bencher.iter(|| frames.draw(scene.state()).expect("it is drawn")[0]);
        });
    }
    group.finish();
}

criterion_group!(benches, environment, frame, evaluation);
criterion_main!(benches);
