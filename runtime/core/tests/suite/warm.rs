//! Tests that warming changes nothing, whatever the state of the context, and runs code that only
//! later steps run.

use crate::support;
use crate::support::assemble::parts;
use crate::support::draft::kv_len;
use crate::support::{Image, Memory, Model, Random, Spec, given, observe, shapes};
use lads_core::Instruction;
use lads_image::records::Beyond;

/// Returns the bits of an episode's results, with or without warming before every step.
fn episode(image: &Image, warms: bool) -> Vec<u32> {
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    if warms {
        controller.warm();
    }
    let mut random = Random(1);
    let mut bits = Vec::new();
    for step in 0..30 {
        if step % 17 == 0 && policy.contract().instruction_count() > 0 {
            controller
                .set_instruction(Instruction::Id(1))
                .expect("the instruction is known");
        }
        if warms {
            controller.warm();
        }
        let mut action = vec![0.0; policy.contract().action_len()];
        let inputs = observe(&policy, &mut random);
        if controller.step_with(&given(&inputs), &mut action).is_err() {
            if warms {
                controller.warm();
            }
            controller.reset();
        }
        bits.extend(
            action
                .iter()
                .chain(controller.scores())
                .map(|x| x.to_bits()),
        );
    }
    bits
}

#[test]
fn nothing_changes() {
    let mut all = shapes::all();
    all.push(("lads", parts(&Model::random(Spec::TINY, 11))));
    for (name, mut parts) in all {
        for beyond in [Beyond::Restart, Beyond::Refuse] {
            parts.contract.beyond = beyond;
            let image = parts.image();
            assert_eq!(
                episode(&image, true),
                episode(&image, false),
                "{name}, {beyond:?}"
            );
        }
    }
}

/// A full context that refuses has no next step; the instruction's rows of the cache stay
/// unchanged.
#[test]
fn a_full_context_keeps_its_instruction() {
    let mut parts = parts(&Model::random(Spec::TINY, 11));
    parts.contract.beyond = Beyond::Refuse;
    let image = parts.image();
    let second_episode = |warms: bool| {
        support::with_controller(&image, |controller| {
            let mut random = Random(3);
            let mut seen = Vec::new();
            for step in 0..16 {
                if step == 8 {
                    assert!(controller.step(&[0.0; 3], &mut [0.0; 2]).is_err());
                    if warms {
                        controller.warm();
                    }
                    controller.reset();
                }
                let mut action = [0.0; 2];
                let report = controller
                    .step(&random.vec(3, 1.0), &mut action)
                    .expect("the context has room");
                seen.push((report, action, controller.scores().to_vec()));
            }
            seen
        })
    };
    assert_eq!(second_episode(true), second_episode(false));
}

/// Before the first step, warming has run the programs of later steps too: a step appends two rows,
/// and the first step one.
#[test]
fn before_the_first_step_later_programs_run() {
    let spec = Spec::TINY;
    let image = parts(&Model::random(spec, 11)).image();
    let policy = image.policy();
    let rows = |warms: bool| {
        let mut memory = Memory::for_policy(&policy);
        let mut controller = memory.controller(&policy);
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        if warms {
            controller.warm();
        }
        // The values of the first layer follow its keys, which take two blocks of sixteen tokens.
        let width = spec.width();
        let values = &memory.state[32 * width..];
        [0, 1, 2].map(|i| {
            let row = spec.words_len + i;
            values[row * width..(row + 1) * width]
                .iter()
                .any(|&x| x != 0.0)
        })
    };
    assert_eq!(rows(false), [false, false, false]);
    assert_eq!(rows(true), [true, true, false]);
}

/// A call that clears its full cache is warmed too, in the half that it would write.
#[test]
fn a_call_that_clears_is_warmed_in_the_other_half() {
    let image = shapes::chunks().image();
    let policy = image.policy();
    let half = |warms: bool| {
        let mut memory = Memory::for_policy(&policy);
        let mut controller = memory.controller(&policy);
        controller
            .set_instruction(Instruction::Id(0))
            .expect("the instruction is known");
        for _ in 0..2 {
            controller
                .step(&[0.5, -0.25], &mut [0.0; 2])
                .expect("the context has room");
        }
        if warms {
            controller.warm();
        }
        // Behind the first cache: the first step went to the second half.
        let start = kv_len(6, 2) as usize;
        memory.state[start..start + kv_len(5, 2) as usize]
            .iter()
            .any(|&x| x != 0.0)
    };
    assert!(!half(false));
    assert!(half(true));
}
