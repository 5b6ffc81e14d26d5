//! Tests every bundle that ships, compiled and run on this machine.

use lads_core::{GoldenStep, Instruction, Policy, Workspace, WorkspaceTooSmall};
use lads_host::Memory;
use lads_tests::{bundles, compiled};

#[test]
fn golden_episodes_replay() {
    for path in bundles() {
        let image = compiled(&path);
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        let golden = policy.golden().unwrap();
        // What the project promises, whatever a bundle asks of itself.
        assert!(golden.tolerance() <= 1e-4, "{}", path.display());
        let mut memory = Memory::of(&policy).expect("there is memory");
        let passed = memory.controller(&policy).unwrap().self_test();
        let passed = passed.unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        assert_eq!(passed.steps as usize, golden.len());
        let mut controller = memory.controller(&policy).unwrap();
        let instruction = golden.instruction().map(Instruction::Id).unwrap();
        controller.set_instruction(instruction).unwrap();
        let mut action = vec![0.0; policy.contract().action_len()];
        let decisions = golden
            .steps()
            .filter(|step| {
                let report = controller
                    .step_with(step.observations(), &mut action)
                    .unwrap();
                report.selected.is_some_and(|selected| selected.fresh)
            })
            .count();
        assert!(
            decisions > 1,
            "{}: it decides more than once",
            path.display()
        );
    }
}

#[test]
fn the_plans_of_a_golden_episode_differ_by_instruction() {
    // Were the words lost on the way, every instruction would give the same logits.
    for path in bundles() {
        let image = compiled(&path);
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        let first = policy.golden().unwrap().step(0).unwrap();
        let mut action = vec![0.0; policy.contract().action_len()];
        let mut logits = Vec::new();
        for instruction in 0..policy.contract().instruction_count() as u32 {
            let mut memory = Memory::of(&policy).expect("there is memory");
            let mut controller = memory.controller(&policy).unwrap();
            controller
                .set_instruction(Instruction::Id(instruction))
                .unwrap();
            controller
                .step_with(first.observations(), &mut action)
                .unwrap();
            logits.push(controller.scores().to_vec());
        }
        let words: Vec<_> = policy
            .contract()
            .instructions()
            .map(|known| known.words)
            .collect();
        for (index, of_one) in logits.iter().enumerate() {
            // Two people may say the same words.
            let same = |&other: &usize| logits[other] == *of_one && words[other] != words[index];
            assert_eq!(
                (0..index).find(same),
                None,
                "{}: instruction {index}",
                path.display()
            );
        }
    }
}

#[test]
fn a_controller_that_was_used_answers_like_a_fresh_one() {
    for path in bundles() {
        let image = compiled(&path);
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        let steps: Vec<_> = policy.golden().unwrap().steps().collect();
        let mut action = vec![0.0; policy.contract().action_len()];
        let mut episode = |controller: &mut lads_core::Controller<'_, '_>| {
            let step = |seen: &GoldenStep| {
                let report = controller
                    .step_with(seen.observations(), &mut action)
                    .unwrap();
                (
                    report.selected.map(|selected| selected.index),
                    action.clone(),
                )
            };
            steps.iter().take(50).map(step).collect::<Vec<_>>()
        };
        let mut memory = Memory::of(&policy).expect("there is memory");
        let mut controller = memory.controller(&policy).unwrap();
        controller.set_instruction(Instruction::Id(1)).unwrap();
        let fresh = episode(&mut controller);
        controller.reset();
        assert_eq!(
            episode(&mut controller),
            fresh,
            "{}: after a reset",
            path.display()
        );
        controller.set_instruction(Instruction::Id(0)).unwrap();
        episode(&mut controller);
        controller.set_instruction(Instruction::Id(1)).unwrap();
        assert_eq!(
            episode(&mut controller),
            fresh,
            "{}: after another instruction",
            path.display()
        );
    }
}

#[test]
fn one_element_less_of_memory_is_refused() {
    for path in bundles() {
        let image = compiled(&path);
        let policy = Policy::new_checked(image.as_bytes()).unwrap();
        let (arena_len, state_len) = (policy.arena_len(), policy.state_len());
        let (mut arena, mut state) = (vec![0.0; arena_len], vec![0.0; state_len]);
        let short = Workspace::new(&policy, &mut arena[1..], &mut state).unwrap_err();
        assert_eq!(
            short,
            WorkspaceTooSmall {
                got: arena_len - 1,
                needed: arena_len
            }
        );
        let short = Workspace::new(&policy, &mut arena, &mut state[1..]).unwrap_err();
        assert_eq!(
            short,
            WorkspaceTooSmall {
                got: state_len - 1,
                needed: state_len
            }
        );
        assert!(Workspace::new(&policy, &mut arena, &mut state).is_ok());
    }
}

#[test]
fn compiling_twice_gives_the_same_image() {
    for path in bundles() {
        assert!(
            compiled(&path).as_bytes() == compiled(&path).as_bytes(),
            "{}",
            path.display()
        );
    }
}
