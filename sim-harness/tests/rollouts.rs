//! Tests rollouts with a compiled policy in an environment without a simulator: what they report, and that the number of threads does not
//! show.

#[path = "common/bench.rs"]
mod bench;

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use bench::{Bench, DESCRIPTION, tiny_contract, tiny_policy};
use lads_core::{Decision, Isa, Policy};
use lads_sim::environment::{Description, Environment};
use lads_sim::evaluate::{Assignment, Evaluated, Evaluation, EvaluationError, Setup};
use lads_sim::fit;
use lads_sim::rollout::{Actor, Control, Episode, Observer, Phase, Snapshot};

/// Decision rule of the tests; the seed is replaced by one per episode.
const SAMPLE: Decision = Decision::Sample {
    temperature: 1.0,
    seed: 0,
};

fn open() -> Box<dyn Environment> {
    Box::new(Bench::new(DESCRIPTION))
}

fn assignments() -> Vec<Assignment> {
    let commanded = fit::check(tiny_contract(), &Bench::new(DESCRIPTION)).unwrap();
    (0..)
        .zip(commanded)
        .map(|(instruction, commanded)| Assignment {
            instruction,
            commanded,
            max_steps: 40,
        })
        .collect()
}

fn evaluate(policy: &Policy<'_>, seed: u64, decision: Decision, threads: usize) -> Evaluated {
    let assignments = assignments();
    let evaluation = Evaluation {
        policy: *policy,
        contract: tiny_contract(),
        assignments: &assignments,
        episodes: 5,
        seed,
        decision,
        actor: Actor::Policy,
        isa: Isa::detect(),
        threads,
        setup: Setup::default(),
    };
    evaluation
        .run(&open, &AtomicBool::new(false), &|| {})
        .unwrap()
}

#[test]
fn the_number_of_threads_does_not_show() {
    let policy = tiny_policy();
    for decision in [Decision::Argmax, SAMPLE] {
        let one = evaluate(&policy, 3, decision, 1).episodes;
        assert_eq!(one.len(), 4);
        assert!(one.iter().all(|episodes| episodes.len() == 5));
        for threads in [2, 7] {
            assert_eq!(
                evaluate(&policy, 3, decision, threads).episodes,
                one,
                "{threads} threads, {decision:?}"
            );
        }
        assert_ne!(
            evaluate(&policy, 4, decision, 2).episodes,
            one,
            "another seed"
        );
    }
}

/// Restarts the first episode after five control steps, and once more at its end; stops the third in the middle.
#[derive(Debug, Default)]
struct RestartingObserver {
    looks: AtomicUsize,
    agains: AtomicUsize,
}

impl Observer for RestartingObserver {
    fn observe(&self, snapshot: Snapshot<'_>) -> Control {
        self.looks.fetch_add(1, Ordering::Relaxed);
        let (episode, steps) = (snapshot.task.seed.episode, snapshot.environment.steps());
        let agains = self.agains.load(Ordering::Relaxed);
        let ended = matches!(snapshot.phase, Phase::Ended { .. });
        if episode == 0 && ((agains == 0 && steps == 5) || (agains == 1 && ended)) {
            self.agains.fetch_add(1, Ordering::Relaxed);
            return Control::Restart;
        }
        if episode == 2 && steps == 3 {
            return Control::Stop;
        }
        Control::Continue
    }
}

#[test]
fn an_observer_changes_no_episode() {
    let policy = tiny_policy();
    let assignments = assignments();
    let observer = RestartingObserver::default();
    let evaluation = Evaluation {
        policy,
        contract: tiny_contract(),
        assignments: &assignments,
        episodes: 5,
        seed: 3,
        decision: SAMPLE,
        actor: Actor::Policy,
        isa: Isa::detect(),
        threads: 1,
        setup: Setup {
            observer: Some(&observer),
            traced: 1,
            ..Setup::default()
        },
    };
    let seen = evaluation
        .run_until(&open, &AtomicBool::new(false), &|| {})
        .unwrap();
    let plain = evaluate(&policy, 3, SAMPLE, 1).episodes;
    let finished: Vec<usize> = seen.episodes.iter().map(Vec::len).collect();
    assert_eq!(finished, [2, 0, 0, 0]);
    assert_eq!(seen.episodes[0], plain[0][..2]);
    assert_eq!(seen.traces[0].steps.len(), plain[0][0].steps);
    // One look at every action and one at every end: the first episode's beginning and twice the whole, the third up to its fourth step.
    let [first, second] = [0, 1].map(|episode| plain[0][episode].steps + 1);
    let looks = observer.looks.load(Ordering::Relaxed);
    assert_eq!(looks, 6 + 2 * first + second + 4);
    let interrupted = evaluation.run(&open, &AtomicBool::new(false), &|| {});
    assert!(matches!(interrupted, Err(EvaluationError::Interrupted)));
}

#[test]
fn sampling_chooses_other_plans_and_episodes_differ() {
    let policy = tiny_policy();
    let plans = |decision| {
        let episodes = evaluate(&policy, 3, decision, 2).episodes;
        episodes
            .into_iter()
            .flatten()
            .map(|episode| episode.plans)
            .collect::<Vec<_>>()
    };
    let sampled = plans(SAMPLE);
    assert_ne!(sampled, plans(Decision::Argmax));
    assert!(sampled.iter().any(|other| *other != sampled[0]));
}

#[test]
fn episodes_end_when_the_commanded_sub_tasks_are_done() {
    let policy = tiny_policy();
    let evaluated = evaluate(&policy, 0, Decision::Argmax, 2);
    let horizon = tiny_contract().period().unwrap();
    let mut early = 0;
    for (assignment, episodes) in assignments().iter().zip(&evaluated.episodes) {
        for Episode {
            steps,
            success,
            completions,
            plans,
            ..
        } in episodes
        {
            let of_commanded = completions
                .iter()
                .filter(|c| assignment.commanded.contains(&c.sub_task));
            let times: Vec<_> = of_commanded.map(|c| c.step).collect();
            if times.len() == assignment.commanded.len() {
                assert_eq!(
                    times.iter().max(),
                    Some(steps),
                    "the last completion ends the episode"
                );
                assert!(success);
                early += usize::from(*steps < 40);
            } else {
                assert!(!success);
                assert_eq!(*steps, 40, "nothing else does");
            }
            // The context holds 24 steps, a multiple of the horizon, and restarts there.
            assert_eq!(plans.len(), steps.div_ceil(horizon), "one plan per horizon");
        }
    }
    assert!(early > 0, "the test has to see such an end");
    let timing = &evaluated.timing;
    assert_eq!(timing.instruct_ns.len(), 20);
    let plans: usize = evaluated
        .episodes
        .iter()
        .flatten()
        .map(|episode| episode.plans.len())
        .sum();
    let steps: usize = evaluated
        .episodes
        .iter()
        .flatten()
        .map(|episode| episode.steps)
        .sum();
    assert_eq!(
        (timing.decision_ns.len(), timing.ordinary_ns.len()),
        (plans, steps - plans)
    );
    assert!(timing.simulator_cpu + timing.controller_cpu <= timing.episodes_cpu);
}

#[test]
fn a_stop_ends_the_work_without_a_result() {
    let policy = tiny_policy();
    let assignments = assignments();
    let evaluation = Evaluation {
        policy,
        contract: tiny_contract(),
        assignments: &assignments,
        episodes: 5,
        seed: 0,
        decision: Decision::Argmax,
        actor: Actor::Policy,
        isa: Isa::portable(),
        threads: 2,
        setup: Setup::default(),
    };
    let (stop, finished) = (AtomicBool::new(false), AtomicUsize::new(0));
    let count = || {
        if finished.fetch_add(1, Ordering::Relaxed) == 3 {
            stop.store(true, Ordering::Relaxed);
        }
    };
    let stopped = evaluation.run(&open, &stop, &count);
    assert!(matches!(stopped, Err(EvaluationError::Interrupted)));
    assert!(finished.into_inner() < evaluation.len());
}

#[test]
fn a_contract_that_does_not_fit_is_refused_by_name() {
    let refusal = |description: Description| {
        fit::check(tiny_contract(), &Bench::new(description))
            .unwrap_err()
            .to_string()
    };
    let cases = [
        (
            refusal(Description {
                id: "other",
                ..DESCRIPTION
            }),
            ["environment.id", "'tiny-bench'", "'other'"],
        ),
        (
            refusal(Description {
                version: "2",
                ..DESCRIPTION
            }),
            ["environment.version", "'1'", "'2'"],
        ),
        (
            refusal(Description {
                control_period_s: 0.04,
                ..DESCRIPTION
            }),
            ["control_period_s", "0.05", "0.04"],
        ),
        (
            refusal(Description {
                observation_names: &["joint1"],
                ..DESCRIPTION
            }),
            ["observation", "5 elements", "has 1"],
        ),
        (
            refusal(Description {
                action_names: &[],
                ..DESCRIPTION
            }),
            ["action", "3 elements", "has 0"],
        ),
        (
            refusal(Description {
                observation_names: &["joint2", "joint1", "drawer", "lamp", "lever"],
                ..DESCRIPTION
            }),
            ["element 0", "'joint1'", "'joint2'"],
        ),
        (
            refusal(Description {
                sub_tasks: &["drawer", "lamp"],
                ..DESCRIPTION
            }),
            ["'lv'", "'lever'", "does not know"],
        ),
    ];
    for (line, parts) in cases {
        assert!(
            parts.iter().all(|part| line.contains(part)),
            "{line}: {parts:?}"
        );
    }
}

#[test]
fn a_policy_with_a_camera_may_observe_the_first_elements_only() {
    let mut contract = tiny_contract().clone();
    let mut all = contract.channels.iter_mut();
    let own = all.find(|it| it.name == "observation").unwrap();
    own.elements.truncate(2);
    own.shape = vec![2];
    let bench = Bench::new(DESCRIPTION);
    let line = fit::check(&contract, &bench).unwrap_err().to_string();
    assert!(line.contains("2 elements"), "{line}");
    let camera = serde_json::json!({
        "name": "camera", "role": "observation", "dtype": "u8", "shape": [4, 6, 3], "min": 0, "max": 255,
        "rendering": {
            "view": {"camera": "front"}, "size": [4, 6], "drawn": [4, 6], "samples": 0, "shadow_size": 0,
            "shadow_clip": 1.0, "reflections": false, "hidden": [], "mesh_cell_m": 0.0,
        },
    });
    contract
        .channels
        .push(serde_json::from_value(camera).unwrap());
    assert!(fit::check(&contract, &bench).is_ok());
    let mut all = contract.channels.iter_mut();
    let own = all.find(|it| it.name == "observation").unwrap();
    own.elements.reverse();
    let line = fit::check(&contract, &bench).unwrap_err().to_string();
    assert!(line.contains("'joint2'"), "{line}");
}

/// Tests that a thread that panics ends the others after their current episode, not after the whole queue.
#[test]
fn a_panic_stops_all_threads() {
    let policy = tiny_policy();
    let assignments = assignments();
    let evaluation = Evaluation {
        policy,
        contract: tiny_contract(),
        assignments: &assignments,
        episodes: 200,
        seed: 0,
        decision: Decision::Argmax,
        actor: Actor::Policy,
        isa: Isa::detect(),
        threads: 2,
        setup: Setup::default(),
    };
    let finished = AtomicUsize::new(0);
    let count = || {
        if finished.fetch_add(1, Ordering::Relaxed) == 0 {
            // No message and no backtrace, which would give the other thread time.
            std::panic::resume_unwind(Box::new("lost"));
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
    };
    let run = || {
        evaluation
            .run(&open, &AtomicBool::new(false), &count)
            .map(drop)
    };
    let panic = std::panic::catch_unwind(std::panic::AssertUnwindSafe(run)).unwrap_err();
    assert_eq!(panic.downcast_ref::<&str>(), Some(&"lost"));
    let finished = finished.into_inner();
    assert!(finished < 400, "{finished} of 800 episodes were run");
}
