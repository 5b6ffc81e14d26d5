//! Tests the scripted experts and the collector.

use std::num::NonZeroUsize;
use std::sync::LazyLock;

use lads_sim::assets::vendor_dir;
use lads_sim::collect::{CollectError, FIRST_EPISODE, MAX_STEPS, Settings, collect};
use lads_sim::environment::{Environment, EpisodeSeed};
use lads_sim::expert::Performer;
use lads_sim::instructions::Instructions;
use lads_sim::kitchen::spec::{SUB_TASK_NAMES, SUB_TASKS};
use lads_sim::kitchen::{Kitchen, Noise, Scene};

static SCENE: LazyLock<Scene> =
    LazyLock::new(|| Scene::load(&vendor_dir()).unwrap_or_else(|error| panic!("{error}")));

fn settings(episodes_per_instruction: usize, recovery_noise: f64, threads: usize) -> Settings {
    Settings {
        episodes_per_instruction,
        seed: 1,
        noise: Noise::V0,
        recovery_noise,
        threads: NonZeroUsize::new(threads).unwrap(),
    }
}

#[test]
fn every_sub_task_succeeds_from_the_start() {
    let mut kitchen = Kitchen::new(&SCENE, Noise::V0);
    for (sub_task, name) in SUB_TASK_NAMES.iter().enumerate() {
        for episode in 0..2 {
            let seed = EpisodeSeed {
                seed: 4,
                instruction: sub_task as u64,
                episode,
            };
            let mut performer = Performer::new(&mut kitchen, seed, 0.0, 100);
            assert_eq!(
                performer.perform(sub_task),
                Ok(true),
                "{name}, episode {episode}"
            );
            let completions = performer.environment().completions();
            assert_eq!(
                completions.len(),
                1,
                "{name} and nothing else: {completions:?}"
            );
            // Entry `n` of the record is the state after `n` steps.
            let step = completions[0].step;
            let done = |step: usize| {
                SUB_TASKS[sub_task].is_done(&performer.transitions()[step].state.map(f64::from))
            };
            assert!(
                done(step) && !done(step - 1),
                "{name} was done after step {step} for the first time"
            );
        }
    }
}

#[test]
fn without_recovery_noise_nine_of_ten_attempts_succeed() {
    let instructions = Instructions::kitchen().seen;
    let (dataset, tallies) = collect(&SCENE, &instructions, &settings(1, 0.0, 2), |_| {}).unwrap();
    let attempts: usize = tallies.iter().map(|tally| tally.attempts).sum();
    assert!(22 * 10 >= attempts * 9, "22 of {attempts}");
    for demonstration in &dataset.demonstrations {
        for step in &demonstration.transitions {
            assert_eq!(step.action, step.executed, "no noise on what is executed");
            assert!(
                step.action[7..] == [1.0; 2] || step.action[7..] == [-1.0; 2],
                "fingers open or close with full force"
            );
        }
    }
}

#[test]
fn with_the_recovery_noise_that_ships_six_of_ten_attempts_succeed() {
    let instructions = Instructions::kitchen().seen;
    let (dataset, tallies) =
        collect(&SCENE, &instructions[..11], &settings(2, 0.25, 2), |_| {}).unwrap();
    let attempts: usize = tallies.iter().map(|tally| tally.attempts).sum();
    assert!(22 * 10 >= attempts * 6, "22 of {attempts}");
    for demonstration in &dataset.demonstrations {
        assert!((0.0..0.25).contains(&demonstration.recovery_noise));
        assert!(demonstration.episode >= FIRST_EPISODE);
        let steps = demonstration.transitions.len();
        assert!(
            steps <= MAX_STEPS
                && demonstration.sub_task_ends[3] == steps
                && demonstration.sub_task_ends.is_sorted()
        );
        assert!(
            demonstration
                .transitions
                .iter()
                .any(|step| step.action[..7] != step.executed[..7])
        );
        for step in &demonstration.transitions {
            assert_eq!(
                step.action[7..],
                step.executed[7..],
                "the fingers carry no noise"
            );
            assert!(
                step.action
                    .iter()
                    .chain(&step.executed)
                    .all(|value| value.abs() <= 1.0)
            );
        }
    }
}

#[test]
fn the_dataset_does_not_depend_on_the_threads() {
    let instructions = &Instructions::kitchen().seen[8..11];
    let mut attempts = 0;
    let alone = collect(&SCENE, instructions, &settings(2, 0.25, 1), |_| {
        attempts += 1;
    })
    .unwrap();
    assert_eq!(
        attempts,
        alone.1.iter().map(|tally| tally.attempts).sum::<usize>(),
        "progress is told of every attempt"
    );
    assert_eq!(
        alone,
        collect(&SCENE, instructions, &settings(2, 0.25, 3), |_| {}).unwrap()
    );
    let other_seed = Settings {
        seed: 2,
        ..settings(2, 0.25, 3)
    };
    assert_ne!(
        alone.0.demonstrations,
        collect(&SCENE, instructions, &other_seed, |_| {})
            .unwrap()
            .0
            .demonstrations
    );
}

#[test]
fn senseless_settings_are_refused() {
    let instructions = Instructions::kitchen().seen;
    assert_eq!(
        collect(&SCENE, &instructions, &settings(0, 0.1, 1), |_| {}).unwrap_err(),
        CollectError::NoEpisodes
    );
    for noise in [-0.1, f64::NAN, 2.0] {
        assert_eq!(
            collect(&SCENE, &instructions, &settings(1, noise, 1), |_| {}).unwrap_err(),
            CollectError::BadNoise
        );
    }
}
