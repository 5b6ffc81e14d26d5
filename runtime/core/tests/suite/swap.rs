//! Tests that another policy takes the place of the running one: it has to fit, and no action
//! jumps.

use crate::support::assemble::{ACTION, parts};
use crate::support::writer::Parts;
use crate::support::{Image, Memory, Model, Random, Spec, given, observe, shapes};
use lads_core::{
    Controller, Fallback, GuardConfig, GuardedController, Instruction, Intervention, Limits,
    Policy, SwapError, Workspace,
};
use lads_image::records;

fn lads(seed: u64) -> Parts {
    parts(&Model::random(Spec::TINY, seed)).with_golden(12)
}

/// Control period of the test policies, in seconds.
const PERIOD: f64 = 0.08;

const RATE: [f32; 2] = [0.5, 0.25];

fn config() -> GuardConfig<'static> {
    GuardConfig {
        fallback: Fallback::Hold,
        limits: Limits {
            max_rate: Some(&RATE),
            ..Limits::default()
        },
        ..GuardConfig::default()
    }
}

/// Makes memory, and a controller in it that has passed its self-test and follows instruction 0, as
/// far as that was asked for.
fn controller<'a, 'm>(
    policy: &Policy<'a>,
    memory: &'m mut Memory,
    tested: bool,
    instructed: bool,
) -> Controller<'a, 'm> {
    let workspace =
        Workspace::new(policy, &mut memory.arena, &mut memory.state).expect("the memory suffices");
    let mut controller = Controller::new(*policy, workspace);
    if tested {
        controller.self_test().expect("the policy is sound");
    }
    if instructed {
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
    }
    controller
}

#[test]
fn what_does_not_fit_is_refused_and_the_old_policy_goes_on() {
    let old = lads(11).image();
    let channel = |edit: &dyn Fn(&mut Parts)| {
        let mut parts = lads(12);
        edit(&mut parts);
        parts.image()
    };
    let period = channel(&|parts| parts.contract.control_period_s = 0.04);
    let limits = channel(&|parts| parts.elements[4].max = 0.5);
    let names = channel(&|parts| parts.elements[1].name = parts.elements[0].name);
    let scale = channel(&|parts| parts.elements[3].scale = 2.0);
    let reference =
        channel(&|parts| parts.channels[ACTION as usize].reference = parts.contract.family);
    let more = channel(&|parts| {
        parts.channel(
            "more",
            records::Role::Demonstration,
            records::DType::F32,
            &[1],
            [0.0, 1.0],
        );
    });
    let unlike = shapes::queue().image();
    let sound = lads(12).image();
    let refused = |channel| SwapError::Channels { channel };
    let cases: [(&Image, bool, SwapError); 8] = [
        (&period, true, SwapError::ControlPeriod),
        (&limits, true, refused(ACTION)),
        (&names, true, refused(0)),
        (&scale, true, refused(ACTION)),
        (&reference, true, refused(ACTION)),
        (&more, true, refused(5)),
        (&unlike, false, refused(0)),
        (&sound, false, SwapError::NoInstruction),
    ];
    for (other, instructed, error) in cases {
        let run = |swaps: bool| {
            let (policy, new) = (old.policy(), other.policy());
            let (mut memory, mut other_memory) =
                (Memory::for_policy(&policy), Memory::for_policy(&new));
            let mut guard = vec![f32::NAN; GuardedController::memory_len(&policy)];
            let running = controller(&policy, &mut memory, false, true);
            let mut guarded = GuardedController::new(running, &config(), &mut guard)
                .expect("the configuration is sound");
            guarded.arm_untested();
            let mut waiting = Some(controller(&new, &mut other_memory, false, instructed));
            let mut random = Random(1);
            let mut seen = Vec::new();
            for _ in 0..20 {
                if swaps {
                    let asked = waiting.take().expect("it came back");
                    let (why, back) = guarded.swap(asked).expect_err("it does not fit");
                    assert_eq!(why, error);
                    waiting = Some(back);
                }
                let mut action = [0.0; 2];
                let report = guarded
                    .step(&random.vec(3, 1.0), None, &mut action)
                    .expect("two elements");
                seen.push((report, action));
            }
            assert!(guarded.is_armed());
            (seen, guarded.counters())
        };
        assert_eq!(run(true), run(false), "{error:?}");
    }
}

#[test]
fn after_a_swap_nothing_is_faster_than_it_may_be() {
    let (first, second) = (lads(11).image(), lads(12).image());
    let (policies, mut random) = ([first.policy(), second.policy()], Random(2));
    let mut memories = policies.each_ref().map(Memory::for_policy);
    let [one, two] = &mut memories;
    let mut guard = vec![f32::NAN; GuardedController::memory_len(&policies[0])];
    let running = controller(&policies[0], one, true, true);
    let mut waiting = Some(controller(&policies[1], two, true, true));
    let mut guarded =
        GuardedController::new(running, &config(), &mut guard).expect("the configuration is sound");
    guarded.arm_untested();
    let (mut last, mut held_back) = ([0.0_f32; 2], 0);
    for step in 0..60 {
        if step % 7 == 6 {
            let back = guarded
                .swap(waiting.take().expect("one waits"))
                .map_err(|(error, _)| error);
            waiting = Some(back.expect("it fits"));
            assert!(guarded.is_armed());
        }
        let mut action = [f32::NAN; 2];
        let report = guarded
            .step(&random.vec(3, 1.0), None, &mut action)
            .expect("two elements");
        assert_eq!(report.intervention, None);
        held_back += u32::from(report.rate_limited && step % 7 == 6);
        for (i, (now, before)) in action.iter().zip(last).enumerate() {
            let moved = (f64::from(*now) - f64::from(before)).abs();
            assert!(
                moved <= f64::from(RATE[i]) * PERIOD,
                "element {i} moved by {moved} in step {step}"
            );
        }
        last = action;
    }
    assert!(held_back > 0, "a swap that asks for no jump proves nothing");
    assert_eq!(guarded.counters().policy, 60);
}

#[test]
fn the_new_policy_is_the_one_that_runs() {
    let (first, second) = (lads(11).image(), lads(12).image());
    let (old, new) = (first.policy(), second.policy());
    let [mut one, mut two, mut three] = [&old, &new, &new].map(Memory::for_policy);
    let mut guard = vec![f32::NAN; GuardedController::memory_len(&old)];
    let running = controller(&old, &mut one, true, true);
    let mut bare = controller(&new, &mut three, true, true);
    let config = GuardConfig::default();
    let mut guarded =
        GuardedController::new(running, &config, &mut guard).expect("the configuration is sound");
    guarded.arm_untested();
    let mut random = Random(3);
    guarded
        .step(&random.vec(3, 1.0), None, &mut [0.0; 2])
        .expect("two elements");
    let replaced = guarded
        .swap(controller(&new, &mut two, true, true))
        .map_err(|(error, _)| error);
    // The old one is given back as it was: one step into its episode.
    let mut replaced = replaced.expect("it fits");
    let report = replaced
        .step(&[0.0; 3], &mut [0.0; 2])
        .expect("the step is sound");
    assert_eq!(report.timestep, 1);
    for _ in 0..12 {
        let inputs = observe(&new, &mut random);
        let (mut action, mut expected) = ([0.0; 2], [0.0; 2]);
        let made = bare
            .step_with(&given(&inputs), &mut expected)
            .expect("the step is sound");
        let report = guarded
            .step_with(&given(&inputs), None, &mut action)
            .expect("two elements");
        assert_eq!(
            (report.step, report.intervention, action),
            (Some(made), None, expected)
        );
    }
    assert!(guarded.controller().is_tested());
}

#[test]
fn an_untested_policy_disarms() {
    let (first, second) = (lads(11).image(), lads(12).image());
    let (old, new) = (first.policy(), second.policy());
    let [mut one, mut two] = [&old, &new].map(Memory::for_policy);
    let mut guard = vec![f32::NAN; GuardedController::memory_len(&old)];
    let running = controller(&old, &mut one, true, true);
    let mut guarded =
        GuardedController::new(running, &config(), &mut guard).expect("the configuration is sound");
    guarded.self_test().expect("the policy is sound");
    assert!(guarded.is_armed());
    // Without an instruction at work, none is asked of the other either.
    let swapped = guarded
        .swap(controller(&new, &mut two, false, false))
        .map_err(|(error, _)| error);
    swapped.expect("it fits");
    assert!(!guarded.is_armed());
    let report = guarded
        .step(&[0.0; 3], None, &mut [0.0; 2])
        .expect("two elements");
    assert_eq!(report.intervention, Some(Intervention::NotArmed));
}
