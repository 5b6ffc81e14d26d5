//! Tests that a refused call leaves the controller unchanged: its answers are, bit for bit, those
//! of a controller that was never asked.

use crate::support;
use crate::support::assemble::parts;
use crate::support::draft::Draft;
use crate::support::writer::{Call, Parts};
use crate::support::{Image, Memory, Model, Random, Spec, given, observe, shapes};
use lads_core::{
    ChannelId, Controller, Data, Decision, InputError, Instruction, InstructionError, Noise,
    Policy, RunError, StepError, StepReport,
};
use lads_image::op::{self, UnaryKind};
use lads_image::records::{Event, Scope};

const STEPS: usize = 30;

fn tiny() -> Parts {
    parts(&Model::random(Spec::TINY, 11))
}

/// Returns all shapes and the small LADS policy, unchanged and with a last call that overflows when
/// an observation is above one.
fn all(fused: bool) -> Vec<(&'static str, Parts)> {
    let mut all = shapes::all();
    all.push(("lads", tiny()));
    if fused {
        for (_, parts) in &mut all {
            *parts = with_fuse(parts.clone());
        }
    }
    all
}

fn with_fuse(mut parts: Parts) -> Parts {
    let len = parts.channels[0].dims[0];
    let burnt = parts.plain("fuse", Scope::Step, len);
    let factor = parts.weights(&[100.0]);
    let mut fuse = Draft::new("fuse");
    let observation = fuse.channel(0, len);
    let x = fuse.mul(observation, factor);
    let y = fuse.span(len);
    fuse.op(op::Unary {
        kind: UnaryKind::Exp,
        alpha: 0.0,
        x: x.into(),
        y,
    });
    fuse.gives_state(burnt, y);
    let fuse = parts.entry(fuse.finish());
    let last = parts
        .calls
        .iter()
        .rposition(|call| call.record.event == Event::Step)
        .expect("there are steps");
    parts.calls.insert(last + 1, Call::step(fuse));
    parts.sealed()
}

/// Reports, actions and scores of an episode.
type Seen = Vec<(StepReport, Vec<u32>, Vec<u32>)>;

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|x| x.to_bits()).collect()
}

fn episode(image: &Image, mut between: impl FnMut(&mut Controller, &Policy, usize)) -> Seen {
    let policy = image.policy();
    let mut memory = Memory::for_policy(&policy);
    let mut controller = memory.controller(&policy);
    controller.set_decision(Decision::Sample {
        temperature: 2.0,
        seed: 5,
    });
    controller.set_noise(Noise::Seeded { seed: 3 });
    let mut random = Random(1);
    let mut seen = Vec::new();
    for step in 0..STEPS {
        let instruction = step / 13;
        if step % 13 == 0 && instruction < policy.contract().instruction_count() {
            controller
                .set_instruction(Instruction::Id(instruction as u32))
                .expect("it is known");
        }
        between(&mut controller, &policy, step);
        let mut inputs = observe(&policy, &mut random);
        halve(&mut inputs);
        let mut action = vec![0.0; policy.contract().action_len()];
        let report = controller
            .step_with(&given(&inputs), &mut action)
            .expect("the step is sound");
        seen.push((report, bits(&action), bits(controller.scores())));
        if step % 4 == 3 {
            controller
                .executed(&vec![0.25; action.len()])
                .expect("the action is sound");
        }
    }
    seen
}

/// Halves the observations, so that the last call does not overflow.
fn halve(inputs: &mut [(ChannelId, support::Values)]) {
    for (_, values) in inputs {
        if let support::Values::F32(values) = values {
            for value in values {
                *value *= 0.5;
            }
        }
    }
}

#[test]
fn refused_input_leaves_the_controller_as_it_was() {
    for (name, parts) in all(false) {
        let image = parts.image();
        let disturbed = episode(&image, |controller, policy, step| {
            let mut action = [7.0; 2];
            let sound = observe(policy, &mut Random(step as u64));
            for wrong in [f32::NAN, f32::INFINITY, -3.5] {
                let mut values = vec![0.0; policy.contract().observation_len()];
                values[1] = wrong;
                let mut inputs = given(&sound);
                inputs[0].1 = Data::F32(&values);
                let refused = controller
                    .step_with(&inputs, &mut action)
                    .expect_err("it is refused");
                let StepError::Input(error) = refused else {
                    panic!("{refused:?}")
                };
                assert_eq!((error.channel(), error.element()), (0, Some(1)));
            }
            assert!(
                controller
                    .step_with(&given(&sound)[1..], &mut action)
                    .is_err()
            );
            let short = StepError::ActionLength { got: 1, needed: 2 };
            assert_eq!(
                controller.step_with(&given(&sound), &mut action[..1]),
                Err(short)
            );
            assert_eq!(controller.executed(&[0.0]), Err(short));
            let channel = policy.contract().action().id().0;
            let not_finite = InputError::NotFinite { channel, index: 0 };
            assert_eq!(
                controller.executed(&[f32::NAN, 0.0]),
                Err(StepError::Input(not_finite))
            );
            if step == 0 {
                assert_eq!(
                    controller.executed(&[0.0; 2]),
                    Err(StepError::NothingExecuted)
                );
            }
            assert_eq!(action, [7.0; 2]);
            if policy.index_count() > 0 && policy.follows() {
                controller
                    .follow(&given(&sound), 0, &mut action)
                    .expect("there is such an index");
            }
        });
        assert_eq!(episode(&image, |_, _, _| ()), disturbed, "{name}");
    }
}

#[test]
fn a_refused_instruction_leaves_the_old_one() {
    let image = tiny().image();
    let disturbed = episode(&image, |controller, _, _| {
        let mut refused = |instruction| {
            controller
                .set_instruction(instruction)
                .expect_err("it is refused")
        };
        assert_eq!(
            refused(Instruction::Id(2)),
            InstructionError::Unknown { id: 2, count: 2 }
        );
        let length = InstructionError::Length {
            got: 6,
            word_dim: 4,
        };
        assert_eq!(refused(Instruction::Words(&[0.0; 6])), length);
        assert_eq!(
            refused(Instruction::Words(&[])),
            InstructionError::Words { got: 0, most: 4 }
        );
        assert_eq!(
            refused(Instruction::Words(&[0.0; 20])),
            InstructionError::Words { got: 5, most: 4 }
        );
        let not_finite = InstructionError::NotFinite { index: 2 };
        assert_eq!(
            refused(Instruction::Words(&[0.0, 0.0, f32::NAN, 0.0])),
            not_finite
        );
        // Encoding a demonstration does not disturb the episode either.
        let [observations, actions] = [Data::F32(&[0.1; 9]), Data::F32(&[0.2; 6])];
        assert!(
            controller
                .encode(&[(ChannelId(3), actions), (ChannelId(2), observations)])
                .is_ok()
        );
    });
    assert_eq!(episode(&image, |_, _, _| ()), disturbed);
}

/// Undoes a step whose last call fails, after caches were cleared and appended to, rings appended
/// to, states written, noise drawn and an index sampled; at ordinary steps and at those where a
/// context starts again.
#[test]
fn a_step_that_fails_at_its_end_is_undone() {
    for (name, parts) in all(true) {
        let image = parts.image();
        let disturbed = episode(&image, |controller, policy, step| {
            let mut inputs = observe(policy, &mut Random(step as u64 + 70));
            inputs[0].1 = support::Values::F32(vec![2.9; policy.contract().observation_len()]);
            let mut action = [9.0; 2];
            let before = (bits(controller.scores()), bits(controller.last_action()));
            for _ in 0..2 {
                let refused = controller.step_with(&given(&inputs), &mut action);
                assert_eq!(refused, Err(StepError::Run(RunError::NotFinite)));
            }
            assert_eq!(action, [9.0; 2]);
            assert_eq!(
                (bits(controller.scores()), bits(controller.last_action())),
                before
            );
        });
        assert_eq!(episode(&image, |_, _, _| ()), disturbed, "{name}");
    }
}

/// Reads, by a call beside the episode, a ring that a failed step has cleared and appended to, at a
/// restart and at a call that clears.
#[test]
fn a_ring_is_as_it_was_after_a_failed_step() {
    let mut cleared = shapes::history();
    cleared.calls.last_mut().expect("it appends").clears.push(0);
    for (name, mut parts) in [("restart", shapes::history()), ("clear", cleared)] {
        let mut read = Draft::new("follow");
        let rows = read.state(0, 2 * shapes::MEMORY);
        let index = read.int(lads_image::records::SourceKind::Selected, 0, 0);
        let row = read.gather(rows, 2, index, 0);
        read.gives_channel(shapes::ACTION, row);
        let read = parts.entry(read.finish());
        parts.calls.push(Call::on(Event::Follow, read));
        if name == "clear" {
            // The cache never sees more than one row.
            let rows = 1 + 2 + 2 * 2;
            let edits = support::draft::kv_len(rows, 2);
            (parts.states[1].rows, parts.states[1].width) = (rows, edits);
            resize(&mut parts, rows);
        }
        let image = with_fuse(parts).image();
        support::with_controller(&image, |controller| {
            let mut random = Random(2);
            for step in 0..20 {
                let all = |controller: &mut Controller| {
                    [0, 1, 2].map(|index| {
                        let mut row = [0.0; 2];
                        controller
                            .follow(&[(ChannelId(0), Data::F32(&[0.0; 2]))], index, &mut row)
                            .expect("there is such an index");
                        row
                    })
                };
                let before = all(controller);
                let refused = controller.step(&[2.9; 2], &mut [0.0; 2]);
                assert_eq!(refused, Err(StepError::Run(RunError::NotFinite)));
                assert_eq!(all(controller), before, "{name}, step {step}");
                controller
                    .step(&random.vec(2, 0.25), &mut [0.0; 2])
                    .expect("the step is sound");
                assert_ne!(all(controller), before, "{name}, step {step}");
            }
        });
    }
}

/// Sets the number of rows of the cache in every attention.
fn resize(parts: &mut Parts, rows: u32) {
    for op in parts.entries.iter_mut().flat_map(|entry| &mut entry.ops) {
        if let op::Op::Attention(attention) = op {
            let keys = lads_kernels::keys_len(rows as usize, 2) as u32;
            attention.cache_k.len = keys;
            attention.cache_v = op::StateSpan {
                offset: keys,
                len: rows * 2,
            };
            if attention.queries > 0 {
                let len = lads_kernels::attention_scratch_len(1, 1, rows as usize) as u32;
                attention.scratch.len = len;
            }
        }
    }
}

/// The one call whose failure is not undone leaves the controller without an instruction, and nothing for the next one.
#[test]
fn an_instruction_that_fails_leaves_none() {
    let image = shapes::recurrent().image();
    let fresh = episode(&image, |_, _, _| ());
    let disturbed = episode(&image, |controller, _, step| {
        if step != 0 && step != 13 {
            return;
        }
        let refused = controller.set_instruction(Instruction::Words(&[3e38; 4]));
        assert_eq!(refused, Err(InstructionError::Run(RunError::NotFinite)));
        assert!(!controller.is_instructed());
        let refused = controller.step(&[0.0; 2], &mut [0.0; 2]);
        assert_eq!(refused, Err(StepError::NoInstruction));
        let id = u32::from(step == 13);
        controller
            .set_instruction(Instruction::Id(id))
            .expect("it is known");
    });
    assert_eq!(fresh, disturbed);
}

/// Fills the cache with non-finite values, by words too large to compute with, which the next
/// instruction does not see.
#[test]
fn what_a_hopeless_instruction_left_in_the_cache_is_not_read() {
    let image = tiny().image();
    let fresh = episode(&image, |_, _, _| ());
    let disturbed = episode(&image, |controller, _, step| {
        if step != 0 && step != 13 {
            return;
        }
        controller
            .set_instruction(Instruction::Words(&[3e38; 16]))
            .expect("words have no limits");
        for _ in 0..2 {
            let refused = controller.step(&[0.1; 3], &mut [0.0; 2]);
            assert_eq!(refused, Err(StepError::Run(RunError::NotFinite)));
        }
        let id = u32::from(step == 13);
        controller
            .set_instruction(Instruction::Id(id))
            .expect("it is known");
    });
    assert_eq!(fresh, disturbed);
}
