//! Tests the kitchen environment: determinism, noise, refusals.

use std::path::Path;
use std::sync::LazyLock;

use lads_sim::assets::vendor_dir;
use lads_sim::environment::{ActionError, Environment, EpisodeSeed};
use lads_sim::kitchen::{Kitchen, Noise, Scene};
use lads_sim::random::Stream;

static SCENE: LazyLock<Scene> =
    LazyLock::new(|| Scene::load(&vendor_dir()).unwrap_or_else(|error| panic!("{error}")));

fn episode(episode: u64) -> EpisodeSeed {
    EpisodeSeed {
        seed: 3,
        instruction: 1,
        episode,
    }
}

/// Runs an episode of random actions and returns its observations.
fn run(kitchen: &mut Kitchen, seed: EpisodeSeed, steps: usize) -> Vec<Vec<f64>> {
    let mut actions = Stream::new(&[77]);
    let mut observations = vec![kitchen.reset(seed, &[]).to_vec()];
    for _ in 0..steps {
        let action: [f64; 9] = std::array::from_fn(|_| actions.uniform(-1.5, 1.5));
        observations.push(kitchen.step(&action).unwrap().to_vec());
    }
    observations
}

#[test]
fn the_same_episode_is_the_same_bits() {
    let mut kitchen = Kitchen::new(&SCENE, Noise::V0);
    let first = run(&mut kitchen, episode(0), 40);
    run(&mut kitchen, episode(9), 15);
    assert_eq!(
        run(&mut kitchen, episode(0), 40),
        first,
        "after another episode"
    );
    let on_threads: Vec<_> = std::thread::scope(|scope| {
        let run = || run(&mut Kitchen::new(&SCENE, Noise::V0), episode(0), 40);
        let threads = [scope.spawn(run), scope.spawn(run)];
        threads.map(|thread| thread.join().unwrap()).into()
    });
    assert!(
        on_threads.iter().all(|other| *other == first),
        "in another environment of the same scene"
    );
    assert_ne!(
        run(&mut kitchen, episode(1), 40),
        first,
        "another episode has other noise"
    );
}

#[test]
fn noise_fills_its_amplitudes_and_no_more() {
    for noise in [Noise::None, Noise::V0, Noise::V1] {
        let mut kitchen = Kitchen::new(&SCENE, noise);
        let mut largest = [0.0_f64; 30];
        for number in 0..200 {
            kitchen.reset(episode(number), &[]);
            for ((largest, seen), truth) in largest
                .iter_mut()
                .zip(kitchen.observation())
                .zip(kitchen.state())
            {
                *largest = largest.max((seen - truth).abs());
            }
        }
        for (index, (largest, amplitude)) in largest.into_iter().zip(noise.amplitudes()).enumerate()
        {
            // The rounding of `seen - truth` is far below 1e-12; 200 draws miss the outer tenth with probability 1e-9.
            assert!(
                largest <= amplitude + 1e-12,
                "{noise:?} {index}: {largest} > {amplitude}"
            );
            assert!(
                largest >= 0.9 * amplitude,
                "{noise:?} {index}: {largest} of {amplitude}"
            );
        }
    }
    assert!((Noise::V0.amplitudes()[0] - 0.01).abs() < 1e-15);
    assert!((Noise::V1.amplitudes()[0] - 0.001).abs() < 1e-15);
    assert_eq!(
        Noise::V1.amplitudes()[9],
        0.0005 * 0.1,
        "v1 takes the amplitude of the element before"
    );
}

#[test]
fn a_refused_action_changes_nothing() {
    let mut kitchen = Kitchen::new(&SCENE, Noise::V0);
    kitchen.reset(episode(0), &[]);
    let (observation, state) = (kitchen.observation().to_vec(), kitchen.state().to_vec());
    let mut action = [0.0; 9];
    action[4] = f64::NAN;
    assert_eq!(
        kitchen.step(&action),
        Err(ActionError::NotFinite { index: 4 })
    );
    assert_eq!(
        kitchen.step(&[0.0; 8]),
        Err(ActionError::WrongLen { got: 8, needed: 9 })
    );
    assert_eq!(
        (kitchen.observation(), kitchen.state(), kitchen.steps()),
        (&observation[..], &state[..], 0)
    );
}

#[test]
fn names_match_the_lengths() {
    let kitchen = Kitchen::new(&SCENE, Noise::V0);
    assert_eq!(
        (
            kitchen.observation_len(),
            kitchen.observation().len(),
            kitchen.state().len()
        ),
        (30, 30, 30)
    );
    assert_eq!(
        (
            kitchen.action_len(),
            kitchen.sub_tasks().len(),
            kitchen.max_steps("seen")
        ),
        (9, 7, 280)
    );
    assert_eq!(kitchen.control_period_s(), 0.08);
}

#[test]
fn missing_assets_name_the_remedy() {
    let error = Scene::load(Path::new("/no/such/vendor"))
        .err()
        .unwrap()
        .to_string();
    assert!(
        error.contains("/no/such/vendor") && error.ends_with("run \"make setup\""),
        "{error}"
    );
    assert_eq!(error.lines().count(), 1);
}
