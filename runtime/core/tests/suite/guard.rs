//! Tests that a guard outputs only actions that are finite, inside the limits and slow enough,
//! whatever comes in, and that it reports and counts what it did.

use crate::support::assemble::parts;
use crate::support::guarding::{PERIOD, guarded, image};
use crate::support::{Memory, Model, Spec};
use lads_core::{
    ActionLength, Counters, Fallback, GuardConfig, GuardReport, GuardedController, InputError,
    Instruction, Intervention, Limits, StepError, Tick,
};

/// Runs `f` on a guarded controller that is armed and has an instruction.
fn ready<T>(config: &GuardConfig, f: impl FnOnce(&mut GuardedController) -> T) -> T {
    let run = |guarded: &mut GuardedController| {
        guarded.self_test().expect("the policy is sound");
        guarded
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        f(guarded)
    };
    guarded(config, run).expect("the configuration is sound")
}

fn step(guarded: &mut GuardedController, observation: [f32; 3]) -> (GuardReport, [f32; 2]) {
    let mut action = [f32::NAN; 2];
    let report = guarded
        .step(&observation, None, &mut action)
        .expect("the action has two elements");
    (report, action)
}

const NAN: [f32; 3] = [0.0, f32::NAN, 0.0];

#[test]
fn a_guard_that_has_nothing_to_do_changes_nothing() {
    let image = image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut bare = memory.controller(&policy);
    bare.set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    ready(&GuardConfig::default(), |guarded| {
        for t in 0..20 {
            let observation = [0.1 * t as f32, -0.3, 0.02 * t as f32];
            let mut expected = [0.0; 2];
            let made = bare.step(&observation, &mut expected).expect("it is sound");
            let (report, action) = step(guarded, observation);
            assert_eq!((report.step, report.intervention), (Some(made), None));
            assert_eq!(action, expected);
        }
        let counters = guarded.counters();
        assert_eq!((counters.periods, counters.policy), (20, 20));
    });
}

#[test]
fn nothing_moves_before_the_self_test_has_passed() {
    let config = GuardConfig {
        fallback: Fallback::Hold,
        limits: Limits {
            safe_action: Some(&[0.5, -0.25]),
            ..Limits::default()
        },
        ..GuardConfig::default()
    };
    let run = |guarded: &mut GuardedController| {
        guarded
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        let (report, action) = step(guarded, [0.0; 3]);
        assert_eq!(report.intervention, Some(Intervention::NotArmed));
        assert_eq!(action, [0.5, -0.25]);
        assert!(!guarded.is_armed());
        guarded.self_test().expect("the policy is sound");
        assert!(guarded.is_armed());
        // Being idle is not a fault.
        let refused = Some(Intervention::Refused(StepError::NoInstruction));
        assert_eq!(step(guarded, [0.0; 3]).0.intervention, refused);
        guarded
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        assert_eq!(step(guarded, [0.0; 3]).0.intervention, None);
    };
    guarded(&config, run).expect("the configuration is sound");
    let declined = |guarded: &mut GuardedController| {
        guarded.arm_untested();
        guarded
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        assert_eq!(step(guarded, [0.0; 3]).0.intervention, None);
    };
    guarded(&config, declined).expect("the configuration is sound");
}

#[test]
fn a_failed_self_test_disarms() {
    let mut parts = parts(&Model::random(Spec::TINY, 11)).with_golden(12);
    parts.golden.as_mut().expect("there is one").actions[3] += 0.5;
    let image = parts.image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut guard = vec![0.0; GuardedController::memory_len(&policy)];
    let controller = memory.controller(&policy);
    let mut guarded = GuardedController::new(controller, &GuardConfig::default(), &mut guard)
        .expect("the configuration is sound");
    guarded.arm_untested();
    guarded.self_test().expect_err("the recording was changed");
    assert!(!guarded.is_armed());
}

#[test]
fn hold_repeats_the_last_action_and_goes_on_when_the_fault_is_over() {
    let config = GuardConfig {
        fallback: Fallback::Hold,
        ..GuardConfig::default()
    };
    ready(&config, |guarded| {
        let (_, last) = step(guarded, [0.4, 0.1, -0.2]);
        let (report, action) = step(guarded, NAN);
        let not_finite = StepError::Input(InputError::NotFinite {
            channel: 0,
            index: 1,
        });
        assert_eq!(report.intervention, Some(Intervention::Refused(not_finite)));
        assert_eq!((report.step, action), (None, last));
        let (report, action) = step(guarded, [0.0, 0.0, 4.0]);
        assert!(matches!(
            report.intervention,
            Some(Intervention::Refused(StepError::Input(
                InputError::OutOfLimits { index: 2, .. }
            )))
        ));
        assert_eq!(action, last);
        // The context has lost no step: this is the second one of the episode.
        let (report, _) = step(guarded, [0.4, 0.1, -0.2]);
        assert_eq!(report.step.map(|step| step.timestep), Some(1));
        let Counters {
            periods,
            policy,
            not_finite,
            out_of_limits,
            ..
        } = guarded.counters();
        assert_eq!((periods, policy, not_finite, out_of_limits), (4, 2, 1, 1));
    });
}

#[test]
fn decay_approaches_the_safe_action() {
    let config = GuardConfig {
        fallback: Fallback::Decay {
            time_constant_s: 3.0 * PERIOD,
        },
        ..GuardConfig::default()
    };
    ready(&config, |guarded| {
        let (_, mut last) = step(guarded, [0.4, 0.1, -0.2]);
        for _ in 0..50 {
            let (_, action) = step(guarded, NAN);
            for (&got, from) in action.iter().zip(last) {
                assert!(
                    (got - 0.75 * from).abs() <= 1e-6 * from.abs(),
                    "{got} after {from}"
                );
            }
            last = action;
        }
        assert!(last.iter().all(|x| x.abs() < 1e-5));
        assert_eq!(step(guarded, [0.0; 3]).0.intervention, None);
    });
}

#[test]
fn stop_stays_stopped_until_resumed() {
    ready(&GuardConfig::default(), |guarded| {
        assert_ne!(step(guarded, [0.4, 0.1, -0.2]).1, [0.0; 2]);
        assert_eq!(step(guarded, NAN).1, [0.0; 2]);
        guarded.reset();
        guarded
            .set_instruction(Instruction::Id(1))
            .expect("the instruction is known");
        let (report, action) = step(guarded, [0.0; 3]);
        assert_eq!(report.intervention, Some(Intervention::Stopped));
        assert_eq!((action, guarded.is_stopped()), ([0.0; 2], true));
        guarded.resume();
        assert_eq!(step(guarded, [0.4, 0.1, -0.2]).0.intervention, None);
        guarded.stop();
        assert_eq!(step(guarded, [0.4, 0.1, -0.2]).1, [0.0; 2]);
        assert_eq!(guarded.counters().stopped, 2);
    });
}

#[test]
fn too_many_interventions_in_a_row_stop() {
    let config = GuardConfig {
        fallback: Fallback::Hold,
        stop_after: 3,
        ..GuardConfig::default()
    };
    ready(&config, |guarded| {
        for observation in [NAN, NAN, [0.0; 3], NAN, NAN] {
            step(guarded, observation);
            assert!(!guarded.is_stopped());
        }
        assert_eq!(step(guarded, NAN).1, [0.0; 2]);
        assert!(guarded.is_stopped());
    });
}

#[test]
fn stale_late_and_missing_observations_are_told_apart() {
    let config = GuardConfig {
        fallback: Fallback::Hold,
        late_after: 1,
        ..GuardConfig::default()
    };
    ready(&config, |guarded| {
        let mut at = |timestamp, missed| {
            let tick = Some(Tick { timestamp, missed });
            let report = guarded.step(&[0.0; 3], tick, &mut [0.0; 2]);
            report.expect("the action has two elements").intervention
        };
        assert_eq!(at(10, 0), None);
        assert_eq!(at(10, 0), Some(Intervention::Stale));
        assert_eq!(at(9, 0), Some(Intervention::Stale));
        assert_eq!(at(11, 0), None);
        assert_eq!(at(12, 1), None);
        assert_eq!(at(13, 2), Some(Intervention::Late { missed: 2 }));
        assert_eq!(at(13, 0), Some(Intervention::Stale));
        let blind = guarded.step_blind(&mut [0.0; 2]);
        let blind = blind.expect("the action has two elements");
        assert_eq!(blind.intervention, Some(Intervention::NoObservation));
        let counters = guarded.counters();
        assert_eq!((counters.stale, counters.late, counters.missed), (3, 1, 3));
        assert_eq!(counters.no_observation, 1);
    });
}

#[test]
fn the_context_holds_what_was_really_executed() {
    let config = GuardConfig {
        limits: Limits {
            max_rate: Some(&[0.5, 0.5]),
            ..Limits::default()
        },
        ..GuardConfig::default()
    };
    let image = image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut bare = memory.controller(&policy);
    bare.set_instruction(Instruction::Id(0))
        .expect("the instruction is known");
    ready(&config, |guarded| {
        let mut limited = 0;
        for t in 0..12 {
            let observation = [(t as f32).sin(), 0.3, -1.0];
            let mut wanted = [0.0; 2];
            let made = bare.step(&observation, &mut wanted).expect("it is sound");
            let (report, action) = step(guarded, observation);
            assert_eq!(report.step, Some(made));
            assert_eq!(report.rate_limited, action != wanted);
            limited += u64::from(report.rate_limited);
            bare.executed(&action).expect("the action is sound");
        }
        assert!(limited > 0);
        assert_eq!(guarded.counters().rate_limited, limited);
    });
}

#[test]
fn an_action_of_the_wrong_length_is_refused_untouched() {
    ready(&GuardConfig::default(), |guarded| {
        let mut action = [7.0; 3];
        let error = Err(ActionLength { got: 3, needed: 2 });
        assert_eq!(guarded.step(&[0.0; 3], None, &mut action), error);
        assert_eq!(guarded.step_blind(&mut action), error);
        assert_eq!((action, guarded.counters().periods), ([7.0; 3], 0));
    });
}

#[test]
fn a_gap_that_two_timestamps_agree_on_has_really_passed() {
    let config = GuardConfig {
        fallback: Fallback::Hold,
        max_jump: 200,
        ..GuardConfig::default()
    };
    let jump = Some(Intervention::Jump);
    for (timestamps, expected) in [
        // The process stood still for a while.
        ([100, 180, 1000, 1080, 1160], [None, None, jump, None, None]),
        ([100, 180, 1000, 1500, 1580], [None, None, jump, jump, None]),
        // Two damaged ones do not follow on each other, nor does one that comes twice.
        ([100, 180, 1000, 1000, 260], [None, None, jump, jump, None]),
        ([100, 180, 1000, 900, 260], [None, None, jump, jump, None]),
        // One that fitted again ends the search.
        ([100, 180, 1000, 260, 1080], [None, None, jump, None, jump]),
    ] {
        let seen = ready(&config, |guarded| {
            timestamps.map(|timestamp| {
                let tick = Tick {
                    timestamp,
                    missed: 0,
                };
                let report = guarded.step(&[0.0; 3], Some(tick), &mut [0.0; 2]);
                // A period without an observation says nothing about the time.
                guarded.step_blind(&mut [0.0; 2]).expect("two elements");
                report.expect("the action has two elements").intervention
            })
        });
        assert_eq!(seen, expected, "{timestamps:?}");
    }
}

#[test]
fn one_damaged_timestamp_is_refused_itself() {
    let tick = |timestamp| {
        Some(Tick {
            timestamp,
            missed: 0,
        })
    };
    let run = |max_jump| {
        let config = GuardConfig {
            fallback: Fallback::Hold,
            max_jump,
            ..GuardConfig::default()
        };
        ready(&config, |guarded| {
            let mut seen = Vec::new();
            for timestamp in [100, 180, u64::MAX, 260, 340, 420] {
                let report = guarded.step(&[0.0; 3], tick(timestamp), &mut [0.0; 2]);
                seen.push(report.expect("the action has two elements").intervention);
            }
            guarded.reset();
            let report = guarded.step(&[0.0; 3], tick(0), &mut [0.0; 2]);
            seen.push(report.expect("the action has two elements").intervention);
            (seen, guarded.counters())
        })
    };
    let stale = Some(Intervention::Stale);
    // Without a bound it is believed, and everything after it is older; a reset ends that.
    let (seen, counters) = run(0);
    assert_eq!(seen, [None, None, None, stale, stale, stale, None]);
    assert_eq!((counters.policy, counters.stale), (4, 3));
    let (seen, counters) = run(200);
    assert_eq!(
        seen,
        [None, None, Some(Intervention::Jump), None, None, None, None]
    );
    assert_eq!((counters.policy, counters.stale), (6, 1));
    // The first timestamp of an episode may be the damaged one, whichever way.
    for first in [u64::MAX, 0] {
        let config = GuardConfig {
            fallback: Fallback::Hold,
            max_jump: 200,
            ..GuardConfig::default()
        };
        let seen = ready(&config, |guarded| {
            [first, 100_000, 100_080, 100_080, 100_160].map(|timestamp| {
                let report = guarded.step(&[0.0; 3], tick(timestamp), &mut [0.0; 2]);
                report.expect("the action has two elements").intervention
            })
        });
        assert_eq!(seen, [None, Some(Intervention::Jump), None, stale, None]);
    }
    // The bound itself is not a jump.
    let (seen, _) = run(80);
    assert_eq!(
        seen,
        [None, None, Some(Intervention::Jump), None, None, None, None]
    );
    let (seen, _) = run(79);
    assert_eq!(seen[1..3], [Some(Intervention::Jump); 2]);
}

#[test]
fn a_few_missing_observations_are_coasted_over() {
    let config = GuardConfig {
        coast: 2,
        max_jump: 100,
        ..GuardConfig::default()
    };
    ready(&config, |guarded| {
        let (_, last) = step(guarded, [0.4, 0.1, -0.2]);
        assert_ne!(last, [0.0; 2]);
        for _ in 0..3 {
            for fault in 0..2 {
                let mut action = [f32::NAN; 2];
                let report = if fault == 0 {
                    guarded
                        .step_blind(&mut action)
                        .expect("the action has two elements")
                } else {
                    guarded
                        .step(&NAN, None, &mut action)
                        .expect("the action has two elements")
                };
                assert!(report.coasting && report.intervention.is_some());
                assert_eq!((report.step, action), (None, last));
            }
            // The policy's state was kept: the same step as if nothing had been missed.
            let (report, action) = step(guarded, [0.4, 0.1, -0.2]);
            assert!(!report.coasting && report.intervention.is_none());
            assert_eq!(action, last);
        }
        let [_, first, damaged, old] = [9, 10, 1000, 5].map(|timestamp| {
            let tick = Some(Tick {
                timestamp,
                missed: 0,
            });
            guarded
                .step(&[0.4, 0.1, -0.2], tick, &mut [0.0; 2])
                .expect("the action has two elements")
        });
        assert_eq!((first.intervention, first.coasting), (None, false));
        assert_eq!(
            (damaged.intervention, damaged.coasting),
            (Some(Intervention::Jump), true)
        );
        assert_eq!(
            (old.intervention, old.coasting),
            (Some(Intervention::Stale), true)
        );
        // The third in a row is too many.
        let (report, action) = step(guarded, NAN);
        assert!(!report.coasting && guarded.is_stopped());
        assert_eq!(action, [0.0; 2]);
        let (report, _) = step(guarded, NAN);
        assert_eq!(
            (report.intervention, report.coasting),
            (Some(Intervention::Stopped), false)
        );
        assert_eq!(guarded.counters().coasted, 8);
    });
    // Neither before arming nor when periods were missed.
    let idle = |guarded: &mut GuardedController| step(guarded, NAN).0;
    let report = guarded(&config, idle).expect("the configuration is sound");
    assert_eq!(
        (report.intervention, report.coasting),
        (Some(Intervention::NotArmed), false)
    );
    let late = ready(&config, |guarded| {
        let tick = Some(Tick {
            timestamp: 1,
            missed: 1,
        });
        guarded
            .step(&[0.0; 3], tick, &mut [0.0; 2])
            .expect("the action has two elements")
    });
    assert_eq!(
        (late.intervention, late.coasting),
        (Some(Intervention::Late { missed: 1 }), false)
    );
}
