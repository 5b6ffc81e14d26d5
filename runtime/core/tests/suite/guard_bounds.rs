//! Tests that a guard's output is finite, inside the limits and no faster than allowed, whatever
//! comes in.

use crate::support::Memory;
use crate::support::guarding::{PERIOD, guarded, image};
use lads_core::{Fallback, GuardConfig, GuardError, GuardedController, Instruction, Limits, Tick};
use proptest::prelude::*;

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
    let safe = guarded(&config, |guarded| step(guarded, [0.0; 3]));
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

fn step(guarded: &mut GuardedController, observation: [f32; 3]) -> [f32; 2] {
    let mut action = [f32::NAN; 2];
    guarded
        .step(&observation, None, &mut action)
        .expect("the action has two elements");
    action
}

/// Calls that a caller may make, well meant or not.
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
            (prop_oneof![9 => 0..50_u64, 1 => Just(u64::MAX)], 0..4_u32)
                .prop_map(|(timestamp, missed)| Tick { timestamp, missed }),
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
        coast in 0..3_u32,
        max_jump in 0..30_u64,
        stop_after in 0..4_u32,
        rates in prop::collection::vec(0.1_f32..20.0, 2),
        [low, high] in prop::array::uniform2(0.0_f32..2.0),
    ) {
        let (min, max) = ([-low, -0.5], [high, 0.5]);
        let config = GuardConfig {
            fallback,
            late_after,
            coast,
            max_jump,
            stop_after,
            limits: Limits { min: Some(&min), max: Some(&max), max_rate: Some(&rates), safe_action: None },
        };
        let mut bounds: Vec<[f32; 2]> = Vec::new();
        for (element, (&low, &high)) in image().policy().contract().action().elements().zip(min.iter().zip(&max)) {
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
