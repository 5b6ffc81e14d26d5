//! Tests that the self-test passes on a sound image and names the first step that differs on one
//! that is not.

use crate::support::assemble::parts;
use crate::support::writer::Parts;
use crate::support::{Memory, Model, Spec, shapes, with_controller};
use lads_core::{Decision, InputError, Instruction, SelfTestError, StepError};

fn recorded() -> Parts {
    parts(&Model::random(Spec::TINY, 11)).with_golden(20)
}

fn outcome(parts: &Parts) -> Result<lads_core::SelfTest, SelfTestError> {
    let image = parts.image();
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    memory.controller(&policy).self_test()
}

#[test]
fn a_sound_policy_passes_with_no_error_at_all() {
    let passed = outcome(&recorded()).expect("the policy is sound");
    assert_eq!((passed.steps, passed.largest_error), (20, 0.0));
}

#[test]
fn the_digest_is_that_of_the_bits_of_all_actions() {
    // FNV-1a's own test vectors, then the recorded actions, which are what was computed.
    let fnv = |bytes: &[u8]| {
        bytes.iter().fold(0x811c9dc5_u32, |hash, &byte| {
            (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193)
        })
    };
    assert_eq!(
        [fnv(b""), fnv(b"a"), fnv(b"foobar")],
        [0x811c9dc5, 0xe40c292c, 0xbf9cf968]
    );
    let parts = recorded();
    let episode = parts.golden.as_ref().expect("there is one");
    let bytes: Vec<u8> = episode
        .actions
        .iter()
        .flat_map(|x| x.to_le_bytes())
        .collect();
    let passed = outcome(&parts).expect("the policy is sound");
    assert_eq!(passed.digest, fnv(&bytes));
}

#[test]
fn without_a_recording_there_is_no_test() {
    let mut parts = recorded();
    parts.golden = None;
    assert_eq!(outcome(&parts), Err(SelfTestError::NoGolden));
}

#[test]
fn the_first_difference_is_named() {
    let sound = recorded();
    let episode = sound.golden.as_ref().expect("there is one");

    let mut parts = sound.clone();
    let expected = (episode.selected[13] + 1) % 5;
    parts.golden.as_mut().expect("there is one").selected[13] = expected;
    let got = episode.selected[13];
    assert_eq!(
        outcome(&parts),
        Err(SelfTestError::Selected {
            step: 13,
            expected,
            got
        })
    );

    let mut parts = sound.clone();
    let got = episode.actions[2 * 7 + 1];
    for (wrong, fails) in [(got + 2e-4, true), (got - 2e-4, true), (got + 5e-5, false)] {
        parts.golden.as_mut().expect("there is one").actions[2 * 7 + 1] = wrong;
        let named = Err(SelfTestError::Action {
            step: 7,
            index: 1,
            expected: wrong,
            got,
        });
        assert_eq!(outcome(&parts).is_err(), fails);
        assert!(!fails || outcome(&parts) == named);
    }

    let mut parts = sound;
    parts.golden.as_mut().expect("there is one").observations[0][3 * 4] = 50.0_f32.to_bits();
    let error = StepError::Input(InputError::OutOfLimits {
        channel: 0,
        index: 0,
        value: 50.0,
        min: -3.0,
        max: 3.0,
    });
    assert_eq!(outcome(&parts), Err(SelfTestError::Step { step: 4, error }));
}

#[test]
fn a_changed_weight_is_found() {
    let mut parts = recorded();
    // What lies before the words of the instructions are the programs' weights.
    let words = parts.instructions[0].words;
    for weight in &mut parts.weights[..words.offset as usize] {
        *weight *= 1.01;
    }
    assert!(outcome(&parts).is_err());
}

#[test]
fn changed_noise_is_found() {
    let mut parts = shapes::denoise().with_golden(6);
    // The noise of the last pass of the last step, 0.25 of which reaches the action.
    *parts
        .golden
        .as_mut()
        .expect("there is one")
        .noise
        .last_mut()
        .expect("there is some") += 1.0;
    let failed = with_controller(&parts.image(), |controller| {
        controller
            .self_test()
            .map(|_| ())
            .map_err(|_| controller.is_tested())
    });
    assert_eq!(failed, Err(false));
}

#[test]
fn afterwards_the_controller_is_fresh() {
    let image = recorded().image();
    let policy = image.policy();
    let sample = Decision::Sample {
        temperature: 3.0,
        seed: 9,
    };
    let run = |test_first: bool| {
        let mut memory = Memory::for_policy(&policy);
        let mut controller = memory.controller(&policy);
        controller.set_decision(sample);
        let mut action = [0.0; 2];
        if test_first {
            assert!(controller.self_test().is_ok());
            assert_eq!(controller.decision(), sample);
            assert_eq!(
                controller.step(&[0.1; 3], &mut action),
                Err(StepError::NoInstruction)
            );
            assert!(controller.scores().iter().all(|&logit| logit == 0.0));
        }
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        (0..12)
            .map(|_| controller.step(&[0.1; 3], &mut action).map(|r| (r, action)))
            .collect::<Vec<_>>()
    };
    assert_eq!(run(false), run(true));
}
