//! Tests recorded episodes in an environment without a simulator: what is written is read, replayed, encoded and followed.

#[path = "common/bench.rs"]
mod bench;

use std::io::Cursor;
use std::sync::atomic::AtomicBool;

use bench::{Bench, DESCRIPTION, tiny_contract, tiny_policy};
use lads_core::{Channel, Decision, Isa, Policy};
use lads_sim::environment::Environment;
use lads_sim::evaluate::{Assignment, Evaluated, Evaluation, EvaluationError, Setup};
use lads_sim::faults::Faults;
use lads_sim::fit;
use lads_sim::plans::{self, PlanFile, PlanSequence};
use lads_sim::recorder::{self, Flight, Log, Origin};
use lads_sim::replay::{Replayed, replay};
use lads_sim::rollout::Actor;

const SAMPLE: Decision = Decision::Sample {
    temperature: 1.0,
    seed: 0,
};

fn evaluate(
    policy: &Policy<'_>,
    decision: Decision,
    threads: usize,
    setup: Setup<'_>,
) -> Evaluated {
    try_evaluate(policy, decision, threads, setup).unwrap()
}

fn try_evaluate(
    policy: &Policy<'_>,
    decision: Decision,
    threads: usize,
    setup: Setup<'_>,
) -> Result<Evaluated, EvaluationError> {
    let commanded = fit::check(tiny_contract(), &Bench::new(DESCRIPTION)).unwrap();
    let assignments: Vec<_> = (0..)
        .zip(commanded)
        .map(|(instruction, commanded)| Assignment {
            instruction,
            commanded,
            max_steps: 40,
        })
        .collect();
    let evaluation = Evaluation {
        policy: *policy,
        contract: tiny_contract(),
        assignments: &assignments,
        episodes: 3,
        seed: 5,
        decision,
        actor: Actor::Policy,
        isa: Isa::detect(),
        threads,
        setup: Setup {
            traced: u32::MAX,
            ..setup
        },
    };
    let open = || -> Box<dyn Environment> { Box::new(Bench::new(DESCRIPTION)) };
    evaluation.run(&open, &AtomicBool::new(false), &|| {})
}

fn log(policy: &Policy<'_>, evaluated: &Evaluated) -> Log {
    let contract = policy.contract();
    let flights = evaluated.traces.iter().map(|trace| {
        let known = contract.instruction(trace.instruction as usize).unwrap();
        let mut trace = trace.clone();
        // A log has no final state.
        trace.outcome.final_state.clear();
        let done = &mut trace.outcome.completions;
        let completed = done
            .iter()
            .map(|c| DESCRIPTION.sub_tasks[c.sub_task].to_owned());
        let completed: Vec<_> = completed.collect();
        // As a log has it: its place among the completed.
        done.iter_mut()
            .enumerate()
            .for_each(|(i, c)| c.sub_task = i);
        Flight {
            words: None,
            instruction_id: known.id.to_owned(),
            instruction_text: known.text.to_owned(),
            completed,
            trace,
        }
    });
    Log {
        origin: Origin {
            bundle_sha256: contract.bundle_sha256().to_owned(),
            environment: "tiny-bench".to_owned(),
            environment_version: "1".to_owned(),
            seed: 5,
            noise: "none".to_owned(),
            control_period_s: 0.05,
            period: tiny_contract().period(),
            observation_names: names(&contract.observation()),
            action_names: names(&contract.action()),
            notes: [("mujoco".to_owned(), "none".to_owned())].into(),
        },
        flights: flights.collect(),
    }
}

fn names(channel: &Channel<'_>) -> Vec<String> {
    channel.elements().map(|e| e.name.to_owned()).collect()
}

fn bytes(log: &Log) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    recorder::write(log, &mut file).unwrap();
    file.into_inner()
}

fn read(bytes: &[u8]) -> Result<Log, recorder::LogError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.mcap");
    std::fs::write(&path, bytes).unwrap();
    recorder::read(&path)
}

fn replayed(policy: &Policy<'_>, log: &Log) -> Replayed {
    replay(policy, Isa::portable(), log, &|| {}).unwrap()
}

#[test]
fn a_log_reads_back_and_replays_bit_for_bit() {
    let policy = tiny_policy();
    for decision in [Decision::Argmax, SAMPLE] {
        let evaluated = evaluate(&policy, decision, 2, Setup::default());
        assert_eq!(evaluated.traces.len(), 12);
        let log = log(&policy, &evaluated);
        let again = read(&bytes(&log)).unwrap();
        assert_eq!(again, log);
        let replayed = replayed(&policy, &again);
        let steps = log
            .flights
            .iter()
            .map(|flight| flight.trace.steps.len())
            .sum();
        assert_eq!((replayed.episodes, replayed.steps), (12, steps));
        assert_eq!(replayed.differences, []);
    }
}

/// Tests the log of a policy that selects nothing and draws at random.
#[test]
fn a_log_without_plans_reads_back() {
    let policy = tiny_policy();
    let mut log = log(
        &policy,
        &evaluate(&policy, Decision::Argmax, 1, Setup::default()),
    );
    log.origin.period = None;
    for flight in &mut log.flights {
        flight.trace.noise_seed = Some(u64::MAX - 7);
        flight.trace.outcome.plans.clear();
        for step in &mut flight.trace.steps {
            (step.plan, step.decided, step.margin) = (None, false, None);
            step.scores.clear();
        }
    }
    let bytes = bytes(&log);
    assert_eq!(read(&bytes).unwrap(), log);
    let plan = br#"{"index":null,"decided":false,"margin":null}"#;
    assert!(bytes.windows(plan.len()).any(|window| window == plan));
    let error = replay(&policy, Isa::detect(), &log, &|| {}).unwrap_err();
    assert!(
        error.to_string().contains("control steps per plan is not"),
        "{error}"
    );
}

#[test]
fn the_first_step_that_differs_is_named() {
    let policy = tiny_policy();
    let mut log = log(
        &policy,
        &evaluate(&policy, Decision::Argmax, 1, Setup::default()),
    );
    let steps = &mut log.flights[4].trace.steps;
    steps[7].action[1] = f32::from_bits(steps[7].action[1].to_bits() ^ 1);
    steps[9].plan = steps[9].plan.map(|plan| plan + 1);
    let differences = replayed(&policy, &log).differences;
    assert_eq!(differences.len(), 1);
    let flight = &log.flights[4];
    let difference = &differences[0];
    assert_eq!(difference.instruction, flight.instruction_id);
    assert_eq!(
        (difference.episode, difference.step),
        (flight.trace.episode, 7)
    );
    assert_eq!(difference.plans, None);
    assert_eq!(difference.action.as_ref().unwrap().0, "joint2_velocity");

    log.origin.action_names[0].push('x');
    let error = replay(&policy, Isa::detect(), &log, &|| {}).unwrap_err();
    let error = error.to_string();
    assert!(error.contains("joint1_velocityx"), "{error}");
}

#[test]
fn a_damaged_log_is_refused() {
    let policy = tiny_policy();
    let whole = bytes(&log(
        &policy,
        &evaluate(&policy, Decision::Argmax, 1, Setup::default()),
    ));
    for end in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        assert!(read(&whole[..end]).is_err(), "cut off at {end}");
    }
    // Any changed bit is either refused or changes nothing that is read.
    let good = read(&whole).unwrap();
    for place in (0..whole.len()).step_by(whole.len() / 97) {
        let mut damaged = whole.clone();
        damaged[place] ^= 0x10;
        if let Ok(log) = read(&damaged) {
            assert!(log.flights == good.flights, "byte {place}");
        }
    }
    assert!(read(b"not a log").unwrap_err().to_string().contains("MCAP"));
}

#[test]
fn faults_depend_on_the_episode_alone_and_are_recorded() {
    let policy = tiny_policy();
    let faults = Faults {
        delay_steps: 2,
        drop_rate: 0.3,
        noise_scale: 0.5,
        action_lag: 1.5,
    };
    let setup = Setup {
        faults,
        ..Setup::default()
    };
    let one = evaluate(&policy, Decision::Argmax, 1, setup);
    let plain = evaluate(&policy, Decision::Argmax, 1, Setup::default());
    assert_ne!(one.traces, plain.traces);
    let timeless = |evaluated: &Evaluated| {
        let mut log = log(&policy, evaluated);
        for step in log
            .flights
            .iter_mut()
            .flat_map(|flight| &mut flight.trace.steps)
        {
            step.controller_ns = 0;
        }
        log
    };
    let many = evaluate(&policy, Decision::Argmax, 3, setup);
    assert_eq!(timeless(&many), timeless(&one));
    let steps = one.traces.iter().flat_map(|trace| &trace.steps);
    assert!(steps.clone().any(|step| step.action != step.executed));
    assert!(
        plain
            .traces
            .iter()
            .flat_map(|trace| &trace.steps)
            .all(|step| step.action == step.executed)
    );
    assert_eq!(replayed(&policy, &log(&policy, &one)).differences, []);
}

#[test]
fn commanded_plans_are_followed_and_encoded() {
    let policy = tiny_policy();
    let contract = policy.contract();
    let horizon = tiny_contract().period().unwrap();
    let ids: Vec<_> = contract
        .instructions()
        .map(|known| known.id.to_owned())
        .collect();
    let index = |id: &str| ids.iter().position(|known| known == id).map(|i| i as u32);
    let sequence = |id: &String| PlanSequence {
        instruction: id.clone(),
        episode: None,
        plans: vec![1, 0, 2],
    };
    let file = PlanFile::new(horizon, ids.iter().map(sequence).collect());
    let book = file.check(&policy, Some(horizon), index).unwrap();
    let setup = Setup {
        plans: Some(&book),
        ..Setup::default()
    };
    let evaluated = evaluate(&policy, Decision::Argmax, 2, setup);
    for trace in &evaluated.traces {
        assert!(trace.commanded && trace.steps.len() <= 3 * horizon);
        for (number, step) in trace.steps.iter().enumerate() {
            assert_eq!(step.plan, Some([1, 0, 2][number / horizon]));
        }
    }
    assert_eq!(replayed(&policy, &log(&policy, &evaluated)).differences, []);

    let agreement = plans::agreement(&policy, Isa::detect(), &evaluated.traces).unwrap();
    let full: usize = evaluated
        .traces
        .iter()
        .map(|trace| trace.steps.len() / horizon)
        .sum();
    assert_eq!(agreement.segments, full);
    let recordings = evaluated.traces.iter().map(|trace| trace.steps.as_slice());
    let encoded = plans::encode(&policy, Isa::detect(), recordings).unwrap();
    let agreed = encoded.iter().flatten().zip([1, 0, 2].iter().cycle());
    assert!(encoded.iter().all(|plans| plans.len() <= 3));
    if encoded.iter().all(|plans| plans.len() == 3) {
        assert_eq!(agreement.agreed, agreed.filter(|(a, b)| a == b).count());
    }

    // Every step has a plan: of the horizon that ends with the last step where the last one is not full.
    let steps = evaluated.traces[0].steps.as_slice();
    let parts = [
        &steps[..2 * horizon],
        &steps[..=horizon],
        &steps[1..=horizon],
        &steps[..horizon - 1],
    ];
    let of_parts = plans::encode(&policy, Isa::detect(), parts).unwrap();
    assert_eq!(
        of_parts.iter().map(Vec::len).collect::<Vec<_>>(),
        [2, 2, 1, 0]
    );
    assert_eq!(of_parts[1][0], of_parts[0][0]);
    assert_eq!(
        of_parts[1][1], of_parts[2][0],
        "the last steps of the recording"
    );

    let refused = |change: &dyn Fn(&mut PlanFile)| {
        let mut file = file.clone();
        change(&mut file);
        file.check(&policy, Some(horizon), index)
            .unwrap_err()
            .to_string()
    };
    let size = policy.index_count();
    assert!(refused(&|file| file.period += 1).contains("control steps each"));
    assert!(refused(&|file| file.episodes[0].plans[1] = size).contains("the policy has"));
    assert!(refused(&|file| file.episodes[0].plans.clear()).contains("has no plans"));
    assert!(refused(&|file| file.episodes[1] = file.episodes[0].clone()).contains("twice"));
    assert!(refused(&|file| file.episodes[0].instruction.push('?')).contains("does not know"));
}

#[test]
fn a_refused_observation_ends_its_episode_or_everything() {
    let policy = tiny_policy();
    // Noise of up to 0.05, 20 times: beyond the contract's limits sooner or later.
    let mut setup = Setup {
        faults: Faults {
            noise_scale: 20.0,
            ..Faults::default()
        },
        ..Setup::default()
    };
    let refused = try_evaluate(&policy, Decision::Argmax, 2, setup).unwrap_err();
    assert!(
        refused.to_string().contains("refuses the observation"),
        "{refused}"
    );
    setup.stop_where_refused = true;
    let evaluated = evaluate(&policy, Decision::Argmax, 2, setup);
    let episodes: Vec<_> = evaluated.episodes.iter().flatten().collect();
    let all = policy.contract().instructions().count() * 3;
    assert_eq!(episodes.len(), all);
    assert!(!evaluated.refused_at.is_empty());
    assert!(evaluated.refused_at.is_sorted());
    // An episode that was refused has the steps before it, and no success.
    let short = episodes
        .iter()
        .filter(|episode| !episode.success && episode.steps < 40);
    let mut steps: Vec<_> = short.map(|episode| episode.steps).collect();
    steps.sort_unstable();
    assert_eq!(steps, evaluated.refused_at);
    assert_eq!(
        evaluated.refused_at,
        evaluate(&policy, Decision::Argmax, 1, setup).refused_at
    );
}
