//! Tests the `LOReL` table against trajectories of the Python implementation (`exporter/lads_exporter/lorel_table.py`), its own promises,
//! and what `lads-collect` makes of it.

use std::num::NonZeroUsize;
use std::sync::OnceLock;

use lads_sim::assets::vendor_dir;
use lads_sim::environment::{Environment, EpisodeSeed};
use lads_sim::lorel::collect::{Collected, Settings, collect};
use lads_sim::lorel::spec::{OBSERVATION_LEN, SUB_TASK_NAMES};
use lads_sim::lorel::{Lorel, Scene};
use serde::Deserialize;

#[derive(Deserialize)]
struct Recorded {
    seed: [u64; 3],
    commanded: Vec<String>,
    actions: Vec<Vec<f64>>,
    start: Vec<f64>,
    after_5: Vec<f64>,
    after_20: Vec<f64>,
    succeeded: Vec<String>,
}

/// Loads the scene once, so that its settled postures are made once.
fn scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| Scene::load(&vendor_dir()).unwrap_or_else(|error| panic!("{error}")))
}

fn seed([seed, instruction, episode]: [u64; 3]) -> EpisodeSeed {
    EpisodeSeed {
        seed,
        instruction,
        episode,
    }
}

fn index(name: &String) -> usize {
    let found = SUB_TASK_NAMES.iter().position(|known| known == name);
    found.unwrap()
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!((a.len(), b.len()), (OBSERVATION_LEN, OBSERVATION_LEN));
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max)
}

#[test]
fn trajectories_are_those_of_the_python_implementation() {
    let recorded: Vec<Recorded> =
        serde_json::from_str(include_str!("data/lorel-trajectories.json")).unwrap();
    let mut lorel = Lorel::new(scene());
    for one in &recorded {
        let commanded: Vec<usize> = one.commanded.iter().map(index).collect();
        // Equal to rounding on one machine, and on another, whose sines round differently: these episodes were chosen among those
        // that do not amplify a disturbance of 1e-12 (a hand that just touches a mug amplifies it to millimetres).
        let start = distance(lorel.reset(seed(one.seed), &commanded), &one.start);
        assert!(start < 1e-5, "{:?}: start differs by {start}", one.seed);
        for action in &one.actions[..5] {
            lorel.step(action).unwrap();
        }
        let early = distance(lorel.observation(), &one.after_5);
        assert!(early < 1e-4, "{:?}: step 5 differs by {early}", one.seed);
        for action in &one.actions[5..] {
            lorel.step(action).unwrap();
        }
        let late = distance(lorel.observation(), &one.after_20);
        assert!(late < 1e-3, "{:?}: step 20 differs by {late}", one.seed);
        let succeeded = (0..SUB_TASK_NAMES.len()).filter(|&task| lorel.succeeded(&[task]));
        let expected: Vec<usize> = one.succeeded.iter().map(index).collect();
        assert_eq!(succeeded.collect::<Vec<_>>(), expected, "{:?}", one.seed);
        assert!(
            lorel.succeeded(&expected),
            "what holds one by one holds together"
        );
    }
}

#[test]
fn a_seed_is_an_episode_whatever_came_before() {
    let (mut one, mut other) = (Lorel::new(scene()), Lorel::new(scene()));
    other.reset(seed([5, 1, 1]), &[0]);
    other.step(&[1.0, 1.0, -1.0, 2.0, 1.0]).unwrap();
    let action = [0.5, -0.5, -1.0, 3.0, -1.0];
    let run = |lorel: &mut Lorel| {
        lorel.reset(seed([7, 2, 3]), &[6]);
        lorel.step(&action).unwrap().to_vec()
    };
    assert_eq!(run(&mut one), run(&mut other));
    assert!(one.step(&[0.0; 4]).is_err() && one.step(&[f64::NAN; 5]).is_err());
    assert_eq!(one.steps(), 1, "a refused action changes nothing");
    assert_eq!(
        (one.max_steps("atomic"), one.max_steps("composite")),
        (20, 40)
    );
}

fn collected(threads: usize) -> Collected {
    let settings = Settings {
        episodes: 120,
        seed: 4,
        threads: NonZeroUsize::new(threads).unwrap(),
    };
    let mut finished = 0;
    let collected = collect(scene(), &settings, |count| finished += count).unwrap();
    assert_eq!(finished, 120);
    collected
}

#[test]
fn a_collection_does_not_depend_on_the_threads() {
    let (one, three) = (collected(1), collected(3));
    assert_eq!(one, three);
    // 17.6 % of 50,000 move nothing; five standard deviations around it.
    assert!((4..=45).contains(&one.nothing()), "{}", one.nothing());
    for trajectory in &one.trajectories {
        assert!(!trajectory.label.sub_tasks.is_empty());
        let unused = trajectory.actions.map(|action| action[3].abs());
        assert!(unused.iter().all(|&value| value <= std::f32::consts::PI));
        assert!(
            unused.iter().any(|&value| value > 1.0),
            "recorded as it was drawn"
        );
    }
}
