//! A guard lets nothing out that is not finite, outside the limits or too fast, whatever comes in; and it says and counts what it did.

mod support;

use lads_core::{
    ActionLength, Counters, Fallback, GuardConfig, GuardError, GuardReport, GuardedController,
    Instruction, Intervention, Limits, StepError, Tick,
};
use proptest::prelude::*;
use support::assemble::{parts, with_golden};
use support::{Image, Memory, Model, Spec};

/// In seconds, as the test policy's contract has it.
const PERIOD: f32 = 0.08;

fn image() -> Image {
    with_golden(parts(&Model::random(Spec::TINY, 11)), 12).image()
}

/// Runs `f` on a guarded controller in memory full of what must not matter.
fn guarded<T>(
    config: &GuardConfig,
    f: impl FnOnce(&mut GuardedController) -> T,
) -> Result<T, GuardError> {
    let image = image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut guard = vec![f32::NAN; GuardedController::memory_len(&policy)];
    let mut guarded = GuardedController::new(memory.controller(&policy), config, &mut guard)?;
    Ok(f(&mut guarded))
}

/// Armed, with an instruction.
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
        // Idle is no fault.
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
    let mut parts = with_golden(parts(&Model::random(Spec::TINY, 11)), 12);
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
        let not_finite = StepError::NotFinite { index: 1 };
        assert_eq!(report.intervention, Some(Intervention::Refused(not_finite)));
        assert_eq!((report.step, action), (None, last));
        let (report, action) = step(guarded, [0.0, 0.0, 4.0]);
        assert!(matches!(
            report.intervention,
            Some(Intervention::Refused(StepError::OutOfLimits {
                index: 2,
                ..
            }))
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
        assert_eq!(at(u64::MAX, 0), None);
        assert_eq!(at(0, 0), Some(Intervention::Stale));
        let blind = guarded.step_blind(&mut [0.0; 2]);
        let blind = blind.expect("the action has two elements");
        assert_eq!(blind.intervention, Some(Intervention::NoObservation));
        let counters = guarded.counters();
        assert_eq!((counters.stale, counters.late, counters.missed), (4, 1, 3));
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
fn configurations_that_contradict_the_contract_are_refused() {
    fn refused(config: &GuardConfig) -> Option<GuardError> {
        guarded(config, |_| ()).err()
    }
    fn limits(limits: Limits) -> Option<GuardError> {
        refused(&GuardConfig {
            limits,
            ..GuardConfig::default()
        })
    }
    fn min(min: Option<&[f32]>) -> Limits<'_> {
        Limits {
            min,
            ..Limits::default()
        }
    }
    let none = Limits::default();
    assert_eq!(limits(none), None);
    assert_eq!(
        limits(min(Some(&[0.0]))),
        Some(GuardError::Length { got: 1, needed: 2 })
    );
    assert_eq!(limits(min(Some(&[-9.0, 0.5]))), None);
    for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 99.0] {
        let wrong = [0.0, wrong];
        assert_eq!(
            limits(min(Some(&wrong))),
            Some(GuardError::Limits { index: 1 })
        );
        let max = Limits {
            max: Some(&[0.0, -99.0]),
            ..none
        };
        assert_eq!(limits(max), Some(GuardError::Limits { index: 1 }));
    }
    for wrong in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let wrong = [wrong, 1.0];
        let max_rate = Some(&wrong[..]);
        assert_eq!(
            limits(Limits { max_rate, ..none }),
            Some(GuardError::Rate { index: 0 })
        );
        let fallback = Fallback::Decay {
            time_constant_s: wrong[0],
        };
        let decay = GuardConfig {
            fallback,
            ..GuardConfig::default()
        };
        assert_eq!(refused(&decay), Some(GuardError::TimeConstant));
    }
    for wrong in [f32::NAN, 99.0, -99.0] {
        let wrong = [0.0, wrong];
        let safe_action = Some(&wrong[..]);
        let error = Some(GuardError::SafeAction { index: 1 });
        assert_eq!(
            limits(Limits {
                safe_action,
                ..none
            }),
            error
        );
    }
    // Without one, the safe action is the limit nearest to zero.
    let config = GuardConfig {
        limits: min(Some(&[0.25, -1.0])),
        ..GuardConfig::default()
    };
    let safe = guarded(&config, |guarded| step(guarded, [0.0; 3]).1);
    assert_eq!(safe, Ok([0.25, 0.0]));

    let image = image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let needed = GuardedController::memory_len(&policy);
    let mut short = vec![0.0; needed - 1];
    let made = GuardedController::new(
        memory.controller(&policy),
        &GuardConfig::default(),
        &mut short,
    );
    let got = needed - 1;
    assert_eq!(made.err(), Some(GuardError::Memory { got, needed }));
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

/// What a caller may do, well meant or not.
#[derive(Debug, Clone)]
enum Call {
    Step(Vec<f32>, Option<Tick>),
    Blind,
    Executed(Vec<f32>),
    Instruction(u32),
    Words(Vec<f32>),
    Reset,
    Stop,
    Resume,
    SelfTest,
}

impl Arbitrary for Call {
    type Parameters = ();
    type Strategy = BoxedStrategy<Self>;

    fn arbitrary_with((): ()) -> BoxedStrategy<Self> {
        let any_float =
            prop_oneof![6 => -3.0_f32..3.0, 1 => any::<f32>(), 1 => Just(f32::NAN)].boxed();
        let sound = prop::collection::vec(-3.0_f32..3.0, 3);
        let observation = prop_oneof![
            4 => sound,
            2 => prop::collection::vec(any_float.clone(), 3),
            1 => prop::collection::vec(any_float.clone(), 0..5),
        ];
        let tick = prop::option::of(
            (0..50_u64, 0..4_u32).prop_map(|(timestamp, missed)| Tick { timestamp, missed }),
        );
        prop_oneof![
            20 => (observation, tick).prop_map(|(observation, tick)| Self::Step(observation, tick)),
            1 => Just(Self::Blind),
            1 => prop::collection::vec(any_float.clone(), 1..4).prop_map(Self::Executed),
            2 => (0..3_u32).prop_map(Self::Instruction),
            1 => prop::collection::vec(any_float, 0..20).prop_map(Self::Words),
            1 => Just(Self::Reset),
            1 => Just(Self::Stop),
            2 => Just(Self::Resume),
            2 => Just(Self::SelfTest),
        ]
        .boxed()
    }
}

fn any_fallback() -> impl Strategy<Value = Fallback> {
    prop_oneof![
        Just(Fallback::Stop),
        Just(Fallback::Hold),
        (1e-3_f32..1.0).prop_map(|time_constant_s| Fallback::Decay { time_constant_s }),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn nothing_that_is_not_finite_outside_the_limits_or_too_fast_ever_comes_out(
        calls in prop::collection::vec(any::<Call>(), 1..120),
        fallback in any_fallback(),
        late_after in 0..3_u32,
        stop_after in 0..4_u32,
        rates in prop::collection::vec(0.1_f32..20.0, 2),
        [low, high] in prop::array::uniform2(0.0_f32..2.0),
    ) {
        let (min, max) = ([-low, -0.5], [high, 0.5]);
        let config = GuardConfig {
            fallback,
            late_after,
            stop_after,
            limits: Limits { min: Some(&min), max: Some(&max), max_rate: Some(&rates), safe_action: None },
        };
        let mut bounds: Vec<[f32; 2]> = Vec::new();
        for (element, (&low, &high)) in image().policy().contract().actions().zip(min.iter().zip(&max)) {
            bounds.push([element.limits.min.max(low), element.limits.max.min(high)]);
        }
        let run = |guarded: &mut GuardedController| -> Result<(), TestCaseError> {
            let mut last = [0.0_f32; 2];
            for call in calls {
                let mut action = [f32::NAN; 2];
                match call {
                    Call::Step(observation, tick) => {
                        guarded.step(&observation, tick, &mut action).expect("two elements");
                    }
                    Call::Blind => {
                        guarded.step_blind(&mut action).expect("two elements");
                    }
                    Call::Executed(executed) => {
                        if guarded.executed(&executed).is_ok() {
                            for ((last, &x), &[min, max]) in last.iter_mut().zip(&executed).zip(&bounds) {
                                *last = x.clamp(min, max);
                            }
                        }
                        continue;
                    }
                    Call::Instruction(id) => {
                        let _ = guarded.set_instruction(Instruction::Id(id));
                        continue;
                    }
                    Call::Words(words) => {
                        let _ = guarded.set_instruction(Instruction::Words(&words));
                        continue;
                    }
                    Call::Reset => { guarded.reset(); continue; }
                    Call::Stop => { guarded.stop(); continue; }
                    Call::Resume => { guarded.resume(); continue; }
                    Call::SelfTest => { guarded.self_test().expect("the policy is sound"); continue; }
                }
                for (i, (&x, &[min, max])) in action.iter().zip(&bounds).enumerate() {
                    prop_assert!(x.is_finite() && x >= min && x <= max, "element {i} is {x}");
                    let step = (f64::from(x) - f64::from(last[i])).abs();
                    let most = f64::from(rates[i]) * f64::from(PERIOD);
                    prop_assert!(step <= most, "element {i} moved by {step}, at most {most}");
                }
                last = action;
            }
            let counters = guarded.counters();
            let reasons = [
                counters.policy, counters.not_armed, counters.stopped, counters.no_observation, counters.stale,
                counters.late, counters.not_finite, counters.out_of_limits, counters.refused,
            ];
            prop_assert_eq!(reasons.iter().sum::<u64>(), counters.periods);
            Ok(())
        };
        guarded(&config, run).expect("the configuration is sound")?;
    }
}
